"""A small recurrent network from a depth image and a state to a command, in numpy.

Convolutions of the image, a linear layer of the state, a gated recurrent unit and a linear head, as
torch trains them (`torch.nn.Conv2d`, `Linear`, `GRUCell`, with their names and layouts of weights).
One step costs a fraction of a millisecond, and the same input gives the same bits.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

LEAK = 0.05
"""Slope of the rectifiers for negative numbers."""


@dataclass(frozen=True)
class NetworkSpec:
    """The architecture."""

    image_height: int
    image_width: int
    convolutions: tuple[tuple[int, int, int, int], ...]
    """Channels, kernel width, stride and padding of each, first to last."""
    state_size: int
    state_features: int
    hidden_size: int
    output_size: int

    def image_sizes(self) -> list[tuple[int, int, int]]:
        """Channels, height and width of the image and after each convolution."""
        sizes = [(1, self.image_height, self.image_width)]
        for channels, kernel, stride, padding in self.convolutions:
            height, width = ((s + 2 * padding - kernel) // stride + 1 for s in sizes[-1][1:])
            sizes.append((channels, height, width))
        return sizes

    def image_features(self) -> int:
        """Numbers after the last convolution."""
        return int(np.prod(self.image_sizes()[-1]))

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """The name and shape of every array of weights."""
        shapes: dict[str, tuple[int, ...]] = {}
        inputs = 1
        for i, (channels, kernel, _, _) in enumerate(self.convolutions):
            shapes[f"convolutions.{i}.weight"] = (channels, inputs, kernel, kernel)
            shapes[f"convolutions.{i}.bias"] = (channels,)
            inputs = channels
        H = self.hidden_size
        shapes["state_layer.weight"] = (self.state_features, self.state_size)
        shapes["state_layer.bias"] = (self.state_features,)
        shapes["memory.weight_ih"] = (3 * H, self.image_features() + self.state_features)
        shapes["memory.weight_hh"] = (3 * H, H)
        shapes["memory.bias_ih"] = shapes["memory.bias_hh"] = (3 * H,)
        shapes["head.weight"], shapes["head.bias"] = (self.output_size, H), (self.output_size,)
        return shapes

    def to_dict(self) -> dict:
        """As what JSON can hold."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict) -> "NetworkSpec":
        """The inverse of `to_dict`."""
        convolutions = tuple(tuple(layer) for layer in values["convolutions"])
        return cls(**{**values, "convolutions": convolutions})


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
        for name, shape in spec.weight_shapes().items():
            if name not in weights or weights[name].shape != shape:
                found = weights[name].shape if name in weights else "missing"
                raise ValueError(f"the weights {name} are {found}, but must be of shape {shape}")
            if not np.isfinite(weights[name]).all():
                raise ValueError(f"the weights {name} are not all finite")
        own = {name: np.asarray(weights[name], np.float32) for name in spec.weight_shapes()}
        self._layers = []
        sizes = spec.image_sizes()
        for i, (channels, kernel, stride, padding) in enumerate(spec.convolutions):
            filters = own[f"convolutions.{i}.weight"].reshape(channels, -1).T.copy()
            patches = _patches(sizes[i], sizes[i + 1], kernel, stride, padding)
            self._layers.append((patches, padding, filters, own[f"convolutions.{i}.bias"]))
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
        x = np.asarray(image, np.float32)[None]
        for patches, padding, filters, bias in self._layers:
            padded = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
            x = _rectified(padded.take(patches) @ filters + bias)  # (height, width, channels)
            x = x.transpose(2, 0, 1)
        state = np.asarray(state, np.float32)
        features = _rectified(w["state_layer.weight"] @ state + w["state_layer.bias"])
        features = np.concatenate([x.ravel(), features])
        H = spec.hidden_size
        from_input = w["memory.weight_ih"] @ features + w["memory.bias_ih"]
        from_memory = w["memory.weight_hh"] @ hidden + w["memory.bias_hh"]
        reset, update = _sigmoid((from_input + from_memory)[: 2 * H]).reshape(2, H)
        new = np.tanh(from_input[2 * H :] + reset * from_memory[2 * H :])
        hidden = ((1 - update) * new + update * hidden).astype(np.float32)
        return w["head.weight"] @ hidden + w["head.bias"], hidden


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


def _rectified(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, np.float32(LEAK) * x)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * np.tanh(0.5 * x) + 0.5
