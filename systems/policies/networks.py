"""Networks of policies: convolutions that OpenCV runs, and a recurrent network in numpy.

Weights have the names and layouts of `torch.nn.Conv2d`, `Linear` and `GRUCell`. The ONNX model of
convolutions, a protocol buffer (https://onnx.ai/onnx/repo-docs/IR.html), is written here, which
keeps the onnx package out of training and flight. Field numbers are those of onnx.proto.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import cv2
import numpy as np

from splatpilot.systems.policies.checkpoint import (
    PolicyCheckpoint,
    check_weights,
    linear_shapes,
    require_shape,
)

LEAK = 0.05  # slope of the leaky ReLU for negative numbers

_ACTIVATIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "relu6": ("Clip", {"min": 0.0, "max": 6.0}),
    "leaky_relu": ("LeakyRelu", {"alpha": LEAK}),
}

_IR_VERSION, _OPSET = 5, 10  # In this version of operators, Clip has its limits as attributes.
_FLOAT, _INT, _INTS = 1, 2, 7  # AttributeProto.type; TensorProto.DataType FLOAT is 1 too.


@dataclass(frozen=True)
class Convolution:
    """A convolution with bias."""

    weight: str  # name of its weights (outputs, inputs / groups, kernel, kernel)
    bias: str  # name of its biases (outputs,)
    inputs: int
    outputs: int
    kernel: int = 1
    stride: int = 1
    groups: int = 1
    dilation: int = 1
    activation: str = ""  # relu6 or leaky_relu
    skip: int = 0  # If > 0, adds the input of the layer `skip` - 1 before this one.
    pad: int | None = None  # by default half the kernel times the dilation

    @property
    def padding(self) -> int:
        """Width [px] of the border of zeros."""
        return self.dilation * (self.kernel // 2) if self.pad is None else self.pad


def convolution_shapes(layers: Sequence[Convolution]) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of all arrays of weights by name."""
    shapes: dict[str, tuple[int, ...]] = {}
    for layer in layers:
        kernel = layer.kernel, layer.kernel
        shapes[layer.weight] = layer.outputs, layer.inputs // layer.groups, *kernel
        shapes[layer.bias] = (layer.outputs,)
    return shapes


def output_size(image: tuple[int, int, int], layers: Sequence[Convolution]) -> tuple[int, int, int]:
    """Computes channels, height and width of the output for those of the image."""
    channels, height, width = image
    for layer in layers:
        margin = 2 * layer.padding - layer.dilation * (layer.kernel - 1) - 1
        height, width = ((size + margin) // layer.stride + 1 for size in (height, width))
        channels = layer.outputs
    return channels, height, width


def opencv_net(
    image: tuple[int, int, int],
    layers: Sequence[Convolution],
    weights: Mapping[str, np.ndarray],
) -> cv2.dnn.Net:
    """Makes the network of `layers`, first to last, for images of these channels, height and width;
    `weights` are by the names of `convolution_shapes`."""
    nodes, tensors, inputs, output = [], [], [], "image"

    def add(operator: str, *names: str, **attributes: Any) -> str:
        result = f"{operator.lower()}{len(nodes)}"
        node = [_field(1, name.encode()) for name in names]
        node += [_field(2, result.encode()), _field(4, operator.encode())]
        node += [_field(5, _attribute(name, value)) for name, value in attributes.items()]
        nodes.append(_field(1, b"".join(node)))
        return result

    for layer in layers:
        inputs.append(output)
        for name in (layer.weight, layer.bias):
            values = np.ascontiguousarray(weights[name], "<f4")
            shape = b"".join(_field(1, size) for size in values.shape)
            tensor = _field(2, _FLOAT) + _field(8, name.encode()) + _field(9, values.tobytes())
            tensors.append(_field(5, shape + tensor))
        output = add(
            "Conv",
            *(output, layer.weight, layer.bias),
            kernel_shape=[layer.kernel] * 2,
            strides=[layer.stride] * 2,
            pads=[layer.padding] * 4,
            dilations=[layer.dilation] * 2,
            group=layer.groups,
        )
        if layer.activation:
            operator, attributes = _ACTIVATIONS[layer.activation]
            output = add(operator, output, **attributes)
        if layer.skip:
            output = add("Add", output, inputs[-layer.skip])
    ends = (
        _field(11, _value("image", image)),
        _field(12, _value(output, output_size(image, layers))),
    )
    graph = b"".join([*nodes, _field(2, b"features"), *tensors, *ends])
    opset = _field(1, b"") + _field(2, _OPSET)
    model = _field(1, _IR_VERSION) + _field(7, graph) + _field(8, opset)
    return cv2.dnn.readNetFromONNX(np.frombuffer(model, np.uint8))


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


def _value(name: str, size: tuple[int, int, int]) -> bytes:
    """Encodes the ValueInfoProto of one image."""
    sizes = b"".join(_field(1, _field(1, length)) for length in (1, *size))
    tensor = _field(1, _FLOAT) + _field(2, sizes)
    return _field(1, name.encode()) + _field(2, _field(1, tensor))


DepthLayer = tuple[int, int, int, int]
"""Channels, width of the kernel, stride and padding of a convolution."""


@dataclass(frozen=True)
class DepthSpec:
    """Base class of architectures with convolutions of a depth image."""

    image_channels = 1
    image_height: int
    image_width: int
    convolutions: tuple[DepthLayer, ...]

    def image_size(self) -> tuple[int, int, int]:
        """Returns channels, height and width of the image."""
        return self.image_channels, self.image_height, self.image_width

    def image_outputs(self) -> int:
        """Returns the number of outputs of the last convolution."""
        return prod(output_size(self.image_size(), self.image_layers()))

    def image_layers(self) -> list[Convolution]:
        """Lists the convolutions, first to last, each followed by a leaky ReLU."""
        layers, inputs = [], self.image_channels
        for i, (outputs, kernel, stride, pad) in enumerate(self.convolutions):
            weight, bias = f"convolutions.{i}.weight", f"convolutions.{i}.bias"
            sizes = inputs, outputs, kernel, stride
            layers.append(Convolution(weight, bias, *sizes, activation="leaky_relu", pad=pad))
            inputs = outputs
        return layers


class DepthEncoder:
    """The convolutions of a `DepthSpec` with their weights."""

    def __init__(self, spec: DepthSpec, weights: Mapping[str, np.ndarray]) -> None:
        self._net = opencv_net(spec.image_size(), spec.image_layers(), weights)
        channels, *size = self._size = spec.image_size()
        self._shape = tuple(size) if channels == 1 else self._size

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Computes the features (F,) of an image (height, width), or of several channels."""
        require_shape("image", image, self._shape)
        self._net.setInput(np.asarray(image, np.float32).reshape(1, *self._size))
        return self._net.forward().ravel()


def leaky_relu(x: np.ndarray) -> np.ndarray:
    """Multiplies negative numbers by `LEAK`."""
    return np.maximum(x, np.float32(LEAK) * x)


@dataclass(frozen=True)
class NetworkSpec(DepthSpec):
    """Architecture of the network."""

    state_size: int
    state_features: int
    hidden_size: int
    output_size: int

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Returns the shapes of all arrays of weights by name."""
        H, inputs = self.hidden_size, self.image_outputs() + self.state_features
        shapes = convolution_shapes(self.image_layers())
        shapes |= linear_shapes(("state_layer", self.state_size, self.state_features))
        shapes |= {"memory.weight_ih": (3 * H, inputs), "memory.weight_hh": (3 * H, H)}
        shapes |= {"memory.bias_ih": (3 * H,), "memory.bias_hh": (3 * H,)}
        return shapes | linear_shapes(("head", H, self.output_size))


class RecurrentNetwork:
    """Convolutions of an image, a linear layer of the state, a gated recurrent unit and a linear
    head, with their weights, by the names of `NetworkSpec.weight_shapes`."""

    def __init__(self, spec: NetworkSpec, weights: Mapping[str, np.ndarray]) -> None:
        self.spec = spec
        self._weights = check_weights(weights, spec.weight_shapes())
        self._encoder = DepthEncoder(spec, self._weights)

    def initial_hidden(self) -> np.ndarray:
        """Returns the hidden state (H,) before the first image."""
        return np.zeros(self.spec.hidden_size, np.float32)

    def step(
        self, image: np.ndarray, state: np.ndarray, hidden: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Computes the output (O,) and the next hidden state (H,) from the image of the encoder, a
        state (S,) and the hidden state (H,)."""
        spec, w, H = self.spec, self._weights, self.spec.hidden_size
        require_shape("state", state, (spec.state_size,))
        require_shape("hidden state", hidden, (H,))
        x = self._encoder(image)
        state, hidden = np.asarray(state, np.float32), np.asarray(hidden, np.float32)
        features = leaky_relu(w["state_layer.weight"] @ state + w["state_layer.bias"])
        features = np.concatenate([x, features])
        from_input = w["memory.weight_ih"] @ features + w["memory.bias_ih"]
        from_hidden = w["memory.weight_hh"] @ hidden + w["memory.bias_hh"]
        gates = 0.5 * np.tanh(0.5 * (from_input + from_hidden)[: 2 * H]) + 0.5  # sigmoid
        reset, update = gates.reshape(2, H)
        new = np.tanh(from_input[2 * H :] + reset * from_hidden[2 * H :])
        hidden = ((1 - update) * new + update * hidden).astype(np.float32)
        return w["head.weight"] @ hidden + w["head.bias"], hidden


def load_network(path: str | None, policy: str, spec: NetworkSpec) -> RecurrentNetwork:
    """Loads the network of `policy` from a file, see `PolicyCheckpoint.load`."""
    return PolicyCheckpoint.load(path, policy, spec).build(RecurrentNetwork)
