"""A small recurrent network from a depth image and a state to a command, in numpy.

Convolutions of the image, a linear layer of the state, a gated recurrent unit and a linear head,
with the names and layouts of weights of `torch.nn.Conv2d`, `Linear` and `GRUCell`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod

import numpy as np

from splatpilot.systems.policies.checkpoint import (
    PolicyCheckpoint,
    check_weights,
    linear_shapes,
    require_shape,
)
from splatpilot.systems.policies.convolutions import (
    LEAK,
    Convolution,
    convolution_shapes,
    opencv_net,
    output_size,
)

DepthLayer = tuple[int, int, int, int]
"""Channels, width of the kernel, stride and padding of a convolution."""


def depth_layers(layers: Sequence[DepthLayer], channels: int = 1) -> list[Convolution]:
    """Returns convolutions of an image of `channels`, each followed by a leaky ReLU."""
    convolutions, inputs = [], channels
    for i, (outputs, kernel, stride, padding) in enumerate(layers):
        weight, bias = f"convolutions.{i}.weight", f"convolutions.{i}.bias"
        sizes = inputs, outputs, kernel, stride
        layer = Convolution(weight, bias, *sizes, activation="leaky_relu", pad=padding)
        convolutions.append(layer)
        inputs = outputs
    return convolutions


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
        """Lists the convolutions, first to last."""
        return depth_layers(self.convolutions, self.image_channels)


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

    image_height: int
    image_width: int
    convolutions: tuple[DepthLayer, ...]
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
    """The network with its weights, by the names of `NetworkSpec.weight_shapes`."""

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
