"""A small recurrent network from a depth image and a state to a command, in numpy.

Convolutions of the image, a linear layer of the state, a gated recurrent unit and a linear head,
with the names and layouts of weights of `torch.nn.Conv2d`, `Linear` and `GRUCell`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod

import cv2
import numpy as np

from splatpilot.systems.policies.checkpoint import (
    OnnxModel,
    PolicyCheckpoint,
    check_weights,
    linear_shapes,
    require_shape,
)

LEAK = 0.05
"""Slope of the leaky ReLU for negative numbers."""

Layer = tuple[int, int, int, int]
"""Channels, width of the kernel, stride and padding of a convolution."""


class Convolutions:
    """Convolutions, each followed by a leaky ReLU, run by OpenCV.

    Args:
        image: channels, height and width of the input.
        layers: first to last.
        weights: arrays by the names of `convolution_shapes`, single precision.
    """

    def __init__(
        self,
        image: tuple[int, int, int],
        layers: Sequence[Layer],
        weights: Mapping[str, np.ndarray],
    ) -> None:
        model = OnnxModel(image)
        for i, (_, _, stride, padding) in enumerate(layers):
            weight, bias = (weights[f"convolutions.{i}.{part}"] for part in ("weight", "bias"))
            model.convolution(weight, bias, stride=stride, padding=padding)
            model.add("LeakyRelu", alpha=LEAK)
        self._net = cv2.dnn.readNetFromONNX(model.serialize(layer_sizes(image, layers)[-1]))

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Computes the features (F,) of an image (height, width)."""
        self._net.setInput(np.asarray(image, np.float32)[None, None])
        return self._net.forward().ravel()


def convolution_shapes(layers: Sequence[Layer]) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of weights by name of convolutions of an image of one channel."""
    shapes: dict[str, tuple[int, ...]] = {}
    inputs = 1
    for i, (channels, kernel, _, _) in enumerate(layers):
        shapes[f"convolutions.{i}.weight"] = (channels, inputs, kernel, kernel)
        shapes[f"convolutions.{i}.bias"] = (channels,)
        inputs = channels
    return shapes


def layer_sizes(image: tuple[int, int, int], layers: Sequence[Layer]) -> list[tuple[int, int, int]]:
    """Computes channels, height and width of the image and after each convolution."""
    sizes = [image]
    for channels, kernel, stride, padding in layers:
        height, width = ((size + 2 * padding - kernel) // stride + 1 for size in sizes[-1][1:])
        sizes.append((channels, height, width))
    return sizes


def leaky_relu(x: np.ndarray) -> np.ndarray:
    """Multiplies negative numbers by `LEAK`."""
    return np.maximum(x, np.float32(LEAK) * x)


@dataclass(frozen=True)
class NetworkSpec:
    """Architecture of the network."""

    image_height: int
    image_width: int
    convolutions: tuple[Layer, ...]
    state_size: int
    state_features: int
    hidden_size: int
    output_size: int

    def image_features(self) -> int:
        """Returns the number of outputs of the last convolution."""
        return prod(layer_sizes((1, self.image_height, self.image_width), self.convolutions)[-1])

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Returns the shapes of all arrays of weights by name."""
        H, inputs = self.hidden_size, self.image_features() + self.state_features
        shapes = convolution_shapes(self.convolutions)
        shapes |= linear_shapes(
            ("state_layer", self.state_size, self.state_features), ("head", H, self.output_size)
        )
        shapes |= {"memory.weight_ih": (3 * H, inputs), "memory.weight_hh": (3 * H, H)}
        return shapes | {"memory.bias_ih": (3 * H,), "memory.bias_hh": (3 * H,)}


class RecurrentNetwork:
    """The network with its weights, by the names of `NetworkSpec.weight_shapes`."""

    def __init__(self, spec: NetworkSpec, weights: Mapping[str, np.ndarray]) -> None:
        self.spec = spec
        self._weights = check_weights(weights, spec.weight_shapes())
        image = 1, spec.image_height, spec.image_width
        self._convolutions = Convolutions(image, spec.convolutions, self._weights)

    def initial_hidden(self) -> np.ndarray:
        """Returns the hidden state (H,) before the first image."""
        return np.zeros(self.spec.hidden_size, np.float32)

    def step(
        self, image: np.ndarray, state: np.ndarray, hidden: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Computes the output (O,) and the next hidden state (H,).

        Args:
            image: (height, width), encoded depth.
            state: (S,).
            hidden: (H,), the hidden state.
        """
        spec, w, H = self.spec, self._weights, self.spec.hidden_size
        require_shape("image", image, (spec.image_height, spec.image_width))
        require_shape("state", state, (spec.state_size,))
        require_shape("hidden state", hidden, (H,))
        x = self._convolutions(image)
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
