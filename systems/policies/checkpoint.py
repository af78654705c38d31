"""Files of trained policies: weights, architecture and how they were made, in one .npz."""

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import read_archive, reason_of

FORMAT = 1
"""Of the file; observations and commands that mean something else make another number."""

_LARGEST = 1e6  # A sum of products with what is seen does not leave single precision.

_SHIPPED = Path(__file__).parent / "weights"


@dataclass(frozen=True, eq=False)
class PolicyCheckpoint:
    """What a file holds."""

    policy: str
    """Name of the policy, as in the benchmark."""
    spec: Any
    """Architecture of the network, a dataclass."""
    weights: Mapping[str, np.ndarray]
    provenance: dict[str, Any]
    """How it was made: command, config, seed, revision and success, as what JSON can hold."""
    path: Path | None = None
    """The file, if it was read from one."""

    def build[Network](self, make: Callable[[Any, dict[str, np.ndarray]], Network]) -> Network:
        """The network that `make` makes of the architecture and the weights.

        Raises:
            ValueError: for weights that it refuses; the message names the file.
        """
        try:
            return make(self.spec, dict(self.weights))
        except ValueError as error:
            raise ValueError(
                f"{self.path}: {error}; train them with: splatpilot train {self.policy} --out DIR"
            ) from None

    def save(self, path: Path) -> None:
        """Writes `path`, whole or not at all."""
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
        """Reads the weights of `policy` from a file, those that ship if `path` is None or empty.

        Args:
            spec: the architecture that the file must be of, or the type of those it may be of.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is damaged, or of another policy, version or architecture.
        """
        path = Path(path) if path else shipped_weights(policy)
        remedy = f"train them with: splatpilot train {policy} --out DIR"
        about, weights = _read(path, remedy)
        found_format, found_policy = about["format"], about["policy"]
        found_spec, provenance = about["spec"], about["provenance"]
        if (found_format, found_policy) != (FORMAT, policy):
            raise ValueError(
                f"{path} holds weights of the policy {found_policy!r} in format {found_format}, "
                f"but needed is {policy!r} in format {FORMAT}; {remedy}"
            )
        if isinstance(spec, type):
            try:
                return cls(policy, spec(**found_spec), weights, provenance, path)
            except (TypeError, ValueError) as error:
                raise ValueError(
                    f"{path} holds weights of another architecture ({error}); {remedy}"
                ) from None
        expected = json.loads(json.dumps(asdict(spec)))
        if found_spec != expected:
            differing = [
                f"{name} {found_spec.get(name)} instead of {value}"
                for name, value in expected.items()
                if found_spec.get(name) != value
            ]
            raise ValueError(
                f"{path} holds weights of another architecture ({', '.join(differing)}); {remedy}"
            )
        return cls(policy, spec, weights, provenance, path)


def shipped_weights(name: str) -> Path:
    """The file of weights that ships under the name of a policy."""
    return _SHIPPED / f"{name}.npz"


def policy_of(path: str | Path) -> str:
    """The name of the policy that a file holds weights of.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it holds no weights.
    """
    return _read(Path(path), "train some with: splatpilot train POLICY --out DIR")[0]["policy"]


def _read(path: Path, remedy: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What a file says of itself, and its weights."""
    if not path.is_file():
        raise FileNotFoundError(f"there are no weights at {path}; {remedy}")
    try:
        weights = read_archive(path)
        about = json.loads(str(weights.pop("about")))
    except (OSError, ValueError, KeyError, RecursionError) as error:
        reason = reason_of(error)
        raise ValueError(f"{path} holds no weights of a policy ({reason}); {remedy}") from None
    about = about if isinstance(about, dict) else {}
    for name, kind in (("format", int), ("policy", str), ("spec", dict), ("provenance", dict)):
        if not isinstance(about.get(name), kind):
            raise ValueError(f"{path} holds no weights of a policy (no {name}); {remedy}")
    return about, weights


def check_weights(
    weights: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """The arrays that `shapes` names, in single precision.

    Raises:
        ValueError: if one is missing, of another shape or not finite.
    """
    for name, shape in shapes.items():
        if name not in weights or weights[name].shape != shape:
            found = weights[name].shape if name in weights else "missing"
            raise ValueError(f"the weights {name} are {found}, but must be of shape {shape}")
        values = weights[name]
        if values.dtype.kind != "f" or not (np.abs(values.astype(float)) <= _LARGEST).all():
            raise ValueError(f"the weights {name} are not all finite numbers up to {_LARGEST:g}")
    return {name: np.asarray(weights[name], np.float32) for name in shapes}


# Convolutional networks as ONNX models, which OpenCV runs: written by hand, so that neither
# training nor flying needs the onnx package.
#
# A model is a protocol buffer (https://onnx.ai/onnx/repo-docs/IR.html); the numbers of its fields
# below are those of onnx.proto.


_IR_VERSION, _OPSET = 5, 10
"""Of the format and of the operators; in these Clip has its limits as attributes."""

_FLOAT, _INTS = 1, 7  # AttributeProto.type; TensorProto.DataType FLOAT is 1 too


class OnnxModel:
    """A graph from one image to its features, to which operators are added from first to last.

    Args:
        image: channels, height and width of the input.
    """

    def __init__(self, image: tuple[int, int, int]) -> None:
        self._image = image
        self._nodes: list[bytes] = []
        self._tensors: list[bytes] = []
        self.output = "image"
        """The name of what the last operator gives."""

    def convolution(
        self,
        weight: np.ndarray,
        bias: np.ndarray,
        *,
        stride: int = 1,
        groups: int = 1,
        dilation: int = 1,
    ) -> None:
        """Convolves (N, C, H, W) by `weight` (outputs, C / groups, k, k), k odd, padded by k // 2
        times the dilation, and adds `bias` (outputs,)."""
        name, kernel = f"convolution{len(self._nodes)}", weight.shape[2]
        for part, values in (("weight", weight), ("bias", bias)):
            self._tensors.append(_tensor(f"{name}.{part}", values))
        attributes = {
            "kernel_shape": [kernel] * 2,
            "strides": [stride] * 2,
            "pads": [dilation * (kernel // 2)] * 4,
            "dilations": [dilation] * 2,
            "group": groups,
        }
        self._add("Conv", [self.output, f"{name}.weight", f"{name}.bias"], attributes)

    def clip(self, least: float, most: float) -> None:
        """Limits all numbers."""
        self._add("Clip", [self.output], {"min": least, "max": most})

    def leaky_relu(self, slope: float) -> None:
        """Multiplies negative numbers by `slope`."""
        self._add("LeakyRelu", [self.output], {"alpha": slope})

    def add(self, other: str) -> None:
        """Adds what an earlier operator gave, by its name."""
        self._add("Add", [self.output, other], {})

    def serialize(self, features: tuple[int, int, int]) -> np.ndarray:
        """The model as bytes (uint8), as `cv2.dnn.readNetFromONNX` takes them.

        Args:
            features: channels, height and width of what the last operator gives.
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

    def _add(self, operator: str, inputs: Sequence[str], attributes: dict) -> None:
        self.output = f"{operator.lower()}{len(self._nodes)}"
        node = [_field(1, name.encode()) for name in inputs]
        node += [_field(2, self.output.encode()), _field(4, operator.encode())]
        node += [_field(5, _attribute(name, value)) for name, value in attributes.items()]
        self._nodes.append(b"".join(node))


def _varint(number: int) -> bytes:
    """Seven bits a byte, the lowest first; the top bit says that more follow."""
    low = bytearray()
    while number > 127:
        low.append(number & 127 | 128)
        number >>= 7
    return bytes([*low, number])


def _field(number: int, value: int | float | bytes) -> bytes:
    """A field of a message: a number, a single-precision number, or text or a message."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    if isinstance(value, float):
        return _varint(number << 3 | 5) + struct.pack("<f", value)
    return _varint(number << 3 | 2) + _varint(len(value)) + value


def _attribute(name: str, value: int | float | list[int]) -> bytes:
    """An AttributeProto."""
    message = _field(1, name.encode())
    if isinstance(value, list):
        return message + b"".join(_field(8, number) for number in value) + _field(20, _INTS)
    if isinstance(value, float):
        return message + _field(2, value) + _field(20, _FLOAT)
    return message + _field(3, value) + _field(20, 2)


def _tensor(name: str, values: np.ndarray) -> bytes:
    """A TensorProto."""
    shape = b"".join(_field(1, size) for size in values.shape)
    data = np.ascontiguousarray(values, "<f4").tobytes()
    return shape + _field(2, _FLOAT) + _field(8, name.encode()) + _field(9, data)


def _value(name: str, shape: Sequence[int]) -> bytes:
    """A ValueInfoProto."""
    sizes = b"".join(_field(1, _field(1, size)) for size in shape)
    tensor = _field(1, _FLOAT) + _field(2, sizes)
    return _field(1, name.encode()) + _field(2, _field(1, tensor))
