"""Convolutional networks as ONNX models, which OpenCV runs: written by hand, so that neither
training nor flying needs the onnx package.

A model is a protocol buffer (https://onnx.ai/onnx/repo-docs/IR.html); the numbers of its fields
below are those of onnx.proto.
"""

import struct
from collections.abc import Sequence

import numpy as np

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
