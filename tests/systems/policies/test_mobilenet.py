"""MobileNetV2 by OpenCV: the models it is handed over in, and its layers."""

import cv2
import numpy as np

from splatpilot.systems.policies.checkpoint import OnnxModel
from splatpilot.systems.policies.student import (
    MobileNet,
    adds_input,
    mobilenet_blocks,
    mobilenet_shapes,
)


def convolved(x: np.ndarray, weight: np.ndarray, bias: np.ndarray, stride: int) -> np.ndarray:
    """A convolution (C, H, W) with groups, by its definition."""
    outputs, within, kernel, _ = weight.shape
    pad, groups = kernel // 2, x.shape[0] // within
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    height, width = (-(-size // stride) for size in x.shape[1:])
    y = np.zeros((outputs, height, width))
    for o in range(outputs):
        first = (o // (outputs // groups)) * within
        for i in range(height):
            for j in range(width):
                patch = padded[first : first + within, i * stride :, j * stride :]
                y[o, i, j] = (patch[:, :kernel, :kernel] * weight[o]).sum() + bias[o]
    return y


def test_model_computes_what_was_put_in():
    """Convolutions with strides and groups, limits and sums give what their definitions do."""
    rng = np.random.default_rng(0)
    image = rng.normal(size=(4, 7, 9)).astype(np.float32)
    layers = [(6, 4, 3, 2, 1), (6, 1, 3, 1, 6), (6, 6, 1, 1, 1)]
    model, x = OnnxModel((4, 7, 9)), image.astype(float)
    before, y = "", x
    for n, (outputs, within, kernel, stride, groups) in enumerate(layers):
        weight = rng.normal(size=(outputs, within, kernel, kernel)).astype(np.float32)
        bias = rng.normal(size=outputs).astype(np.float32)
        model.convolution(weight, bias, stride=stride, groups=groups)
        x = convolved(x, weight, bias, stride)
        if n == 0:
            model.clip(0.0, 2.5)
            x = y = np.clip(x, 0.0, 2.5)
            before = model.output
    model.add(before)
    net = cv2.dnn.readNetFromONNX(model.serialize((6, 4, 5)))
    net.setInput(image[None])
    np.testing.assert_allclose(net.forward()[0], x + y, atol=1e-4)


def test_encoder_has_the_published_shape():
    """Seventeen bottlenecks of which ten add their input; 2.2 million weights, and 32 pixels a
    cell."""
    blocks = mobilenet_blocks()
    assert len(blocks) == 19 and sum(map(adds_input, blocks)) == 10
    shapes = [shape for block in blocks for layer in block for shape in layer.shapes().values()]
    # The encoder's part of the published 3.5 million, less a scale of batch norm a channel.
    assert sum(int(np.prod(shape)) for shape in shapes) == 2_223_872 - 17_056
    assert np.prod([layer.stride for block in blocks for layer in block]) == 32


def test_threads_change_no_bit():
    """What the encoder makes of an image does not depend on how many threads OpenCV may use."""
    rng = np.random.default_rng(0)
    weights = {
        name: rng.normal(scale=0.2, size=shape).astype(np.float32)
        for name, shape in mobilenet_shapes().items()
    }
    encoder, image = MobileNet(96, 128, weights), rng.uniform(-1, 1, (3, 96, 128))
    threads = cv2.getNumThreads()
    try:
        features = []
        for count in (1, 2, 3):
            cv2.setNumThreads(count)
            features.append(encoder(image).copy())
    finally:
        cv2.setNumThreads(threads)
    assert features[0].std() > 0.01
    assert all(np.array_equal(features[0], other) for other in features[1:])
