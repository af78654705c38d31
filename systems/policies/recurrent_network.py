"""A small recurrent network from a depth image and a state to a command, in numpy.

Convolutions of the image, a linear layer of the state, a gated recurrent unit and a linear head, as
torch trains them (`torch.nn.Conv2d`, `Linear`, `GRUCell`, with their names and layouts of weights).
One step costs a fraction of a millisecond, and the same input gives the same bits.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from splatpilot.systems.policies.checkpoint import PolicyCheckpoint, check_weights

LEAK = 0.05
"""Slope of the rectifiers for negative numbers."""

Layer = tuple[int, int, int, int]
"""Channels, width of the kernel, stride and padding of a convolution."""


class Convolutions:
    """Convolutions, each followed by a leaky rectifier.

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
        sizes = layer_sizes(image, layers)
        self._layers = []
        for i, (channels, kernel, stride, padding) in enumerate(layers):
            filters = weights[f"convolutions.{i}.weight"].reshape(channels, -1).T.copy()
            patches = _patches(sizes[i], sizes[i + 1], kernel, stride, padding)
            self._layers.append((patches, padding, filters, weights[f"convolutions.{i}.bias"]))

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """The features (F,), in torch's order, of an image (height, width)."""
        x = np.asarray(image, np.float32)[None]
        for patches, padding, filters, bias in self._layers:
            padded = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
            x = leaky_relu(padded.take(patches) @ filters + bias)  # (height, width, channels)
            x = x.transpose(2, 0, 1)
        return x.ravel()


def convolution_shapes(layers: Sequence[Layer]) -> dict[str, tuple[int, ...]]:
    """The name and shape of every array of weights of convolutions of an image of one channel."""
    shapes: dict[str, tuple[int, ...]] = {}
    inputs = 1
    for i, (channels, kernel, _, _) in enumerate(layers):
        shapes[f"convolutions.{i}.weight"] = (channels, inputs, kernel, kernel)
        shapes[f"convolutions.{i}.bias"] = (channels,)
        inputs = channels
    return shapes


def layer_sizes(image: tuple[int, int, int], layers: Sequence[Layer]) -> list[tuple[int, int, int]]:
    """Channels, height and width of the image and after each convolution."""
    sizes = [image]
    for channels, kernel, stride, padding in layers:
        height, width = ((size + 2 * padding - kernel) // stride + 1 for size in sizes[-1][1:])
        sizes.append((channels, height, width))
    return sizes


def leaky_relu(x: np.ndarray) -> np.ndarray:
    """x where positive, else x times `LEAK`."""
    return np.maximum(x, np.float32(LEAK) * x)


def _patches(
    size: tuple[int, int, int], out: tuple[int, int, int], kernel: int, stride: int, padding: int
) -> np.ndarray:
    """Flat indices (height, width, inputs * kernel²) into the padded image of a layer's patches."""
    channels, height, width = size[0], size[1] + 2 * padding, size[2] + 2 * padding
    k = np.arange(kernel)
    within = (
        (np.arange(channels) * height * width)[:, None, None] + (k * width)[:, None] + k
    ).ravel()
    first = (stride * width * np.arange(out[1]))[:, None] + stride * np.arange(out[2])
    return first[:, :, None] + within


@dataclass(frozen=True)
class NetworkSpec:
    """The architecture."""

    image_height: int
    image_width: int
    convolutions: tuple[Layer, ...]
    state_size: int
    state_features: int
    hidden_size: int
    output_size: int

    def image_features(self) -> int:
        """Numbers after the last convolution."""
        image = (1, self.image_height, self.image_width)
        return int(np.prod(layer_sizes(image, self.convolutions)[-1]))

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """The name and shape of every array of weights."""
        shapes = convolution_shapes(self.convolutions)
        H = self.hidden_size
        shapes["state_layer.weight"] = (self.state_features, self.state_size)
        shapes["state_layer.bias"] = (self.state_features,)
        shapes["memory.weight_ih"] = (3 * H, self.image_features() + self.state_features)
        shapes["memory.weight_hh"] = (3 * H, H)
        shapes["memory.bias_ih"] = shapes["memory.bias_hh"] = (3 * H,)
        shapes["head.weight"], shapes["head.bias"] = (self.output_size, H), (self.output_size,)
        return shapes


class RecurrentNetwork:
    """The network with its weights.

    Args:
        spec: the architecture.
        weights: arrays by the names of `NetworkSpec.weight_shapes`.

    Raises:
        ValueError: if an array is missing, of another shape or not finite.
    """

    def __init__(self, spec: NetworkSpec, weights: Mapping[str, np.ndarray]) -> None:
        self.spec = spec
        own = check_weights(weights, spec.weight_shapes())
        self._convolutions = Convolutions(
            (1, spec.image_height, spec.image_width), spec.convolutions, own
        )
        self._weights = own

    def initial_hidden(self) -> np.ndarray:
        """The memory (H,) before the first image."""
        return np.zeros(self.spec.hidden_size, np.float32)

    def step(
        self, image: np.ndarray, state: np.ndarray, hidden: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The output (O,) and the memory (H,) after one observation.

        Args:
            image: (height, width), encoded depth.
            state: (S,).
            hidden: (H,), the memory before.

        Raises:
            ValueError: if an argument has the wrong shape.
        """
        spec, w = self.spec, self._weights
        for name, array, shape in (
            ("image", image, (spec.image_height, spec.image_width)),
            ("state", state, (spec.state_size,)),
            ("memory", hidden, (spec.hidden_size,)),
        ):
            if np.shape(array) != shape:
                raise ValueError(
                    f"the policy's {name} has shape {np.shape(array)}, but its network takes "
                    f"{shape}"
                )
        x = self._convolutions(image)
        state, hidden = np.asarray(state, np.float32), np.asarray(hidden, np.float32)
        features = leaky_relu(w["state_layer.weight"] @ state + w["state_layer.bias"])
        features = np.concatenate([x, features])
        H = spec.hidden_size
        from_input = w["memory.weight_ih"] @ features + w["memory.bias_ih"]
        from_memory = w["memory.weight_hh"] @ hidden + w["memory.bias_hh"]
        reset, update = _sigmoid((from_input + from_memory)[: 2 * H]).reshape(2, H)
        new = np.tanh(from_input[2 * H :] + reset * from_memory[2 * H :])
        hidden = ((1 - update) * new + update * hidden).astype(np.float32)
        return w["head.weight"] @ hidden + w["head.bias"], hidden


def load_network(path: str | None, policy: str, spec: NetworkSpec) -> RecurrentNetwork:
    """The network of `policy` from a file of weights; see `PolicyCheckpoint.load`."""
    return PolicyCheckpoint.load(path, policy, spec).build(RecurrentNetwork)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * np.tanh(0.5 * x) + 0.5
