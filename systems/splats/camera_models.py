"""Camera models beyond the pinhole, and the unscented projection of Gaussians through any of them.

Differentiable torch functions of any floating dtype. Points are in the camera frame C (x right,
y down, z forward) [m], images in pixels with centres at +1/2. Every model returns with its pixels
where they are valid: a point behind the camera, or where the distortion folds the image back on
itself, has no place on the image, and what is returned for it is finite but meaningless.

Sources: the OpenCV reference, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model"
(Kannala and Brandt, PAMI 2006); Julier and Uhlmann, "Unscented filtering and nonlinear estimation",
Proc. IEEE 2004; Wu et al., "3DGUT", CVPR 2025, for its use on Gaussian splats.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from splatpilot.systems.splats.distortion import fisheye_limit, opencv_limit

SPREAD = 0.1
"""The sigma points lie SPREAD sqrt(3) standard deviations from the centre (gsplat's alpha)."""
PRIOR = 2.0
"""Weight of the mean's curvature in the covariance: 2 is optimal for Gaussians (beta)."""

Projection = Callable[[Tensor], tuple[Tensor, Tensor]]


class ProjectedGaussians(NamedTuple):
    """Gaussians on the image plane."""

    means2d: Tensor  # (N, 2) [px]
    covariances: Tensor  # (N, 3) xx, xy, yy [px^2], without the pixel's blur
    valid: Tensor  # (N,) bool: every sigma point has a place on the image


def project_opencv(
    p_C: Tensor, K: Tensor, radial: Tensor, tangential: Tensor
) -> tuple[Tensor, Tensor]:
    """OpenCV's rational radial and tangential distortion.

    With (x, y) = (X / Z, Y / Z) and r^2 = x^2 + y^2,
    ``g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)``,
    ``x' = g x + 2 p1 x y + p2 (r^2 + 2 x^2)``, ``y' = g y + p1 (r^2 + 2 y^2) + 2 p2 x y``.
    Valid where z > 0, r is below `opencv_limit` and the map (x, y) -> (x', y') keeps its
    orientation.

    Args:
        p_C: (..., 3) points [m].
        K: (3, 3) intrinsics [px]; skew is ignored.
        radial: (6,) k1, ..., k6.
        tangential: (2,) p1, p2.

    Returns:
        (..., 2) pixels and (...,) validity.
    """
    valid = p_C[..., 2] > 0
    xy = _slopes(p_C, valid)
    limit = opencv_limit(radial.detach().double().tolist())
    valid = valid & (xy.detach().square().sum(-1) < limit**2)
    xy = torch.where(valid[..., None], xy, 0.0)
    x, y = xy.unbind(-1)
    s = x * x + y * y
    k1, k2, k3, k4, k5, k6 = radial.unbind()
    p1, p2 = tangential.unbind()
    top = 1 + s * (k1 + s * (k2 + s * k3))
    bottom = 1 + s * (k4 + s * (k5 + s * k6))
    g = top / bottom
    distorted = torch.stack(
        [
            g * x + 2 * p1 * x * y + p2 * (s + 2 * x * x),
            g * y + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )
    with torch.no_grad():
        slope = (
            k1 + s * (2 * k2 + 3 * s * k3) - g * (k4 + s * (2 * k5 + 3 * s * k6))
        ) / bottom  # dg/ds
        xx = g + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        yy = g + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        xy_mixed = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        valid = valid & (xx + yy > 0) & (xx * yy > xy_mixed * xy_mixed)
    return _to_pixels(distorted, K), valid


def project_fisheye(
    p_C: Tensor, K: Tensor, radial: Tensor, max_angle: float = math.pi / 2
) -> tuple[Tensor, Tensor]:
    """OpenCV's fisheye: the image radius is a polynomial of the angle from the optical axis.

    With a = atan2(sqrt(X^2 + Y^2), Z),
    ``(x', y') = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8) (X, Y) / sqrt(X^2 + Y^2)``.
    Valid where a is below `max_angle` [rad] and `fisheye_limit`.

    Args:
        p_C: (..., 3) points [m].
        K: (3, 3) intrinsics [px]; skew is ignored.
        radial: (4,) k1, ..., k4.
        max_angle: Limit of the field of view from the axis [rad].

    Returns:
        (..., 2) pixels and (...,) validity.
    """
    limit = min(max_angle, fisheye_limit(radial.detach().double().tolist()))
    # The axis itself, of which the derivative of the square root knows nothing, is left to the
    # limit a / r -> 1 / z.
    square = p_C[..., :2].square().sum(-1)
    off_axis = square > 1e-14 * p_C[..., 2].square()
    r = torch.where(off_axis, square, 1.0).sqrt()
    angle = torch.where(off_axis, torch.atan2(r, p_C[..., 2]), 0.0)
    valid = (angle < limit) & (off_axis | (p_C[..., 2] > 0))
    z = torch.where(off_axis | ~valid, 1.0, p_C[..., 2])
    angle_per_r = torch.where(off_axis, angle / r, 1 / z)
    s = angle * angle
    k1, k2, k3, k4 = radial.unbind()
    scale = angle_per_r * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
    distorted = torch.where(valid[..., None], scale[..., None] * p_C[..., :2], 0.0)
    return _to_pixels(distorted, K), valid


def _slopes(p_C: Tensor, valid: Tensor) -> Tensor:
    """(x / z, y / z), and zeros where not `valid`, so that no gradient is NaN there."""
    z = torch.where(valid, p_C[..., 2], 1.0)
    return torch.where(valid[..., None], p_C[..., :2] / z[..., None], 0.0)


def _to_pixels(xy: Tensor, K: Tensor) -> Tensor:
    return xy * torch.stack([K[0, 0], K[1, 1]]) + torch.stack([K[0, 2], K[1, 2]])


def unscented_projection(p_C: Tensor, factors_C: Tensor, project: Projection) -> ProjectedGaussians:
    """Means and covariances on the image of Gaussians seen through the camera model `project`.

    Sigma points are the centre x_0 and ``x_0 +- h c_k``, with h = sqrt(3) SPREAD and c_k the
    columns of the factor. With d_i = project(x_i) - project(x_0), w = 1 / (2 h^2) and
    ``e = w sum d_i``, the unscented transform's mean is ``project(x_0) + e`` and its covariance
    ``w sum d_i d_i^T + (PRIOR - SPREAD^2) e e^T``: its usual weights, of which the centre's is
    near -100, multiplied out, so that nothing cancels and the covariance is positive.

    Args:
        p_C: (N, 3) centres [m].
        factors_C: (N, 3, 3) of which ``F F^T`` are the covariances [m].
        project: The camera model, (..., 3) -> (..., 2) pixels and (...,) validity.
    """
    reach = math.sqrt(3) * SPREAD
    offsets = reach * factors_C.permute(2, 0, 1)  # (3, N, 3)
    points = torch.cat([p_C[None], p_C + offsets, p_C - offsets])  # (7, N, 3)
    # Coordinate by coordinate in memory: what follows reads x, y and z apart, twice as fast.
    pixels, valid = project(points.movedim(-1, 0).contiguous().movedim(0, -1))
    d = pixels[1:] - pixels[0]  # (6, N, 2)
    weight = 1 / (2 * reach**2)
    e = weight * d.sum(0)
    x, y = d.unbind(-1)
    ex, ey = e.unbind(-1)
    curvature = PRIOR - SPREAD**2
    moments = [
        weight * (a * b).sum(0) + curvature * ea * eb
        for a, b, ea, eb in ((x, x, ex, ex), (x, y, ex, ey), (y, y, ey, ey))
    ]
    return ProjectedGaussians(pixels[0] + e, torch.stack(moments, -1), valid.all(0))
