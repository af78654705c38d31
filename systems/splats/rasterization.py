"""Gaussian splatting with gsplat's interface: native kernels on the CPU, gsplat on CUDA."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatpilot import _native
from splatpilot.systems.splats.baked_scene import EPS2D, check_camera, create_renderer
from splatpilot.systems.splats.gsplat_kernels import rasterize_by_gsplat
from splatpilot.systems.splats.rasterization_autograd import Composite, Project
from splatpilot.systems.splats.rasterization_checks import (
    CHANNELS,
    by_name,
    check_device,
    check_render_mode,
    check_shapes,
    check_values,
    depth_mode_of,
    pair_meta,
)
from splatpilot.systems.splats.rasterization_views import Drawing, Views, joined, to_numpy

RASTERIZE_MODES = ("classic", "antialiased")


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = EPS2D,
    sh_degree: int | None = None,
    *,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    renderer: _native.Renderer | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Renders N Gaussians into C cameras (Kerbl et al. 2023, with gsplat's conventions).

    A Gaussian of colour c adds ``T a c`` to a pixel, where ``a = min(.99, o exp(-d^T S^-1 d / 2))``
    and T is what those in front let through; S is its covariance projected by the Jacobian at its
    centre, plus eps2d on the diagonal. Contributions with a < 1/255 are skipped, and a pixel is
    finished before T would fall to 1e-4. Gaussians of equal depth blend in the order of the input.

    z is the depth of the centre for "D" and "ED". The median depth is that of a surface: z of the
    point of greatest density along the pixel's ray, at the Gaussian where what passes through S
    without eps2d falls to one half, and 0 where it never does. A pixel beside an edge shows what is
    behind, whatever tails reach it, and a flat Gaussian has the depth of its plane, n . p = n . c
    with n = covariance^-1 c for a centre c in the camera frame (Zhang et al. 2024, RaDe-GS). Where
    z is more than that of the centre, d counts z / c_z times: a footprint without perspective would
    be haze beyond the far end of what is large and close.

    Colour, depth and alpha are differentiable with respect to means, quats, scales, opacities,
    colors, viewmats (all twelve numbers, taken as free) and backgrounds; a Gaussian that is skipped
    or held at a = .99 has no part in the derivative there, and a median depth is constant. Equal
    input gives equal bits, gradients included, whatever the number of threads.

    Args:
        means: (N, 3) centres [m].
        quats: (N, 4) wxyz orientations, of any length but zero.
        scales: (N, 3) standard deviations [m], positive.
        opacities: (N,) in [0, 1].
        colors: (N, 3) or (C, N, 3); with `sh_degree`, spherical-harmonic coefficients (N, K, 3) or
            (C, N, K, 3), of which colours are ``max(0, 0.5 + sum_k Y_k c_k)``.
        viewmats: (C, 4, 4) world to camera (x right, y down, z forward).
        Ks: (C, 3, 3) intrinsics [px]; skew is ignored. Pixel centres lie at +1/2.
        width: Image width [px].
        height: Image height [px].
        near_plane: Gaussians whose centre is nearer along z are left out [m].
        far_plane: The same for those farther away [m].
        radius_clip: Gaussians that reach no farther on the image are left out [px].
        eps2d: Variance by which the pixel blurs every Gaussian [px^2].
        sh_degree: Degree to evaluate, 0 to 3; None when `colors` are colours.
        backgrounds: (C, 3) colours behind everything, black if None; depth has no background.
        render_mode: "RGB"; "D", the accumulated depth sum w z [m]; "ED", the expected depth
            sum w z / sum w; "MD", the median depth, see below; or "RGB+D", "RGB+ED", "RGB+MD".
        absgrad: In backward, set ``meta["means2d"].absgrad`` (M, 2): the sums over pixels of the
            absolute values of what they add to the gradient of means2d.
        rasterize_mode: "classic", or "antialiased": opacities are multiplied by
            sqrt(det S / det(S + eps2d)), so that Gaussians narrower than a pixel keep their light.
        renderer: Of `create_renderer`: CPU threads, which do not influence the result, SIMD level
            and memory for one image after another; None: one thread, for this call alone.

    Returns:
        render_colors (C, H, W, X), X = 3, 1 or 4 by `render_mode`; render_alphas (C, H, W, 1);
        and a dict on the M visible (camera, Gaussian) pairs, in that order, as gsplat's packed one:
        camera_ids, gaussian_ids, depths, opacities (M,), radii, means2d (M, 2), conics (M, 3), and
        width, height, tile_size, tile_width, tile_height, n_cameras. After
        ``meta["means2d"].retain_grad()``, its ``.grad`` holds screen-space gradients [1/px].

    Raises:
        ValueError: a tensor has the wrong shape, dtype, device or values (the message names it),
            or Ks requires a gradient.
        NotImplementedError: median depth of tensors on a GPU.
        ModuleNotFoundError: tensors are on a GPU and gsplat is not installed.
    """
    scene = (means, quats, scales, opacities, colors, viewmats)
    tensors = by_name(*scene, Ks, backgrounds)
    check_render_mode(render_mode)
    median = "MD" in render_mode
    if rasterize_mode not in RASTERIZE_MODES:
        raise ValueError(
            f"rasterize_mode is {rasterize_mode!r}; it must be one of {', '.join(RASTERIZE_MODES)}"
        )
    if median and rasterize_mode == "antialiased":
        raise ValueError(
            f"render_mode {render_mode!r} needs rasterize_mode 'classic': antialiasing makes small "
            "Gaussians fainter than they are in the median depth"
        )
    if median and means.device.type == "cuda":
        raise NotImplementedError(
            f"render_mode {render_mode!r} is for the CPU only; move the tensors with .cpu()"
        )
    check_shapes(tensors, sh_degree)
    if means.device.type == "cuda":
        return rasterize_by_gsplat(
            scene,
            Ks,
            width,
            height,
            near_plane=near_plane,
            far_plane=far_plane,
            radius_clip=radius_clip,
            eps2d=eps2d,
            sh_degree=sh_degree,
            backgrounds=backgrounds,
            render_mode=render_mode,
            absgrad=absgrad,
            rasterize_mode=rasterize_mode,
        )
    check_device(means)
    if torch.is_grad_enabled() and Ks.requires_grad:
        raise ValueError("Ks requires a gradient, which is not available; use Ks.detach()")

    renderer = create_renderer() if renderer is None else renderer
    arrays = {name: to_numpy(tensor) for name, tensor in tensors.items()}
    check_values(arrays, renderer)
    for name, value in (("eps2d", eps2d), ("radius_clip", radius_clip)):
        if not 0 <= value < float("inf"):
            raise ValueError(f"{name} is {value}; it must be a finite number of pixels >= 0")
    views = Views(
        renderer=renderer,
        intrinsics=[check_camera(K, width, height, near_plane, far_plane) for K in arrays["Ks"]],
        poses=arrays["viewmats"].astype(np.float64),
        width=width,
        height=height,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        eps2d=eps2d,
        antialiased=rasterize_mode == "antialiased",
        sh_degree=sh_degree,
        per_camera_colors=colors.ndim == (3 if sh_degree is None else 4),
        backgrounds=arrays.get("backgrounds", np.zeros((len(viewmats), 3), dtype=np.float32)),
        channels=CHANNELS[render_mode],
        depth_mode=depth_mode_of(render_mode),
        absgrad=absgrad,
    )
    wants_gradients = torch.is_grad_enabled() and any(t.requires_grad for t in tensors.values())
    drawing = views.draw(arrays, keep=wants_gradients)
    if not wants_gradients:
        return drawing.image, drawing.alpha, _meta(drawing, drawing.means2d())
    splats = Project.apply(views, drawing, *scene)
    image, alpha = Composite.apply(views, drawing, *splats, backgrounds)  # pyright: ignore[reportGeneralTypeIssues]
    return image, alpha, _meta(drawing, splats[0])


def _meta(drawing: Drawing, means2d: Tensor) -> dict[str, Any]:
    ids, radii, _, depths, conics, opacities = (
        joined(parts) for parts in zip(*drawing.projected, strict=True)
    )
    counts = [len(p[0]) for p in drawing.projected]
    return pair_meta(counts, *drawing.image.shape[2:0:-1]) | {
        "gaussian_ids": ids,
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "conics": conics,
        "opacities": opacities,
    }
