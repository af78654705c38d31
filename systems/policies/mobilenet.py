"""MobileNetV2, the encoder of images, without torch: its layers, and its forward pass by OpenCV.

After "MobileNetV2: Inverted Residuals and Linear Bottlenecks" (M. Sandler et al., CVPR 2018), of
width 1. Layers have the names of torchvision's, in which each batch norm is a bias alone: the rest
of it is folded into the convolution before.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from splatpilot.systems.policies.onnx_model import OnnxModel

BLOCKS = 19
"""Modules of the encoder, the first and the last a single convolution."""

CHANNELS = 1280
"""Of its output, which has a 32nd of the image's height and width, rounded up."""

_STAGES = (
    (1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2),
    (6, 320, 1, 1),
)  # fmt: skip
"""Expansion, channels, blocks and first stride of each stage between the first and last."""


@dataclass(frozen=True)
class Convolution:
    """A convolution with bias."""

    weight: str
    """Name of its weights (outputs, inputs / groups, kernel, kernel)."""
    bias: str
    """Name of its biases (outputs,)."""
    inputs: int
    outputs: int
    kernel: int = 1
    stride: int = 1
    groups: int = 1
    rectified: bool = True
    """Whether its output is limited to 0 to 6."""

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The name and shape of its arrays of weights."""
        shape = (self.outputs, self.inputs // self.groups, self.kernel, self.kernel)
        return {self.weight: shape, self.bias: (self.outputs,)}


def mobilenet_blocks() -> list[list[Convolution]]:
    """The convolutions of each of the `BLOCKS` modules.

    A module of several whose input and output have the same shape adds its input to its output.
    """

    def of(prefix: str, *numbers, **options) -> Convolution:
        return Convolution(f"{prefix}.0.weight", f"{prefix}.1.bias", *numbers, **options)

    blocks = [[of("features.0", 3, 32, 3, 2)]]
    inputs = 32
    for expansion, outputs, count, first_stride in _STAGES:
        for i in range(count):
            name, hidden = f"features.{len(blocks)}.conv", expansion * inputs
            stride = first_stride if i == 0 else 1
            block = [of(f"{name}.0", inputs, hidden)] if expansion > 1 else []
            n = len(block)
            block.append(of(f"{name}.{n}", hidden, hidden, 3, stride, hidden))
            weight, bias = f"{name}.{n + 1}.weight", f"{name}.{n + 2}.bias"
            block.append(Convolution(weight, bias, hidden, outputs, rectified=False))
            blocks.append(block)
            inputs = outputs
    return [*blocks, [of("features.18", inputs, CHANNELS)]]


def adds_input(block: list[Convolution]) -> bool:
    """Whether a module adds its input to its output."""
    same = block[0].inputs == block[-1].outputs and all(c.stride == 1 for c in block)
    return len(block) > 1 and same


def mobilenet_shapes() -> dict[str, tuple[int, ...]]:
    """The name and shape of every array of weights."""
    return {k: v for block in mobilenet_blocks() for c in block for k, v in c.shapes().items()}


class MobileNet:
    """The encoder with its weights, run by OpenCV: the same bits on any number of its threads.

    Args:
        height, width: of the images [px].
        weights: arrays by the names of `mobilenet_shapes`, single precision.
    """

    def __init__(self, height: int, width: int, weights: Mapping[str, np.ndarray]) -> None:
        model = OnnxModel((3, height, width))
        for block in mobilenet_blocks():
            before = model.output
            for layer in block:
                weight, bias = weights[layer.weight], weights[layer.bias]
                model.convolution(weight, bias, stride=layer.stride, groups=layer.groups)
                if layer.rectified:
                    model.clip(0.0, 6.0)
            if adds_input(block):
                model.add(before)
        features = CHANNELS, -(-height // 32), -(-width // 32)
        self._net = cv2.dnn.readNetFromONNX(model.serialize(features))

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """The features (CHANNELS, h, w) of an image (3, height, width) of numbers -1 to 1."""
        self._net.setInput(np.ascontiguousarray(image[None], np.float32))
        return self._net.forward()[0]
