"""Depth from one colour image: what the network is told, and that it computes what it should."""

import numpy as np
import pytest
from pydrake.math import RollPitchYaw

from splatpilot.systems.policies.diffaero_rgb import (
    MonocularDepth,
    MonocularSpec,
    encode_view,
    rays_B,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera


def test_rays_are_those_of_the_camera():
    """A pixel's ray is where the camera that the policy flies with puts a point onto that pixel."""
    camera = OnboardCamera(width=160, height=90)
    rays = rays_B()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=2), 1.0, atol=1e-6)
    rng = np.random.default_rng(0)
    for row, column in zip(rng.integers(0, 90, 9), rng.integers(0, 160, 9), strict=True):
        x, y, z = rays[row, column]
        u = camera.width / 2 - camera.focal_x * y / x
        v = camera.height / 2 - camera.focal_x * z / x
        assert (u, v) == pytest.approx((column + 0.5, row + 0.5), abs=1e-4)


@pytest.mark.parametrize("height", [90, 120])
def test_view_is_the_middle_of_the_image_with_rays_that_know_the_horizon(height):
    """Colours are those of the middle rows, -1 to 1; rays are of the heading frame: the yaw changes
    nothing, and the rays' heights are those above the horizon."""
    rng = np.random.default_rng(1)
    color = rng.integers(0, 256, (height, 160, 3)).astype(np.uint8)
    roll, pitch = 0.2, -0.3
    views = []
    for yaw in (0.0, 2.0):
        R_WB = RollPitchYaw(roll, pitch, yaw).ToRotationMatrix().matrix()
        views.append(encode_view(color, R_WB))
        np.testing.assert_allclose(views[-1][5], rays_B() @ R_WB[2], atol=1e-5)
    np.testing.assert_allclose(views[0], views[1], atol=1e-5)
    first = (height - 90) // 2
    shown = np.rint((views[0][:3] + 1.0) * 127.5).astype(np.uint8).transpose(1, 2, 0)
    np.testing.assert_array_equal(shown, color[first : first + 90])


@pytest.mark.parametrize("shape", [(90, 128, 3), (88, 160, 3), (91, 160, 3)])
def test_images_of_another_size_are_refused(shape):
    """The message says what was given and what is needed."""
    with pytest.raises(ValueError, match=f"160 pixels wide.* got {shape[1]}x{shape[0]}"):
        encode_view(np.zeros(shape, np.uint8), np.eye(3))


def test_network_computes_its_definition():
    """OpenCV's output is that of dilated convolutions, leaky rectifiers and sums in numpy."""
    spec, rng = MonocularSpec(4, (1, 2), 6, (1, 4)), np.random.default_rng(2)
    weights = {
        name: rng.normal(scale=0.3 / np.sqrt(np.prod(shape[1:])), size=shape).astype(np.float32)
        for name, shape in spec.weight_shapes().items()
    }
    view = rng.uniform(-1.0, 1.0, (6, 90, 160)).astype(np.float32)

    def convolved(x: np.ndarray, name: str, stride: int = 1, dilation: int = 1) -> np.ndarray:
        weight, bias = weights[f"{name}.weight"].astype(float), weights[f"{name}.bias"]
        kernel = weight.shape[2]
        pad = dilation * (kernel // 2)
        x = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
        span = dilation * (kernel - 1) + 1
        height, width = ((size - span) // stride + 1 for size in x.shape[1:])
        y = np.zeros((len(weight), height, width)) + bias[:, None, None]
        for i in range(kernel):
            for j in range(kernel):
                rows = slice(i * dilation, i * dilation + stride * (height - 1) + 1, stride)
                columns = slice(j * dilation, j * dilation + stride * (width - 1) + 1, stride)
                y += np.einsum("oc,chw->ohw", weight[:, :, i, j], x[:, rows, columns])
        return y

    def leaky(x: np.ndarray) -> np.ndarray:
        return np.where(x > 0.0, x, 0.05 * x)

    x = leaky(convolved(view, "stem", 5))
    for i, dilation in enumerate((1, 2)):
        inner = leaky(convolved(x, f"fine.{i}.0", dilation=dilation))
        x = x + convolved(inner, f"fine.{i}.1")
    x = leaky(convolved(x, "halving", 2))
    for i, dilation in enumerate((1, 4)):
        inner = leaky(convolved(x, f"coarse.{i}.0", dilation=dilation))
        x = x + convolved(inner, f"coarse.{i}.1")
    expected = convolved(x, "head")
    found = np.stack(MonocularDepth(spec, weights)(view))
    assert expected.shape == (2, 9, 16) and expected.std() > 0.01
    np.testing.assert_allclose(found, expected, atol=1e-5)
