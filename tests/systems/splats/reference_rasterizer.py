"""Gaussian splatting in float64 torch, differentiable, from the published equations."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

ALPHA_CUT = 1 / 255
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
SCENE = ("means", "quats", "scales", "opacities", "colors")


class Projection(NamedTuple):
    """M visible Gaussians on the image plane, nearest first."""

    mean: Tensor  # (M, 2) [px]
    covariance: Tensor  # (M, 2, 2) [px^2]
    depth: Tensor  # (M,) [m]
    ids: Tensor  # (M,) in the input
    opacity: Tensor  # (M,) compensated if antialiased


class Reference(NamedTuple):
    color: Tensor  # (H, W, 3)
    depth: Tensor  # (H, W) accumulated
    alpha: Tensor  # (H, W)
    margin: Tensor  # (H, W) least relative distance of an alpha or a T to the threshold it met


def single_gaussian(
    opacity=0.5, scale=0.1, depth=2.0, color=(0.2, 0.4, 0.8), quat=(1.0, 0, 0, 0)
) -> dict[str, Any]:
    return {
        "means": torch.tensor([[0.0, 0.0, depth]]),
        "quats": torch.tensor([quat]),
        "scales": torch.full((1, 3), scale),
        "opacities": torch.tensor([opacity]),
        "colors": torch.tensor([color]),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[100.0, 0, 16.5], [0, 100.0, 16.5], [0, 0, 1]]]),
    }


def repeated(scene: dict[str, Any], count: int) -> dict[str, Any]:
    return scene | {name: scene[name].repeat_interleave(count, 0) for name in SCENE}


def leaves(scene: dict[str, Any], dtype=torch.float32) -> dict[str, Any]:
    return {
        name: tensor.detach().to(dtype, copy=True).requires_grad_(name != "Ks")
        for name, tensor in scene.items()
    }


def rotation_matrices(quats: Tensor) -> Tensor:
    """(N, 4) wxyz of any length -> (N, 3, 3)."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def sh_basis(degree: int, directions: Tensor) -> Tensor:
    """Real spherical harmonics (N, (degree + 1)^2) of unit `directions` (N, 3).

    Y_l^m = N_lm (-1)^m P_l^(m)(z) (x + i y)^m, with P_l^(m) the m-th derivative of the Legendre
    polynomial of degree l; real parts for m >= 0, imaginary parts of Y_l^|m| for m < 0.
    """
    x, y, z = directions.unbind(1)
    columns = []
    for l in range(degree + 1):  # noqa: E741
        legendre = np.polynomial.legendre.Legendre.basis(l).convert(kind=np.polynomial.Polynomial)
        bands = {}
        for m in range(l + 1):
            derivative = legendre.deriv(m) if m else legendre
            value = sum(c * z**k for k, c in enumerate(derivative.coef)) + 0 * z
            norm = (2 * l + 1) / (4 * math.pi) * math.factorial(l - m) / math.factorial(l + m)
            phase = torch.ones_like(torch.complex(x, y))
            for _ in range(m):
                phase = phase * torch.complex(x, y)
            scale = math.sqrt(norm) * (-1) ** m * (math.sqrt(2) if m else 1)
            bands[m] = scale * value * phase.real
            if m:
                bands[-m] = scale * value * phase.imag
        columns += [bands[m] for m in range(-l, l + 1)]
    return torch.stack(columns, 1)


def seen_colors(means: Tensor, colors: Tensor, viewmat: Tensor, sh_degree: int | None) -> Tensor:
    if sh_degree is None:
        return colors
    direction = means + torch.linalg.inv(viewmat[:3, :3]) @ viewmat[:3, 3]
    basis = sh_basis(sh_degree, direction / direction.norm(dim=1, keepdim=True))
    coefficients = colors[:, : (sh_degree + 1) ** 2]
    return torch.clamp(0.5 + torch.einsum("nk,nkc->nc", basis, coefficients), min=0)


def project(
    means, quats, scales, opacities, viewmat, K, width, height, eps2d=0.3, antialiased=False
) -> Projection:
    """EWA projection: J R Sigma R^T J^T + eps2d I (Zwicker et al. 2001; Kerbl et al. 2023).

    `antialiased` multiplies opacities by the square root of the ratio of the determinants without
    and with eps2d (Yu et al. 2024).
    """
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    factor = rotation_matrices(quats) * scales[:, None, :]
    sigma = R @ (factor @ factor.transpose(1, 2)) @ R.T
    x, y, z = (means @ R.T + t).unbind(1)
    inside = z >= 0.01
    z = torch.where(inside, z, 1.0)

    # The Jacobian is taken no farther out than 15 % of the image beyond its borders.
    slope_x = (x / z).clamp(-cx / fx - 0.15 * width / fx, (width - cx) / fx + 0.15 * width / fx)
    slope_y = (y / z).clamp(-cy / fy - 0.15 * height / fy, (height - cy) / fy + 0.15 * height / fy)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * slope_x / z, zero, fy / z, -fy * slope_y / z], -1)
    J = J.reshape(-1, 2, 3)
    sharp = J @ sigma @ J.transpose(1, 2)
    covariance = sharp + eps2d * torch.eye(2, dtype=means.dtype)
    if antialiased:
        ratio = torch.linalg.det(sharp) / torch.linalg.det(covariance)
        opacities = opacities * torch.sqrt(ratio.clamp(min=1e-30))
    mean = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)

    visible_opacity = opacities >= ALPHA_CUT
    extent = torch.sqrt(2 * torch.log(opacities.clamp(min=ALPHA_CUT) / ALPHA_CUT))
    radius = extent[:, None] * torch.sqrt(torch.diagonal(covariance, dim1=1, dim2=2))
    size = torch.tensor([width, height])
    on_image = ((mean + radius > 0) & (mean - radius < size)).all(1)
    index = torch.nonzero(inside & visible_opacity & on_image)[:, 0]
    index = index[torch.argsort(z[index], stable=True)]
    return Projection(mean[index], covariance[index], z[index], index, opacities[index])


def pixel_centers(width: int, height: int) -> Tensor:
    """(P, 1, 2) float64, row by row."""
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([u, v], -1).reshape(-1, 1, 2).double()


def blend(raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Transmittances before and after M Gaussians, and weights (P, M), of unlimited alphas."""
    alpha = torch.where(raw >= ALPHA_CUT, raw.clamp(max=MAX_ALPHA), 0.0)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    return before, after, torch.where(after > MIN_TRANSMITTANCE, alpha * before, 0.0)


def composite(projection: Projection, colors: Tensor, width: int, height: int) -> Reference:
    """Front-to-back blending; `colors` (M, 3) in the projection's order."""
    conic = torch.linalg.inv(projection.covariance)
    d = pixel_centers(width, height) - projection.mean  # (P, M, 2)
    power = -0.5 * torch.einsum("pgi,gij,pgj->pg", d, conic, d)
    raw = projection.opacity * torch.exp(power)
    before, after, weight = blend(raw)
    met = before > MIN_TRANSMITTANCE
    margins = torch.minimum((raw / ALPHA_CUT - 1).abs(), (after / MIN_TRANSMITTANCE - 1).abs())
    margin = torch.where(met, margins, torch.inf).amin(1)
    images = weight @ colors, weight @ projection.depth, weight.sum(1), margin
    return Reference(*(image.reshape(height, width, *image.shape[1:]) for image in images))


def first_view(scene: dict[str, Any], dtype=torch.float64) -> list[Tensor]:
    """The arrays of `SCENE`, and the pose and the intrinsics of the first camera."""
    arrays = [scene[name] for name in SCENE]
    return [a.to(dtype) for a in (*arrays, scene["viewmats"][0], scene["Ks"][0])]


def render(scene: dict[str, Any], width: int, height: int, sh_degree=None, **options) -> Reference:
    means, quats, scales, opacities, colors, viewmat, K = first_view(scene)
    p = project(means, quats, scales, opacities, viewmat, K, width, height, **options)
    seen = seen_colors(means[p.ids], colors[p.ids], viewmat, sh_degree)
    result = composite(p, seen, width, height)
    behind = scene.get("backgrounds", torch.zeros(1, 3))[0].double()
    return result._replace(color=result.color + (1 - result.alpha)[..., None] * behind)


BLUR = 0.3  # [px^2]
MARGIN = 1e-8  # [px^2]
REACH = 3.33  # standard deviations


def median_depth(scene: dict[str, Any], width: int, height: int) -> tuple[Tensor, Tensor]:
    """Returns the depth (H, W) [m] where transmittance without blur falls to one half, else 0.

    On a Gaussian with the covariance S about c, in the camera frame, the depth is where the ray d
    (of unit depth) meets the plane n . p = n . c with n = S^-1 c, rotated until no part within
    `REACH` standard deviations is nearer or farther by more than 0.9 of the inverse depth. Where
    that is farther than the center, a distance on the image counts as much longer. Also returns
    the relative distance (H, W) of alpha or transmittance to a threshold.
    """
    means, quats, scales, opacities, _, viewmat, K = first_view(scene)
    visible = project(means, quats, scales, opacities, viewmat, K, width, height, eps2d=BLUR)
    sharp = visible.covariance + (MARGIN - BLUR) * torch.eye(2, dtype=torch.float64)
    conic = torch.linalg.inv(sharp)

    R, t = viewmat[:3, :3], viewmat[:3, 3]
    p_C = means[visible.ids] @ R.T + t
    factor = R @ rotation_matrices(quats[visible.ids]) * scales[visible.ids][:, None, :]
    covariance = factor @ factor.transpose(1, 2)
    n = torch.linalg.solve(covariance, p_C[..., None])[..., 0]
    pixels = pixel_centers(width, height)
    slope = n[:, :2] / torch.stack([K[0, 0], K[1, 1]]) / (n * p_C).sum(1, keepdim=True)  # (M, 2)
    spread = torch.einsum("gi,gij,gj->g", slope, sharp, slope).sqrt()
    turn = (0.9 / p_C[:, 2] / (REACH * spread)).clamp(max=1)
    inverse = 1 / p_C[:, 2] + turn * ((pixels - visible.mean) * slope).sum(-1)  # (P, M)
    d = (pixels - visible.mean) / (p_C[:, 2] * inverse).clamp(max=1)[..., None]
    raw = visible.opacity * torch.exp(-0.5 * torch.einsum("pgi,gij,pgj->pg", d, conic, d))
    alpha = torch.where(raw >= ALPHA_CUT, raw, 0.0)
    left = torch.cumprod(1 - alpha, 1)
    passed = left <= 0.5
    first = passed.double().argmax(1)
    depth = torch.where(passed.any(1), 1 / inverse.gather(1, first[:, None])[:, 0], 0.0)
    margin = torch.minimum((raw / ALPHA_CUT - 1).abs().amin(1), (left / 0.5 - 1).abs().amin(1))
    return depth.reshape(height, width), margin.reshape(height, width)
