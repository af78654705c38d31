import numpy as np

from splatpilot.systems.policies.networks import (
    Convolution,
    convolution_shapes,
    opencv_net,
    output_size,
)


def convolved(x: np.ndarray, layer: Convolution, weights: dict[str, np.ndarray]) -> np.ndarray:
    weight, pad, dilation = weights[layer.weight].astype(float), layer.padding, layer.dilation
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    _, height, width = output_size((*x.shape,), [layer])
    y = np.zeros((layer.outputs, height, width)) + weights[layer.bias][:, None, None]
    within, per_group = weight.shape[1], layer.outputs // layer.groups
    for o, i, j in np.ndindex(layer.outputs, layer.kernel, layer.kernel):
        first = (o // per_group) * within
        rows = slice(i * dilation, i * dilation + layer.stride * (height - 1) + 1, layer.stride)
        columns = slice(j * dilation, j * dilation + layer.stride * (width - 1) + 1, layer.stride)
        y[o] += np.tensordot(weight[o, :, i, j], padded[first : first + within, rows, columns], 1)
    return y


def test_network_computes_its_definition():
    layers = [
        Convolution("a", "b", 4, 6, 3, stride=2, activation="relu6"),
        Convolution("c", "d", 6, 6, 3, groups=6, activation="leaky_relu"),
        Convolution("e", "f", 6, 6, 1, skip=2),
        Convolution("g", "h", 6, 5, 3, dilation=2),
        Convolution("i", "j", 5, 2, 3, pad=0),
    ]
    rng = np.random.default_rng(0)
    shapes = convolution_shapes(layers).items()
    weights = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes}
    image = rng.normal(size=(4, 15, 19)).astype(np.float32)
    x = first = np.clip(convolved(image, layers[0], weights), 0.0, 6.0)
    x = convolved(x, layers[1], weights)
    x = first + convolved(np.where(x > 0.0, x, 0.05 * x), layers[2], weights)
    expected = convolved(convolved(x, layers[3], weights), layers[4], weights)
    net = opencv_net((4, 15, 19), layers, weights)
    net.setInput(image[None])
    found = net.forward()[0]
    assert found.shape == expected.shape == output_size((4, 15, 19), layers) == (2, 6, 8)
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
