"""Nearest depths in a coarse grid from one colour image: what the network is told, and its layers.

Each pixel comes with its ray in the heading frame, so that the network knows where the horizon is,
however the vehicle leans.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from splatpilot.systems.policies.convolutions import LEAK
from splatpilot.systems.policies.observation import heading_frame
from splatpilot.systems.policies.onnx_model import OnnxModel

WIDTH, HEIGHT = 160, 90  # [px], of what is looked at
FOV_X = 90.0  # [deg]
CHANNELS = 6
"""Of what the network takes: red, green, blue, and a ray."""


@dataclass(frozen=True)
class MonocularSpec:
    """The architecture: residual blocks at a fifth and at a tenth of the image's size.

    A block adds to its input a convolution of 3x3, dilated, and one of 1x1.
    """

    fine_channels: int = 32
    fine_dilations: tuple[int, ...] = (1, 2)
    coarse_channels: int = 64
    coarse_dilations: tuple[int, ...] = (1, 2, 4, 1, 2, 4)

    def layers(self) -> "list[Layer]":
        """First to last."""
        fine, coarse = self.fine_channels, self.coarse_channels
        layers = [Layer("stem", CHANNELS, fine, 7, stride=5)]
        for i, dilation in enumerate(self.fine_dilations):
            layers += _block(f"fine.{i}", fine, dilation)
        layers.append(Layer("halving", fine, coarse, 3, stride=2))
        for i, dilation in enumerate(self.coarse_dilations):
            layers += _block(f"coarse.{i}", coarse, dilation)
        return [*layers, Layer("head", coarse, 2, 1, rectified=False)]

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """The name and shape of every array of weights."""
        shapes: dict[str, tuple[int, ...]] = {}
        for layer in self.layers():
            shape = (layer.outputs, layer.inputs, layer.kernel, layer.kernel)
            shapes[f"{layer.name}.weight"] = shape
            shapes[f"{layer.name}.bias"] = (layer.outputs,)
        return shapes


@dataclass(frozen=True)
class Layer:
    """A convolution with bias, padded by half its kernel times its dilation."""

    name: str
    inputs: int
    outputs: int
    kernel: int
    stride: int = 1
    dilation: int = 1
    rectified: bool = True
    """Whether a leaky rectifier follows."""
    adds_to_block: bool = False
    """Whether what the layer before the last one took is added."""


def _block(name: str, channels: int, dilation: int) -> list[Layer]:
    return [
        Layer(f"{name}.0", channels, channels, 3, dilation=dilation),
        Layer(f"{name}.1", channels, channels, 1, rectified=False, adds_to_block=True),
    ]


class MonocularDepth:
    """The network with its weights, run by OpenCV: the same bits on any number of its threads.

    Args:
        spec: the architecture.
        weights: arrays by the names of `MonocularSpec.weight_shapes`, single precision.
    """

    def __init__(self, spec: MonocularSpec, weights: Mapping[str, np.ndarray]) -> None:
        model, before = OnnxModel((CHANNELS, HEIGHT, WIDTH)), []
        for layer in spec.layers():
            before.append(model.output)
            weight, bias = weights[f"{layer.name}.weight"], weights[f"{layer.name}.bias"]
            model.convolution(weight, bias, stride=layer.stride, dilation=layer.dilation)
            if layer.rectified:
                model.leaky_relu(LEAK)
            if layer.adds_to_block:
                model.add(before[-2])
        self._net = cv2.dnn.readNetFromONNX(model.serialize((2, 9, 16)))

    def __call__(self, view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inverse depths (9, 16), as `inverse_depth` has them, and the logarithms of their expected
        absolute errors, of a view (6, 90, 160), see `encode_view`."""
        self._net.setInput(view[None])
        inverse, log_error = self._net.forward()[0]
        return inverse, log_error


def encode_view(color: np.ndarray, R_WB: np.ndarray) -> np.ndarray:
    """What the network takes (6, 90, 160): colours of -1 to 1, and the pixels' rays in the heading
    frame.

    Args:
        color: (H, 160, 3) uint8 of a camera of 90 degrees; its middle 90 rows are looked at.
        R_WB: (3, 3) attitude.

    Raises:
        ValueError: for an image of another width, or without 90 rows in its middle.
    """
    H, W = color.shape[:2]
    require_view(W, H)
    first = (H - HEIGHT) // 2
    view = np.empty((CHANNELS, HEIGHT, WIDTH), np.float32)
    view[:3] = color[first : first + HEIGHT].transpose(2, 0, 1) * np.float32(1.0 / 127.5)
    view[:3] -= np.float32(1.0)
    R_HB = (heading_frame(R_WB).T @ R_WB).astype(np.float32)
    view[3:] = (R_HB @ rays_B().reshape(-1, 3).T).reshape(3, HEIGHT, WIDTH)
    return view


def require_view(width: int, height: int) -> None:
    """Raises ValueError unless images of this size [px] have the pixels that are looked at."""
    if width != WIDTH or height < HEIGHT or height % 2:
        raise ValueError(
            f"the colour image has {width}x{height} pixels, but this policy looks at the middle "
            f"{WIDTH}x{HEIGHT}; give its camera a width of {WIDTH} and an even height of at least "
            f"{HEIGHT}"
        )


def rays_B() -> np.ndarray:
    """Unit vectors (90, 160, 3), float32, through the pixels in the body frame, of a camera that
    looks along body x."""
    focal = 0.5 * WIDTH / np.tan(np.deg2rad(0.5 * FOV_X))
    y = (0.5 * WIDTH - 0.5 - np.arange(WIDTH)) / focal
    z = (0.5 * HEIGHT - 0.5 - np.arange(HEIGHT)) / focal
    rays = np.ones((HEIGHT, WIDTH, 3))
    rays[..., 1], rays[..., 2] = y, z[:, None]
    return (rays / np.linalg.norm(rays, axis=2, keepdims=True)).astype(np.float32)
