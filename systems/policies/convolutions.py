"""Small convolutional encoders of depth images, in numpy, as torch's Conv2d trains them."""

from collections.abc import Mapping, Sequence

import numpy as np

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
