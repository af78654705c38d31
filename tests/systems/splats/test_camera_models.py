"""Tests of camera models and the unscented projection."""

import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from random_scenes import normal_tensor
from torch import Tensor

from splatpilot.systems.splats.camera_models import (
    fisheye_limit,
    opencv_limit,
    project_fisheye,
    project_opencv,
    unscented_projection,
)

K = torch.tensor([[110.0, 0, 78.0], [0, 105.0, 61.0], [0, 0, 1]], dtype=torch.float64)
RADIAL = torch.tensor([-0.28, 0.09, -0.012, 0.03, 0.01, 0.002], dtype=torch.float64)
TANGENTIAL = torch.tensor([0.003, -0.002], dtype=torch.float64)
FISHEYE = torch.tensor([0.04, -0.012, 0.005, -0.001], dtype=torch.float64)


def project_pinhole(p_C: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """The model without distortion: ``u = fx x / z + cx``, ``v = fy y / z + cy``."""
    pixels = p_C[..., :2] / p_C[..., 2:] * K.diagonal()[:2] + K[:2, 2]
    return pixels, p_C[..., 2] > 0


def models() -> dict[str, Any]:
    return {
        "pinhole": lambda p_C: project_pinhole(p_C, K),
        "opencv": lambda p_C: project_opencv(p_C, K, RADIAL, TANGENTIAL),
        "fisheye": lambda p_C: project_fisheye(p_C, K, FISHEYE),
    }


def points(count: int = 500, depth: float = 2.0, seed: int = 1) -> Tensor:
    p_C = normal_tensor(seed, count, 3).double()
    p_C[:, 2] = depth + p_C[:, 2].abs()
    return p_C


def test_points_agree_with_opencv():
    """Each model puts points where cv2.projectPoints and cv2.fisheye.projectPoints put them."""
    p_C, zero = points(), np.zeros(3)
    k1, k2, k3, k4, k5, k6 = RADIAL.tolist()
    p1, p2 = TANGENTIAL.tolist()
    coefficients = np.array([k1, k2, p1, p2, k3, k4, k5, k6])
    expected = {
        "pinhole": cv2.projectPoints(p_C.numpy(), zero, zero, K.numpy(), np.zeros(8))[0],
        "opencv": cv2.projectPoints(p_C.numpy(), zero, zero, K.numpy(), coefficients)[0],
        "fisheye": cv2.fisheye.projectPoints(
            p_C.numpy()[:, None], zero, zero, K.numpy(), FISHEYE.numpy()
        )[0],
    }
    for name, project in models().items():
        pixels, valid = project(p_C)
        assert valid.sum() > 450
        error = np.abs(pixels.numpy() - expected[name].reshape(-1, 2))[valid]
        assert error.max() < 1e-9, name


def test_fisheye_axis_is_smooth():
    """On the optical axis the fisheye has the value and the derivative that it has beside it."""
    on_axis = torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64, requires_grad=True)
    beside = torch.tensor([[1e-5, 0.0, 2.0]], dtype=torch.float64, requires_grad=True)
    gradients = []
    for p_C in (on_axis, beside):
        pixels, valid = project_fisheye(p_C, K, FISHEYE)
        assert valid.all()
        gradients.append(torch.autograd.grad(pixels.sum(), p_C)[0])
    assert torch.allclose(gradients[0][0, :2], K.diagonal()[:2] / 2, rtol=1e-12)
    assert torch.allclose(*gradients, atol=1e-3)


def test_limits():
    """The limits are where the image radius stops growing, or where it has a pole."""
    quadratic = torch.tensor([-0.4, 0, 0, 0, 0, 0])
    assert opencv_limit(quadratic) == pytest.approx(1 / math.sqrt(1.2), rel=1e-6)
    pole = torch.tensor([0, 0, 0, -0.25, 0, 0])  # r / (1 - r^2 / 4)
    assert opencv_limit(pole) == pytest.approx(2)
    saturates = torch.tensor([0, 0, 0, 0.25, 0, 0])  # r / (1 + r^2 / 4) turns at 2
    assert opencv_limit(saturates) == pytest.approx(2)
    assert opencv_limit(torch.tensor([0.1, 0.1, 0, 0, 0, 0])) == math.inf
    assert fisheye_limit(torch.tensor([-1 / 3, 0, 0, 0])) == pytest.approx(1, rel=1e-6)
    assert fisheye_limit(torch.zeros(4)) == math.inf
    turns_twice = torch.tensor([-0.4, 0.06, 0, 0, 0, 0])
    for radial in (RADIAL, quadratic, saturates, turns_twice):
        r = torch.linspace(0, 3, 3001, dtype=torch.float64)
        p_C = torch.stack([r, 0 * r, 1 + 0 * r], -1)
        pixels, valid = project_opencv(p_C, K, radial.double(), torch.zeros(2).double())
        assert (pixels[valid, 0].diff() > 0).all()
        assert valid.sum() == (r < opencv_limit(radial)).sum()


@pytest.mark.parametrize("model", ["pinhole", "opencv", "fisheye"])
def test_moments_against_samples(model):
    """The unscented mean and covariance are those of a million projected samples."""
    project = models()[model]
    p_C = torch.tensor([[0.9, -0.6, 2.0]], dtype=torch.float64)
    factor = 0.06 * normal_tensor(5, 1, 3, 3).double()
    means2d, covariances, valid = unscented_projection(p_C, factor, project)
    noise = normal_tensor(6, 500_000, 3).double()
    noise = torch.cat([noise, -noise])
    pixels, _ = project(p_C + noise @ factor[0].T)
    sampled = pixels.T.cov()
    centre, _ = project(p_C)
    shift = (pixels.mean(0) - centre).norm()
    assert valid.all() and shift > 0.03  # the curvature matters here
    assert (means2d - pixels.mean(0)).norm() < 0.1 * shift
    expected = torch.stack([sampled[0, 0], sampled[0, 1], sampled[1, 1]])
    assert (covariances - expected).norm() < 0.02 * expected.norm()


def test_projection_gradients():
    """Derivatives by points, intrinsics and coefficients pass gradcheck in float64."""
    p_C = points(4).requires_grad_()
    inputs = [t.clone().requires_grad_() for t in (K, RADIAL, TANGENTIAL, FISHEYE)]
    factors = 0.1 * normal_tensor(0, 4, 3, 3).double()
    factors.requires_grad_()

    def projected(p_C, factors, K, radial, tangential, fisheye):
        models = (
            lambda p: project_pinhole(p, K),
            lambda p: project_opencv(p, K, radial, tangential),
            lambda p: project_fisheye(p, K, fisheye),
        )
        results = [unscented_projection(p_C, factors, model) for model in models]
        assert all(r.valid.all() for r in results)
        return [t for r in results for t in (r.means2d, r.covariances)]

    assert torch.autograd.gradcheck(projected, (p_C, factors, *inputs), atol=1e-5)


def test_tangential_fold():
    """y' = y + 3 p1 y^2 turns back at y = -1 / (6 p1); what lies beyond is not valid."""
    y = torch.linspace(-1, 1, 201, dtype=torch.float64)
    p_C = torch.stack([0 * y, y, 1 + 0 * y], -1)
    tangential = torch.tensor([0.5, 0.0], dtype=torch.float64)
    _, valid = project_opencv(p_C, K, torch.zeros(6).double(), tangential)
    assert torch.equal(valid, y > -1 / 3)


def test_moments_of_a_quadratic():
    """Through (x + x^2, y) a Gaussian's mean moves by s^2, its variance grows by 2 s^4 (1 %)."""

    def project(p):
        x, y, _ = p.unbind(-1)
        return torch.stack([x + x * x, y], -1), torch.ones_like(x, dtype=torch.bool)

    s = 0.3
    factor = s * torch.eye(3, dtype=torch.float64)[None]
    result = unscented_projection(torch.zeros(1, 3, dtype=torch.float64), factor, project)
    assert result.means2d[0].tolist() == pytest.approx([s**2, 0], abs=1e-12)
    xx, xy, yy = result.covariances[0].tolist()
    assert (xx - s**2) / (2 * s**4) == pytest.approx(1, abs=0.011)
    assert (xy, yy) == pytest.approx((0, s**2), abs=1e-12)
