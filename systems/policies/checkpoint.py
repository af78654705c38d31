"""Files of trained policies, `.npz`, with weights, architecture and provenance; ONNX models."""

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import read_archive, reason_of
from splatpilot.systems.common.validation import require

FORMAT = 1
"""Version of files; it changes with the meaning of observations and commands."""

_MAX_WEIGHT = 1e6  # Sums of products with observations stay in single precision.

_SHIPPED = Path(__file__).parent / "weights"


@dataclass(frozen=True, eq=False)
class PolicyCheckpoint:
    """Content of a file of weights."""

    policy: str
    """Name of the policy, as in the benchmark."""
    spec: Any
    """Architecture of the network, a dataclass."""
    weights: Mapping[str, np.ndarray]
    provenance: dict[str, Any]
    """Command, configuration, revision and success, in types of JSON."""
    path: Path | None = None

    def build[Network](self, make: Callable[[Any, dict[str, np.ndarray]], Network]) -> Network:
        """Makes the network from the architecture and the weights; errors name the file."""
        try:
            return make(self.spec, dict(self.weights))
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}; {_remedy(self.policy)}") from None

    def save(self, path: Path) -> None:
        """Writes `path` atomically."""
        about = {
            "format": FORMAT,
            "policy": self.policy,
            "spec": asdict(self.spec),
            "provenance": self.provenance,
        }
        with written_atomically(path) as partial:
            arrays: dict[str, Any] = dict(self.weights)
            np.savez_compressed(partial, about=json.dumps(about), **arrays)

    @classmethod
    def load(cls, path: str | Path | None, policy: str, spec: Any) -> "PolicyCheckpoint":
        """Reads the weights of `policy` from a file, the shipped ones if `path` is None or empty.

        Args:
            path: the file.
            policy: name of the policy.
            spec: the required architecture, or a function that makes one from its fields.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is damaged, or of another policy, version or architecture.
        """
        path = Path(path) if path else shipped_weights(policy)
        about, weights = _read(path, policy)
        found = f"{about['policy']!r} in format {about['format']}"
        needed = f"{policy!r} in format {FORMAT}"
        require(found == needed, f"the policy of {path}", needed, found, _remedy(policy))
        fields, differing = about["spec"], ""
        if callable(spec):
            try:
                spec = spec(**fields)
            except (TypeError, ValueError) as error:
                differing = str(error)
        else:
            expected = json.loads(json.dumps(asdict(spec)))
            differing = ", ".join(
                f"{name} must be {expected.get(name)}, got {fields.get(name)}"
                for name in expected | fields
                if fields.get(name) != expected.get(name)
            )
        if differing:
            raise ValueError(f"architecture of {path}: {differing}; {_remedy(policy)}")
        return cls(policy, spec, weights, about["provenance"], path)


def shipped_weights(policy: str) -> Path:
    """Returns the shipped file of weights of a policy."""
    return _SHIPPED / f"{policy}.npz"


def checkpoint_policy(path: str | Path) -> str:
    """Reads the name of the policy from a file of weights."""
    return _read(Path(path), "POLICY")[0]["policy"]


def _remedy(policy: str) -> str:
    return f"train them with: splatpilot train {policy} --out DIR"


def _read(path: Path, policy: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Reads the description and the weights."""
    if not path.is_file():
        raise FileNotFoundError(f"No such file of weights: {path}; {_remedy(policy)}")
    try:
        weights = read_archive(path)
        about = json.loads(str(weights.pop("about")))
        for name, kind in (("format", int), ("policy", str), ("spec", dict), ("provenance", dict)):
            require(isinstance(about[name], kind), name, f"of type {kind.__name__}", about[name])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        reason = reason_of(error)
        raise ValueError(
            f"{path} must hold weights of a policy ({reason}); {_remedy(policy)}"
        ) from None
    return about, weights


def check_weights(
    weights: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """Returns the arrays in `shapes`, in single precision; raises ValueError if one is missing, of
    another shape or not finite."""
    for name, shape in shapes.items():
        found = weights[name].shape if name in weights else "none"
        require(found == shape, f"the weights {name}", f"of shape {shape}", found)
        values = weights[name]
        finite = values.dtype.kind == "f" and (np.abs(values.astype(float)) <= _MAX_WEIGHT).all()
        limit = f"finite numbers up to {_MAX_WEIGHT:g}"
        require(finite, f"the weights {name}", limit, "others")
    return {name: np.asarray(weights[name], np.float32) for name in shapes}


def linear_shapes(*layers: tuple[str, int, int]) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of weights by name of linear layers: name, inputs and outputs."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name, inputs, outputs in layers:
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (outputs, inputs), (outputs,)
    return shapes


def linear(weights: Mapping[str, np.ndarray], name: str, x: np.ndarray) -> np.ndarray:
    """Applies the linear layer `name` to x (..., inputs)."""
    return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]


def require_shape(name: str, array: np.ndarray, shape: tuple[int, ...], remedy: str = "") -> None:
    """Checks the shape of an input of a network."""
    found = np.shape(array)
    require(found == shape, f"shape of the policy's {name}", str(shape), found, remedy)


# ONNX models, https://onnx.ai/onnx/repo-docs/IR.html, are protocol buffers, with the field numbers
# of onnx.proto below. Writing them here keeps the onnx package out of training and flight.

_IR_VERSION, _OPSET = 5, 10  # In this version of operators, Clip has its limits as attributes.
_FLOAT, _INT, _INTS = 1, 2, 7  # AttributeProto.type; TensorProto.DataType FLOAT is 1 too.


class OnnxModel:
    """A graph from an image to features, run by OpenCV; operators are added first to last.

    Args:
        image: channels, height and width of the input.
    """

    def __init__(self, image: tuple[int, int, int]) -> None:
        self._image = image
        self._nodes: list[bytes] = []
        self._tensors: list[bytes] = []
        self.output = "image"
        """Name of the last operator's output."""

    def convolution(
        self,
        weight: np.ndarray,
        bias: np.ndarray,
        *,
        stride: int = 1,
        groups: int = 1,
        dilation: int = 1,
        padding: int | None = None,
    ) -> None:
        """Convolves (N, C, H, W) by `weight` (outputs, C / groups, k, k) and adds `bias`
        (outputs,); padded by k // 2 times the dilation by default."""
        kernel, names = weight.shape[2], []
        for values in (weight, bias):
            names.append(f"tensor{len(self._tensors)}")
            shape = b"".join(_field(1, size) for size in values.shape)
            data = np.ascontiguousarray(values, "<f4").tobytes()
            tensor = shape + _field(2, _FLOAT) + _field(8, names[-1].encode()) + _field(9, data)
            self._tensors.append(tensor)
        attributes = {
            "kernel_shape": [kernel] * 2,
            "strides": [stride] * 2,
            "pads": [dilation * (kernel // 2) if padding is None else padding] * 4,
            "dilations": [dilation] * 2,
            "group": groups,
        }
        self.add("Conv", *names, **attributes)

    def add(self, operator: str, *others: str, **attributes: Any) -> None:
        """Adds an operator on the last output and others by name, such as
        `add("Clip", min=0.0, max=6.0)`."""
        node = [_field(1, name.encode()) for name in (self.output, *others)]
        self.output = f"{operator.lower()}{len(self._nodes)}"
        node += [_field(2, self.output.encode()), _field(4, operator.encode())]
        node += [_field(5, _attribute(name, value)) for name, value in attributes.items()]
        self._nodes.append(b"".join(node))

    def serialize(self, features: tuple[int, int, int]) -> np.ndarray:
        """Returns the model as bytes (uint8) for `cv2.dnn.readNetFromONNX`.

        Args:
            features: channels, height and width of the last output.
        """
        graph = [
            *(_field(1, node) for node in self._nodes),
            _field(2, b"features"),
            *(_field(5, tensor) for tensor in self._tensors),
            _field(11, _value("image", (1, *self._image))),
            _field(12, _value(self.output, (1, *features))),
        ]
        opset = _field(1, b"") + _field(2, _OPSET)
        model = _field(1, _IR_VERSION) + _field(7, b"".join(graph)) + _field(8, opset)
        return np.frombuffer(model, np.uint8)


def _varint(number: int) -> bytes:
    """Encodes seven bits per byte, lowest first; the top bit marks that more follow."""
    low = bytearray()
    while number > 127:
        low.append(number & 127 | 128)
        number >>= 7
    return bytes([*low, number])


def _field(number: int, value: int | float | bytes) -> bytes:
    """Encodes a field of a message: an integer, a single-precision number, or bytes."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    if isinstance(value, float):
        return _varint(number << 3 | 5) + struct.pack("<f", value)
    return _varint(number << 3 | 2) + _varint(len(value)) + value


def _attribute(name: str, value: int | float | list[int]) -> bytes:
    """Encodes an AttributeProto."""
    message = _field(1, name.encode())
    if isinstance(value, list):
        return message + b"".join(_field(8, number) for number in value) + _field(20, _INTS)
    if isinstance(value, float):
        return message + _field(2, value) + _field(20, _FLOAT)
    return message + _field(3, value) + _field(20, _INT)


def _value(name: str, shape: Sequence[int]) -> bytes:
    """Encodes a ValueInfoProto."""
    sizes = b"".join(_field(1, _field(1, size)) for size in shape)
    tensor = _field(1, _FLOAT) + _field(2, sizes)
    return _field(1, name.encode()) + _field(2, _field(1, tensor))
