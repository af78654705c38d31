"""Gaussian splatting with gsplat's interface: native kernels on the CPU, gsplat on CUDA."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpilot import _native
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.baked_scene import EPS2D, check_camera, create_renderer
from splatpilot.systems.splats.scene import require_valid

TILE_SIZE = 16  # [px]
CHANNELS = {"RGB": 3, "D": 1, "ED": 1, "MD": 1, "RGB+D": 4, "RGB+ED": 4, "RGB+MD": 4}
SCENE = ("means", "quats", "scales", "opacities", "colors")
TENSORS = (*SCENE, "viewmats", "Ks", "backgrounds")
SPLAT_GRADIENT = 16
"""Floats of a splat's gradient: mean 2, ln opacity, shape 3, color 3, depth; 6 unused."""

type Arrays = dict[str, NDArray[Any]]


def require_choice(name: str, value: str, values: Iterable[str]) -> None:
    require(value in values, name, f"one of {', '.join(values)}", repr(value))


def named_tensors(*tensors: Tensor | None, sh_degree: int | None) -> dict[str, Tensor]:
    """Names tensors by `TENSORS`, without None, and checks their shapes, dtypes and devices."""
    given = {name: t for name, t in zip(TENSORS, tensors, strict=True) if t is not None}
    require(sh_degree in (None, 0, 1, 2, 3), "sh_degree", "0, 1, 2, 3 or None", sh_degree)
    N, C = (given[n].shape[0] if given[n].ndim else 0 for n in ("means", "viewmats"))
    color = (3,) if sh_degree is None else ("K", 3)
    gaussians: list[tuple[int | str, ...]] = [(N, 3), (N, 4), (N, 3), (N,), (N, *color)]
    sizes = [*gaussians, (C, 4, 4), (C, 3, 3), (C, 3)]
    shapes = {name: size for name, size in zip(TENSORS, sizes, strict=True)}
    device = given["means"].device
    for name, tensor in given.items():
        allowed = [shapes[name], *([(C, *shapes[name])] if name == "colors" else [])]
        fits = any(
            len(shape) == tensor.ndim
            and all(n in (have, "K") for n, have in zip(shape, tensor.shape, strict=True))
            for shape in allowed
        )
        listed = " or ".join("(" + ", ".join(map(str, shape)) + ")" for shape in allowed)
        require(fits, name, f"of shape {listed}", tuple(tensor.shape))
        require(tensor.dtype == torch.float32, name, "torch.float32", tensor.dtype, "use .float()")
        require(tensor.device == device, name, f"on {device} like means", tensor.device)
    require(C > 0, "viewmats", "of at least one camera", "none")
    if sh_degree is not None:
        count, minimum = given["colors"].shape[-2], (sh_degree + 1) ** 2
        what = f"the number of coefficients in colors for sh_degree={sh_degree}"
        require(count >= minimum, what, f">= {minimum}", count)
    return given


def _check_values(arrays: Arrays, scene_is_valid: bool, scale_axes: int) -> None:
    """Checks that values can be rendered; the first `scale_axes` scales count."""
    arrays = arrays | {"scales": arrays["scales"][:, :scale_axes]}
    for name, array in arrays.items():
        if name not in SCENE or not scene_is_valid:
            require_valid(np.isfinite(array), name, array, "finite")
    if not scene_is_valid:
        scales, opacities, quats = (arrays[n] for n in ("scales", "opacities", "quats"))
        require_valid(scales > 0, "scales", scales, "> 0 m")
        require_valid((opacities >= 0) & (opacities <= 1), "opacities", opacities, "in [0, 1]")
        squared = (quats * quats).sum(axis=1)
        remedy = "use (1, 0, 0, 0) for no rotation"
        valid = (squared >= 1e-30) & (squared <= 1e30)
        require_valid(valid, "quats", quats, "of a length > 0", remedy)
    for c, X_CW in enumerate(arrays["viewmats"].astype(np.float64)):
        R = X_CW[:3, :3]
        error = max(np.abs(R @ R.T - np.eye(3)).max(), np.abs(X_CW[3] - (0, 0, 0, 1)).max())
        got = f"one that is off by {error:.3g}"
        require(error <= 1e-3, f"viewmats[{c}]", "a rigid transform", got)


@dataclass(frozen=True)
class Views:
    """C cameras and the renderer of their images."""

    renderer: _native.Renderer
    cameras: list[_native.Camera]
    poses: NDArray[np.float64]  # (C, 4, 4) X_CW
    sh_degree: int | None
    per_camera_colors: bool
    with_gradients: bool

    def _colors(self, arrays: Arrays, c: int) -> NDArray[np.float32]:
        colors = arrays["colors"] if self.sh_degree is not None else arrays["colors"][..., None, :]
        return colors[c] if self.per_camera_colors else colors  # (N, K, 3), a view

    def gaussians(self, arrays: Arrays, c: int) -> _native.Gaussians:
        """Returns Gaussians or surfels as camera c sees them."""
        scene = {name: arrays[name] for name in SCENE} | {"colors": self._colors(arrays, c)}
        return _native.Gaussians(
            **scene, sh_degree=-1 if self.sh_degree is None else self.sh_degree
        )

    def project_backward(
        self, inputs: Sequence[Tensor], backward: Callable[..., NDArray[np.float64]]
    ) -> list[Tensor]:
        """Returns the gradients of `inputs`: means, quats, scales, opacities, colors and viewmats;
        `backward` takes a camera's index, its Gaussians and their gradients."""
        results = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs]
        results[-1].zero_()
        scene, gradients = (
            {name: _to_numpy(tensor) for name, tensor in zip(SCENE, tensors, strict=False)}
            for tensors in (inputs, results)
        )
        for c, X_CW in enumerate(self.poses):
            rows = _native.GaussianGradients(
                **gradients | {"colors": self._colors(gradients, c)},
                overwrite=c == 0,
                overwrite_colors=c == 0 or self.per_camera_colors,
            )
            sums = backward(c, self.gaussians(scene, c), rows)
            results[-1][c, :3] = torch.from_numpy(_pose_gradient(sums, X_CW))
        return results


def _pose_gradient(sums: NDArray[np.float64], X_CW: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns dL/d[R | t] (3, 4) from dL/dR with the center fixed, dL/dp_C and dL/d(p_W - center).

    p_C = R p_W + t, with p_W = d + center; spherical harmonics look from center = -R^-1 t.
    """
    v_p: NDArray[np.float64] = sums[3]
    v_direction: NDArray[np.float64] = sums[4]
    R, t = X_CW[:3, :3], X_CW[:3, 3]
    v_t = v_p + np.linalg.solve(R.T, v_direction)
    return np.column_stack([sums[:3] - np.outer(v_t, np.linalg.solve(R, t)), v_t])


def prepare(
    tensors: dict[str, Tensor],
    sh_degree: int | None,
    renderer: _native.Renderer | None,
    scale_axes: int = 3,
    **optics: Any,
) -> tuple[Views, Arrays]:
    """Checks the values of `named_tensors` on the CPU; returns cameras and arrays. The first
    `scale_axes` scales matter; `optics` are arguments of `_native.Camera` but K and X_CW."""
    size = optics["width"], optics["height"], optics["near_plane"], optics["far_plane"]
    radius_clip, device = optics["radius_clip"], tensors["means"].device
    require(device.type == "cpu", "the device", "'cpu' or 'cuda'", device, "move the tensors")
    if torch.is_grad_enabled() and tensors["Ks"].requires_grad:
        raise ValueError("Ks must be without a gradient; use Ks.detach()")
    require(0 <= radius_clip < np.inf, "radius_clip", "finite and >= 0 px", radius_clip)
    arrays = {name: _to_numpy(tensor) for name, tensor in tensors.items()}
    poses = arrays["viewmats"].astype(np.float64)
    views = Views(
        create_renderer() if renderer is None else renderer,
        [],
        poses,
        sh_degree,
        per_camera_colors=tensors["colors"].ndim == (3 if sh_degree is None else 4),
        with_gradients=torch.is_grad_enabled() and any(t.requires_grad for t in tensors.values()),
    )
    colors = range(len(poses) if views.per_camera_colors else 1)
    valid = all(views.gaussians(arrays, c).are_valid(views.renderer) for c in colors)
    _check_values(arrays, valid, scale_axes)
    for K, X_CW in zip(arrays["Ks"], poses, strict=True):
        views.cameras.append(_native.Camera(K=check_camera(K, *size), X_CW=X_CW, **optics))
    return views, arrays


def _to_numpy(tensor: Tensor) -> NDArray[Any]:
    return np.ascontiguousarray(tensor.detach().numpy())


def joined(parts: Sequence[tuple[NDArray, ...]]) -> list[Tensor]:
    """Concatenates the arrays of each camera."""
    return [
        torch.from_numpy(arrays[0] if len(arrays) == 1 else np.concatenate(arrays))
        for arrays in zip(*parts, strict=True)
    ]


def pair_meta(counts: list[int], width: int, height: int) -> dict[str, Any]:
    """Returns gsplat's meta of both rasterizers for `counts` visible Gaussians of each camera."""
    return {
        "camera_ids": torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts)),
        "width": width,
        "height": height,
        "tile_size": TILE_SIZE,
        "tile_width": -(-width // TILE_SIZE),
        "tile_height": -(-height // TILE_SIZE),
        "n_cameras": len(counts),
    }


def over_backgrounds(
    backgrounds: Tensor | None, image: Tensor, alpha: Tensor, render_mode: str
) -> Tensor:
    """Returns the image (C, H, W, X) with colors (C, 3) behind its own, if it has some."""
    if backgrounds is None or "RGB" not in render_mode:
        return image
    color = image[..., :3] + (1 - alpha) * backgrounds[:, None, None, :]
    return torch.cat([color, image[..., 3:]], dim=-1)


# The native renderer draws the whole image at once. `Project` then maps the scene to `means2d`, and
# `Composite` maps `means2d` to the image, so that screen-space gradients are those of an ordinary
# tensor. Results come in tuples: autograd would alias tensors that are inputs.


def _pair_rows(frames: Sequence[_native.Frame]) -> list[slice]:
    """Returns the rows of the M visible pairs that belong to each camera."""
    ends = np.cumsum([0] + [frame.splat_count for frame in frames])
    return [slice(*pair) for pair in pairwise(ends)]


class Project(torch.autograd.Function):
    """(means, quats, scales, opacities, colors, viewmats) -> means2d (M, 2), splats (M, 16).

    `splats` has no values: it represents the rest of the splats in the backward pass.
    """

    @staticmethod
    def forward(
        ctx, views: Views, frames: list[_native.Frame], results: tuple[Tensor], *inputs: Tensor
    ) -> tuple[Tensor, Tensor]:
        ctx.views, ctx.frames = views, frames
        ctx.save_for_backward(*inputs)
        ctx.set_materialize_grads(False)
        return results[0], torch.full((1, 1), torch.nan).expand(len(results[0]), SPLAT_GRADIENT)

    @staticmethod
    @once_differentiable
    def backward(ctx, v_means2d: Tensor | None, v_splats: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        rows = _pair_rows(ctx.frames)
        means2d, splats = (
            (torch.zeros(rows[-1].stop, n) if v is None else v.contiguous()).numpy()
            for v, n in ((v_means2d, 2), (v_splats, SPLAT_GRADIENT))
        )
        gradients = ctx.views.project_backward(
            ctx.saved_tensors,
            lambda c, *scene: _native.project_backward(
                ctx.views.renderer,
                ctx.frames[c],
                *scene,
                v_splats=splats[rows[c]],
                v_means2d=means2d[rows[c]],
            ),
        )
        return None, None, None, *gradients


class Composite(torch.autograd.Function):
    """(means2d, splats, backgrounds or None) -> image (C, H, W, X), alpha (C, H, W, 1)."""

    @staticmethod
    def forward(
        ctx,
        renderer: _native.Renderer,
        frames: list[_native.Frame],
        depth_mode: _native.DepthMode,
        behind: NDArray[np.float32],
        results: tuple[Tensor, Tensor],
        means2d: Tensor,
        splats: Tensor,
        backgrounds: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        ctx.renderer, ctx.frames, ctx.depth_mode, ctx.behind = renderer, frames, depth_mode, behind
        ctx.save_for_backward(*results)
        return results

    @staticmethod
    @once_differentiable
    def backward(ctx, v_image: Tensor, v_alpha: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        image, alpha = ctx.saved_tensors
        v_image, v_alpha = v_image.contiguous(), v_alpha.contiguous()
        if ctx.depth_mode == _native.DepthMode.MEDIAN:
            v_image = v_image.clone()
            v_image[..., -1] = 0
        v_means2d = v_splats = v_backgrounds = None
        if ctx.needs_input_grad[5]:
            all_rows = _pair_rows(ctx.frames)
            v_splats = torch.empty(all_rows[-1].stop, SPLAT_GRADIENT)
            v_means2d = torch.empty(len(v_splats), 2)
            for c, rows in enumerate(all_rows):
                _native.raster_backward(
                    ctx.renderer,
                    ctx.frames[c],
                    v_image=v_image[c].numpy(),
                    v_alpha=v_alpha[c].numpy(),
                    image=image[c].numpy(),
                    alpha=alpha[c].numpy(),
                    background=ctx.behind[c],
                    expected_depth=ctx.depth_mode == _native.DepthMode.EXPECTED,
                    v_splats=v_splats[rows].numpy(),
                    v_means2d=v_means2d[rows].numpy(),
                )
        if ctx.needs_input_grad[7] and image.shape[-1] > 1:
            v_backgrounds = (v_image[..., :3] * (1 - alpha)).sum((1, 2))
        return None, None, None, None, None, v_means2d, v_splats, v_backgrounds


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
    rasterize_mode: str = "classic",
    renderer: _native.Renderer | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Renders N Gaussians into C cameras (Kerbl et al. 2023, with gsplat's conventions).

    A Gaussian of color c adds ``T a c`` to a pixel, where ``a = min(.99, o exp(-d^T S^-1 d / 2))``
    and T is the transmittance of those in front. Contributions with a < 1/255 are skipped, and a
    pixel is finished before T would fall to 1e-4. Gaussians of equal depth blend in input order.

    z is the depth of the center for "D" and "ED". The median depth is that of a surface (Zhang et
    al. 2024, RaDe-GS): z of the point of greatest density along the pixel's ray, at the Gaussian
    where the transmittance of footprints without eps2d falls to one half; 0 if it never does.

    Color, depth and alpha are differentiable with respect to means, quats, scales, opacities,
    colors, viewmats and backgrounds; a median depth is constant. Results are deterministic and
    independent of the number of threads.

    Args:
        means: (N, 3) centers [m].
        quats: (N, 4) wxyz orientations, of any length > 0.
        scales: (N, 3) standard deviations [m], positive.
        opacities: (N,) in [0, 1].
        colors: (N, 3) or (C, N, 3); with `sh_degree`, spherical-harmonic coefficients (N, K, 3) or
            (C, N, K, 3) of the colors ``max(0, 0.5 + sum_k Y_k c_k)``.
        viewmats: (C, 4, 4) world to camera (x right, y down, z forward).
        Ks: (C, 3, 3) intrinsics [px]; skew is ignored. Pixel centers lie at +1/2.
        width, height: of the images [px].
        near_plane, far_plane: centers outside these depths are left out [m].
        radius_clip: Gaussians of at most this radius on the image are left out [px].
        eps2d: Variance by which the pixel blurs every Gaussian [px^2].
        sh_degree: Degree to evaluate, 0 to 3; None if `colors` are colors.
        backgrounds: (C, 3) colors behind everything, black if None; depth has no background.
        render_mode: "RGB"; "D", the accumulated depth sum w z [m]; "ED", the expected depth
            sum w z / sum w; "MD", the median depth; or "RGB+D", "RGB+ED", "RGB+MD".
        rasterize_mode: "classic", or "antialiased": opacities are multiplied by
            sqrt(det S / det(S + eps2d)), so that Gaussians narrower than a pixel keep their light.
        renderer: Threads and memory for several images, see `create_renderer`; one thread if None.

    Returns:
        render_colors (C, H, W, X), X = 3, 1 or 4 by `render_mode`; render_alphas (C, H, W, 1);
        and a dict on the M visible (camera, Gaussian) pairs, in that order, as gsplat's packed one:
        camera_ids, gaussian_ids, depths, opacities (M,), radii, means2d (M, 2), conics (M, 3), and
        width, height, tile_size, tile_width, tile_height, n_cameras. After
        ``meta["means2d"].retain_grad()``, its ``.grad`` holds screen-space gradients [1/px].
    """
    scene = (means, quats, scales, opacities, colors, viewmats)
    require_choice("render_mode", render_mode, CHANNELS)
    require_choice("rasterize_mode", rasterize_mode, ("classic", "antialiased"))
    median, antialiased = "MD" in render_mode, rasterize_mode == "antialiased"
    what = f"rasterize_mode of render_mode {render_mode!r}"
    require(not (median and antialiased), what, "'classic'", repr(rasterize_mode))
    tensors = named_tensors(*scene, Ks, backgrounds, sh_degree=sh_degree)
    optics: dict[str, Any] = {
        "width": width,
        "height": height,
        "near_plane": near_plane,
        "far_plane": far_plane,
        "radius_clip": radius_clip,
        "eps2d": eps2d,
    }
    if means.device.type == "cuda":
        if median:
            raise NotImplementedError(f"render_mode {render_mode!r} needs CPU tensors; use .cpu()")
        gsplat = import_extra("gsplat", "cuda")  # 1.5.3 fails on backgrounds of packed Gaussians
        modes = {"render_mode": render_mode, "rasterize_mode": rasterize_mode}
        image, alpha, meta = gsplat.rasterization(
            *scene, Ks, **optics, sh_degree=sh_degree, **modes
        )
        return over_backgrounds(backgrounds, image, alpha, render_mode), alpha, meta
    require(0 <= eps2d < np.inf, "eps2d", "finite and >= 0 px^2", eps2d)
    views, arrays = prepare(tensors, sh_degree, renderer, **optics, antialiased=antialiased)
    modes = _native.DepthMode
    expected = modes.EXPECTED if "ED" in render_mode else modes.ACCUMULATED
    depth_mode = modes.MEDIAN if median else expected
    behind = arrays.get("backgrounds", np.zeros((len(viewmats), 3), dtype=np.float32))
    shape = len(viewmats), height, width
    image, alpha = torch.empty((*shape, CHANNELS[render_mode])), torch.empty((*shape, 1))
    frames, projected = [], []
    for c, camera in enumerate(views.cameras):
        frame = _native.render(
            views.renderer,
            views.gaussians(arrays, c),
            camera,
            depth_mode=depth_mode,
            background=behind[c],
            image=image[c].numpy(),
            alpha=alpha[c].numpy(),
            keep=views.with_gradients,
        )
        given = None if antialiased else arrays["opacities"]
        projected.append(_native.projected(views.renderer, frame, given))
        frames.append(frame)
    ids, radii, means2d, depths, conics, splat_opacities = joined(projected)
    if views.with_gradients:
        splats = Project.apply(views, frames, (means2d,), *scene)
        style = views.renderer, frames, depth_mode, behind, (image, alpha)
        image, alpha = Composite.apply(*style, *splats, backgrounds)  # pyright: ignore[reportGeneralTypeIssues]
        means2d = splats[0]  # pyright: ignore[reportOptionalSubscript]
    meta = pair_meta([frame.splat_count for frame in frames], width, height) | {
        "gaussian_ids": ids,
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "conics": conics,
        "opacities": splat_opacities,
    }
    return image, alpha, meta
