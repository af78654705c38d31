"""The CPU rasteriser for distorted cameras: projection in torch, the rest in native code.

Torch takes the scene to means, covariances, opacities and colours on the image plane and
differentiates that; `PlaceSplats` stands between them and the native image, where
`rasterization_autograd.Project` stands for the pinhole.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpilot import _native
from splatpilot.systems.splats.camera_models import (
    Projection,
    project_fisheye,
    project_opencv,
    unscented_projection,
)
from splatpilot.systems.splats.rasterization_autograd import splat_gradients, splat_outputs
from splatpilot.systems.splats.rasterization_views import Drawing, Views, to_numpy
from splatpilot.systems.splats.spherical_harmonics import sh_basis_functions

CAMERA_MODELS = ("pinhole", "fisheye")
RADIAL_COUNTS = {"pinhole": (2, 3, 6), "fisheye": (4,)}

MARGIN = 0.5
"""Gaussians whose centre lies farther outside the image, in image sizes, are left out: there the
projection stretches what is near the camera plane without bound."""


def check_camera_model(
    camera_model: str, tangential_coeffs: Tensor | None, max_angle: float
) -> None:
    """Raises ValueError for what is no camera model; shapes and values are checked elsewhere."""
    if camera_model not in CAMERA_MODELS:
        raise ValueError(
            f"camera_model is {camera_model!r}; it must be one of {', '.join(CAMERA_MODELS)}"
        )
    if camera_model == "fisheye" and tangential_coeffs is not None:
        raise ValueError(
            "tangential_coeffs are given, and camera_model 'fisheye' has none; leave them out"
        )
    if not 0 < max_angle <= math.pi / 2:
        raise ValueError(
            f"max_angle is {max_angle}; it must lie in (0, pi/2] rad, since depth is along z"
        )


def camera_projections(
    camera_model: str,
    Ks: Tensor,
    radial_coeffs: Tensor | None,
    tangential_coeffs: Tensor | None,
    max_angle: float,
) -> list[Projection]:
    """The C camera models in float64, differentiable by intrinsics and coefficients."""
    C, K = len(Ks), Ks.double()
    if radial_coeffs is None:
        radial_coeffs = torch.zeros(C, RADIAL_COUNTS[camera_model][-1])
    radial = radial_coeffs.double()
    if camera_model == "fisheye":
        return [_fisheye(K[c], radial[c], max_angle) for c in range(C)]
    radial = torch.nn.functional.pad(radial, (0, 6 - radial.shape[1]))
    tangential = torch.zeros(C, 2) if tangential_coeffs is None else tangential_coeffs
    return [_opencv(K[c], radial[c], tangential[c].double()) for c in range(C)]


def _fisheye(K: Tensor, radial: Tensor, max_angle: float) -> Projection:
    return lambda p_C: project_fisheye(p_C, K, radial, max_angle)


def _opencv(K: Tensor, radial: Tensor, tangential: Tensor) -> Projection:
    return lambda p_C: project_opencv(p_C, K, radial, tangential)


def render_unscented(
    views: Views, scene: tuple[Tensor, ...], cameras: list[Projection], keep: bool
) -> tuple[Drawing, tuple[Tensor, Tensor] | None]:
    """Draws `scene`: (means, quats, scales, opacities, colors, viewmats).

    With `keep`, the second is `splat_outputs`, differentiable; else None.
    """
    parts, ids = [], []
    for c, project in enumerate(cameras):
        of_camera, part = _project(views, scene, c, project)
        ids.append(of_camera.numpy())
        parts.append(part)
    joined = [torch.cat(columns) for columns in zip(*parts, strict=True)]
    drawing, visible = _draw(views, ids, joined, keep)
    return drawing, PlaceSplats.apply(views, drawing, visible, *joined) if keep else None  # pyright: ignore[reportReturnType]


def _project(
    views: Views, scene: tuple[Tensor, ...], camera: int, project: Projection
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Ids (P,) of what one camera may see, and means2d (P, 2), covariances (P, 3) with the blur,
    depths (P,), opacities (P,), colours (P, 3)."""
    means, quats, scales, opacities, colors, viewmats = scene
    X_CW = viewmats[camera].double()
    R_CW, t_CW = X_CW[:3, :3], X_CW[:3, 3]
    with torch.no_grad():
        p_C = means.double() @ R_CW.T + t_CW
        in_range = (p_C[:, 2] >= views.near_plane) & (p_C[:, 2] <= views.far_plane)
        (ids,) = torch.nonzero(in_range, as_tuple=True)
        pixels, visible = project(p_C[ids])
        size = torch.tensor([views.width, views.height])
        in_window = ((pixels + MARGIN * size >= 0) & (pixels <= (1 + MARGIN) * size)).all(-1)
        ids = ids[visible & in_window]

    p_W = means[ids].double()
    p_C = p_W @ R_CW.T + t_CW
    factors = R_CW @ _covariance_factors(quats[ids].double(), scales[ids].double())
    means2d, sharp, valid = unscented_projection(p_C, factors, project)
    if not valid.all():
        ids, p_W, p_C, means2d, sharp = (t[valid] for t in (ids, p_W, p_C, means2d, sharp))
    covariances = sharp + views.eps2d * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
    opacity = opacities[ids]
    if views.antialiased:
        # sharp is positive semidefinite, but for rounding
        ratio = (_determinant(sharp) / _determinant(covariances)).clamp(min=1e-30)
        opacity = opacity * ratio.sqrt().float()
    color = (colors[camera] if views.per_camera_colors else colors)[ids]
    if views.sh_degree is not None:
        direction = torch.nn.functional.normalize(p_W + torch.linalg.solve(R_CW, t_CW), dim=-1)
        x, y, z = direction.unbind(-1)
        basis = torch.stack(sh_basis_functions(x, y, z, views.sh_degree), -1).float()
        color = torch.einsum("nk,nkc->nc", basis, color[:, : basis.shape[1]])
        color = (color + 0.5).clamp(min=0)
    return ids, (means2d, covariances, p_C[:, 2].float(), opacity, color)


def _covariance_factors(quats: Tensor, scales: Tensor) -> Tensor:
    """R(q) diag(scales), (N, 3, 3)."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1, eps=0.0).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2) * scales[:, None, :]


def _determinant(covariances: Tensor) -> Tensor:
    xx, xy, yy = covariances.unbind(-1)
    return xx * yy - xy * xy


def _draw(
    views: Views, ids: list[NDArray[np.int64]], projected: list[Tensor], keep: bool
) -> tuple[Drawing, NDArray[np.int64]]:
    """Also returns which rows of `projected` are the M visible splats."""
    drawing = views.blank()
    means2d, covariances, depths, opacities, colors = (to_numpy(t) for t in projected)
    visible, first = [], 0
    for c, of_camera in enumerate(ids):
        rows = slice(first, first + len(of_camera))
        frame = _native.render_projected(
            views.renderer,
            means2d=means2d[rows],
            covariances=covariances[rows],
            depths=depths[rows],
            opacities=opacities[rows],
            colors=colors[rows],
            **views.image_arguments(drawing, c),
            keep=keep,
        )
        seen, *values = _native.projected(views.renderer, frame, opacities[rows])
        drawing.projected.append((of_camera[seen], *values))
        drawing.frames.append(frame)
        visible.append(first + seen)
        first = rows.stop
    return drawing, np.concatenate(visible)


class PlaceSplats(torch.autograd.Function):
    """Projected (means2d, covariances, depths, opacities, colors) -> see `splat_outputs`."""

    @staticmethod
    def forward(
        ctx, views: Views, drawing: Drawing, visible: NDArray[np.int64], *projected: Tensor
    ) -> tuple[Tensor, Tensor]:
        ctx.views, ctx.frames, ctx.visible = views, drawing.frames, torch.from_numpy(visible)
        ctx.save_for_backward(*projected)
        ctx.set_materialize_grads(False)
        return splat_outputs(drawing)

    @staticmethod
    @once_differentiable
    def backward(ctx, v_means2d: Tensor | None, v_splats: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        rows = ctx.visible
        v_means2d, g = splat_gradients(len(rows), v_means2d, v_splats)
        factors = [_native.splat_factors(ctx.views.renderer, frame) for frame in ctx.frames]
        opacities = ctx.saved_tensors[3]
        ux, uy, vy = torch.from_numpy(np.concatenate(factors)).double().unbind(-1)
        uu, uv, vv = g[:, 5:8].double().unbind(-1)
        # dL/dS = 2 ln^2 2 W^T M W, with W = (ux uy; 0 vy) and M the sums of h (u, v)^T (u, v).
        v_xy = 2 * ux * (uy * uu + vy * uv)
        v_yy = uy * uy * uu + 2 * uy * vy * uv + vy * vy * vv
        v_covariances = 2 * math.log(2) ** 2 * torch.stack([ux * ux * uu, v_xy, v_yy], -1)
        gradients = (v_means2d, v_covariances, g[:, 11], g[:, 4] / opacities[rows], g[:, 8:11])
        return (
            None,
            None,
            None,
            *[
                torch.zeros_like(t).index_copy_(0, rows, v.to(t.dtype))
                for t, v in zip(ctx.saved_tensors, gradients, strict=True)
            ],
        )
