"""Gaussian splatting with gsplat's interface: native kernels on the CPU, gsplat on CUDA."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpilot import _native
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.splats.baked_scene import EPS2D, check_camera, create_renderer

TILE_SIZE = 16  # [px]
CHANNELS = {"RGB": 3, "D": 1, "ED": 1, "MD": 1, "RGB+D": 4, "RGB+ED": 4, "RGB+MD": 4}
SCENE = ("means", "quats", "scales", "opacities", "colors")
TENSORS = (*SCENE, "viewmats", "Ks", "backgrounds")


def by_name(*tensors: Tensor | None) -> dict[str, Tensor]:
    """The first of `TENSORS` by their names, less those that are None."""
    given = zip(TENSORS, tensors, strict=False)
    return {name: tensor for name, tensor in given if tensor is not None}


def check_shapes(tensors: dict[str, Tensor], sh_degree: int | None) -> None:
    """Raises ValueError for a tensor of another shape, dtype or device than `rasterize` takes."""
    N = tensors["means"].shape[0] if tensors["means"].ndim else 0
    C = tensors["viewmats"].shape[0] if tensors["viewmats"].ndim else 0
    allowed: dict[str, tuple[tuple[int | str, ...], ...]] = {
        "means": ((N, 3),),
        "quats": ((N, 4),),
        "scales": ((N, 3),),
        "opacities": ((N,),),
        "colors": ((N, 3), (C, N, 3)),
        "viewmats": ((C, 4, 4),),
        "Ks": ((C, 3, 3),),
        "backgrounds": ((C, 3),),
    }
    if sh_degree is not None:
        if sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"sh_degree is {sh_degree}; it must be 0, 1, 2, 3 or None")
        allowed["colors"] = ((N, "K", 3), (C, N, "K", 3))
    for name, tensor in tensors.items():
        if not any(
            len(shape) == tensor.ndim
            and all(want in (have, "K") for want, have in zip(shape, tensor.shape, strict=True))
            for shape in allowed[name]
        ):
            wanted = " or ".join("(" + ", ".join(map(str, s)) + ")" for s in allowed[name])
            hint = "" if name != "colors" else f" with sh_degree={sh_degree}"
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}; it must be {wanted}{hint}")
        if tensor.dtype != torch.float32:
            raise ValueError(f"{name} is {tensor.dtype}; it must be torch.float32: use .float()")
        if tensor.device != tensors["means"].device:
            raise ValueError(
                f"{name} is on {tensor.device} and means on {tensors['means'].device}; move them "
                "to one device"
            )
    if C == 0:
        raise ValueError("viewmats has shape (0, 4, 4); at least one camera is needed")
    if sh_degree is not None and tensors["colors"].shape[-2] < (sh_degree + 1) ** 2:
        raise ValueError(
            f"colors has {tensors['colors'].shape[-2]} coefficients; sh_degree={sh_degree} needs "
            f"{(sh_degree + 1) ** 2}"
        )


def check_values(
    arrays: dict[str, np.ndarray], renderer: _native.Renderer, scale_axes: int = 3
) -> None:
    """Raises ValueError for values that cannot be rendered, naming tensor, index and remedy.

    Of scales, the first `scale_axes` matter.
    """
    scene = {name: arrays[name] for name in SCENE}
    scene["colors"] = scene["colors"].reshape(-1)
    fine = _native.scene_is_valid(renderer, **scene)
    if not fine:
        arrays = arrays | {"scales": np.ascontiguousarray(arrays["scales"][:, :scale_axes])}
    for name, array in arrays.items():
        if fine and name in SCENE:
            continue
        first = _native.first_nonfinite(renderer, array.reshape(-1))
        if first >= 0:
            raise _bad_value(name, array, first, "be finite")
    if not fine:
        _check_ranges(arrays)
    for c, X_CW in enumerate(arrays["viewmats"].astype(np.float64)):
        R = X_CW[:3, :3]
        error = max(np.abs(R @ R.T - np.eye(3)).max(), np.abs(X_CW[3] - (0, 0, 0, 1)).max())
        if error > 1e-3:
            raise ValueError(
                f"viewmats[{c}] is not a rigid transform: R R^T or the last row is off by "
                f"{error:.3g}, more than 0.001"
            )


def _check_ranges(arrays: dict[str, np.ndarray]) -> None:
    limits = {
        "scales": (lambda a: a <= 0, "be positive"),
        "opacities": (lambda a: (a < 0) | (a > 1), "lie in [0, 1]"),
    }
    for name, (is_bad, requirement) in limits.items():
        bad = is_bad(arrays[name])
        if bad.any():
            raise _bad_value(name, arrays[name], int(bad.argmax()), requirement)
    quats = arrays["quats"]
    first = _native.first_zero_quaternion(quats)
    if first >= 0:
        raise ValueError(
            f"quats[{first}] is {quats[first].tolist()}, which cannot be normalised; use "
            "(1, 0, 0, 0) for no rotation"
        )


def _bad_value(name: str, array: np.ndarray, flat_index: int, requirement: str) -> ValueError:
    index = np.unravel_index(flat_index, array.shape)
    where = ", ".join(str(int(i)) for i in index)
    return ValueError(f"{name}[{where}] is {array[index]:g}; it must {requirement}")


def check_render_mode(render_mode: str, modes: Iterable[str] = CHANNELS) -> None:
    if render_mode not in modes:
        raise ValueError(f"render_mode is {render_mode!r}; it must be one of {', '.join(modes)}")


def depth_mode_of(render_mode: str) -> _native.DepthMode:
    """What the depth of a `render_mode` is; of one without depth, any."""
    if "MD" in render_mode:
        return _native.DepthMode.MEDIAN
    return _native.DepthMode.EXPECTED if "ED" in render_mode else _native.DepthMode.ACCUMULATED


def check_device(means: Tensor) -> None:
    if means.device.type != "cpu":
        raise ValueError(f"tensors are on {means.device}; move them to 'cpu' or 'cuda'")


def pair_meta(counts: list[int], width: int, height: int) -> dict[str, Any]:
    """gsplat's meta that both rasterisers have, for `counts` visible Gaussians of each camera."""
    cameras = torch.arange(len(counts))
    return {
        "camera_ids": torch.repeat_interleave(cameras, torch.tensor(counts)),
        "width": width,
        "height": height,
        "tile_size": TILE_SIZE,
        "tile_width": -(-width // TILE_SIZE),
        "tile_height": -(-height // TILE_SIZE),
        "n_cameras": len(counts),
    }


class Drawing(NamedTuple):
    """Images of C cameras with M visible (camera, Gaussian) pairs, and what remains of them."""

    image: Tensor  # (C, H, W, X)
    alpha: Tensor  # (C, H, W, 1)
    frames: list[_native.Frame]
    projected: list[tuple[NDArray[Any], ...]]  # of each camera, see `_native.projected`

    def means2d(self) -> Tensor:
        """(M, 2) [px]."""
        return joined([of_camera[2] for of_camera in self.projected])


@dataclass(frozen=True)
class Views:
    """C cameras and how to render them."""

    renderer: _native.Renderer
    intrinsics: list[NDArray[np.float64]]  # C x (3, 3) [px]
    poses: NDArray[np.float64]  # (C, 4, 4) X_CW
    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    antialiased: bool
    sh_degree: int | None
    per_camera_colors: bool
    backgrounds: NDArray[np.float32]  # (C, 3)
    channels: int
    depth_mode: _native.DepthMode
    absgrad: bool

    def draw(self, gaussians: dict[str, NDArray[np.float32]], keep: bool) -> Drawing:
        """Renders; with `keep`, a backward pass can start from the frames."""
        drawing = self.blank()
        for c in range(len(self.poses)):
            frame = _native.render(
                self.renderer,
                **scene_arguments(gaussians, self.sh_degree, c),
                K=self.intrinsics[c],
                X_CW=self.poses[c],
                near_plane=self.near_plane,
                far_plane=self.far_plane,
                eps2d=self.eps2d,
                antialiased=self.antialiased,
                **self.image_arguments(drawing, c),
                keep=keep,
            )
            given = None if self.antialiased else gaussians["opacities"]
            drawing.projected.append(_native.projected(self.renderer, frame, given))
            drawing.frames.append(frame)
        return drawing

    def blank(self) -> Drawing:
        """Images that are not initialised."""
        size = (len(self.poses), self.height, self.width)
        return Drawing(torch.empty((*size, self.channels)), torch.empty((*size, 1)), [], [])

    def image_arguments(self, drawing: Drawing, camera: int) -> dict[str, Any]:
        """What every native rendering of one camera takes."""
        return {
            "width": self.width,
            "height": self.height,
            "radius_clip": self.radius_clip,
            "depth_mode": self.depth_mode,
            "background": self.backgrounds[camera],
            "image": drawing.image[camera].numpy(),
            "alpha": drawing.alpha[camera].numpy(),
        }


def scene_arguments(
    gaussians: dict[str, NDArray[np.float32]], sh_degree: int | None, camera: int
) -> dict[str, Any]:
    """What native functions take of Gaussians or surfels, for one camera."""
    colors = gaussians["colors"] if sh_degree is not None else gaussians["colors"][..., None, :]
    return {
        **{name: gaussians[name] for name in SCENE},
        "colors": colors[camera] if colors.ndim == 4 else colors,  # (N, K, 3), a view
        "sh_degree": -1 if sh_degree is None else sh_degree,
    }


def gradient_arguments(
    gradients: dict[str, NDArray[np.float32]], sh_degree: int | None, camera: int
) -> dict[str, Any]:
    """Where native functions write the gradients of `scene_arguments`."""
    arguments = scene_arguments(gradients, sh_degree, camera)
    return {f"v_{name}": arguments[name] for name in SCENE}


def rows_of_cameras(frames: Sequence[_native.Frame]) -> list[slice]:
    """Which rows of the M visible pairs belong to each camera."""
    ends = np.cumsum([0] + [frame.splat_count for frame in frames])
    return [slice(*pair) for pair in pairwise(ends)]


def to_numpy(tensor: Tensor) -> NDArray[Any]:
    return np.ascontiguousarray(tensor.detach().numpy())


def joined(parts: Sequence[NDArray]) -> Tensor:
    return torch.from_numpy(parts[0] if len(parts) == 1 else np.concatenate(parts))


def scene_arrays(tensors: Sequence[Tensor]) -> dict[str, NDArray[np.float32]]:
    """The first five, in the order of SCENE."""
    return {name: to_numpy(tensor) for name, tensor in zip(SCENE, tensors, strict=False)}


# The CPU rasteriser as two autograd functions with the image-plane means between them.
#
# The native renderer draws the whole image at once. `Project` then takes the scene to `means2d`,
# and `Composite` takes `means2d` to the image. So the screen-space gradients that densification
# needs are the gradient of an ordinary intermediate tensor.


SPLAT_GRADIENT = (
    16  # floats a splat: mean 2, |mean| 2, ln opacity, shape 3, colour 3, depth; 4 idle
)


def splat_outputs(drawing: Drawing) -> tuple[Tensor, Tensor]:
    """`means2d` (M, 2), and what stands for the rest of the splats.

    The latter, (M, 16), has no values that mean anything: it is there for its gradient.
    """
    means2d = drawing.means2d()
    return means2d, torch.full((1, 1), torch.nan).expand(len(means2d), SPLAT_GRADIENT)


def splat_gradients(
    count: int, v_means2d: Tensor | None, v_splats: Tensor | None
) -> tuple[Tensor, Tensor]:
    """The gradients of the `splat_outputs` of M = `count` pairs, zeros where None."""
    if v_means2d is None:
        v_means2d = torch.zeros(count, 2)
    if v_splats is None:
        v_splats = torch.zeros(count, SPLAT_GRADIENT)
    return v_means2d.contiguous(), v_splats.contiguous()


class Project(torch.autograd.Function):
    """(means, quats, scales, opacities, colors, viewmats) -> see `splat_outputs`."""

    @staticmethod
    def forward(ctx, views: Views, drawing: Drawing, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        ctx.views, ctx.frames = views, drawing.frames
        ctx.save_for_backward(*inputs)
        ctx.set_materialize_grads(False)
        return splat_outputs(drawing)

    @staticmethod
    @once_differentiable
    def backward(ctx, v_means2d: Tensor | None, v_splats: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        views: Views = ctx.views
        inputs = ctx.saved_tensors
        *scene_gradients, v_viewmats = [
            torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs
        ]
        v_viewmats.zero_()
        scene, gradients = scene_arrays(inputs), scene_arrays(scene_gradients)
        rows_of = rows_of_cameras(ctx.frames)
        v_means2d, v_splats = splat_gradients(rows_of[-1].stop, v_means2d, v_splats)
        for c, rows in enumerate(rows_of):
            by_camera = _native.project_backward(
                views.renderer,
                ctx.frames[c],
                **scene_arguments(scene, views.sh_degree, c),
                v_splats=v_splats[rows].numpy(),
                v_means2d=v_means2d[rows].numpy(),
                **gradient_arguments(gradients, views.sh_degree, c),
                overwrite=c == 0,
                overwrite_colors=c == 0 or views.per_camera_colors,
            )
            if ctx.needs_input_grad[-1]:
                v_viewmats[c, :3] = torch.from_numpy(_pose_gradient(by_camera, views.poses[c]))
        return None, None, *scene_gradients, v_viewmats


class Composite(torch.autograd.Function):
    """(means2d, splats, backgrounds or None) -> image (C, H, W, X), alpha (C, H, W, 1).

    means2d and splats are those of `splat_outputs`.
    """

    @staticmethod
    def forward(
        ctx,
        views: Views,
        drawing: Drawing,
        means2d: Tensor,
        splats: Tensor,
        backgrounds: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        # The frames alone: an output that its own node refers to is never freed.
        ctx.views, ctx.frames = views, drawing.frames
        ctx.save_for_backward(means2d, drawing.image, drawing.alpha)
        return drawing.image, drawing.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx, v_image: Tensor, v_alpha: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        views: Views = ctx.views
        means2d, image, alpha = ctx.saved_tensors
        v_image, v_alpha = v_image.contiguous(), v_alpha.contiguous()
        if views.depth_mode == _native.DepthMode.MEDIAN:
            v_image = v_image.clone()
            v_image[..., -1] = 0
        v_means2d = v_splats = v_backgrounds = None
        if ctx.needs_input_grad[2]:
            v_splats = torch.empty(len(means2d), SPLAT_GRADIENT)
            v_means2d = torch.empty(len(means2d), 2)
            for c, rows in enumerate(rows_of_cameras(ctx.frames)):
                _native.raster_backward(
                    views.renderer,
                    ctx.frames[c],
                    v_image=v_image[c].numpy(),
                    v_alpha=v_alpha[c].numpy(),
                    image=image[c].numpy(),
                    alpha=alpha[c].numpy(),
                    background=views.backgrounds[c],
                    expected_depth=views.depth_mode == _native.DepthMode.EXPECTED,
                    absolute=views.absgrad,
                    v_splats=v_splats[rows].numpy(),
                    v_means2d=v_means2d[rows].numpy(),
                )
            if views.absgrad:
                means2d.absgrad = v_splats[:, 2:4].clone()
        if ctx.needs_input_grad[4] and views.channels > 1:
            v_backgrounds = (v_image[..., :3] * (1 - alpha)).sum((1, 2))
        return None, None, v_means2d, v_splats, v_backgrounds


def _pose_gradient(sums: NDArray[np.float64], X_CW: NDArray[np.float64]) -> NDArray[np.float64]:
    """dL/d[R | t] (3, 4) from dL/dR with the centre held, dL/dp_C and dL/d(p_W - centre).

    p_C = R p_W + t, with p_W = d + centre; spherical harmonics look from centre = -R^-1 t.
    """
    v_R = sums[:3]
    v_p: NDArray[np.float64] = sums[3]
    v_direction: NDArray[np.float64] = sums[4]
    R, t = X_CW[:3, :3], X_CW[:3, 3]
    v_t = v_p + np.linalg.solve(R.T, v_direction)
    return np.column_stack([v_R - np.outer(v_t, np.linalg.solve(R, t)), v_t])


# gsplat's CUDA kernels, with the results that `rasterize` and `rasterize_surfels` have.
#
# Written for gsplat 1.5.3, which fails on backgrounds behind Gaussians that it packs, on surfels of
# colours with depth, and gives of surfels what it has for every pair of camera and surfel, seen or
# not, and of one camera normals without the camera's dimension.


def rasterize_by_gsplat(
    scene: tuple[Tensor, ...], *arguments: Any, backgrounds: Tensor | None, **options: Any
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """What `rasterize` returns.

    Args:
        scene: means, quats, scales, opacities, colors and viewmats.
        arguments: Ks, width and height.
        backgrounds: (C, 3), or None.
        options: as gsplat's.
    """
    gsplat = import_extra("gsplat", "cuda")
    image, alpha, meta = gsplat.rasterization(*scene, *arguments, **options)
    return _over_backgrounds(backgrounds, image, alpha, options["render_mode"]), alpha, meta


def rasterize_surfels_by_gsplat(
    scene: tuple[Tensor, ...],
    Ks: Tensor,
    width: int,
    height: int,
    *,
    backgrounds: Tensor | None,
    **options: Any,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor, Tensor, dict[str, Any]]:
    """What `rasterize_surfels` returns; arguments as of `rasterize_by_gsplat`."""
    gsplat = import_extra("gsplat", "cuda")
    *splats, colors, viewmats = scene
    if options["sh_degree"] is None:
        colors = colors.expand(len(viewmats), len(splats[0]), -1)
    image, alpha, normals, surface, distort, median, dense = gsplat.rasterization_2dgs(
        *splats, colors, viewmats, Ks, width, height, **options
    )
    if surface is not None:
        surface = surface.reshape(normals.shape)
    seen = (dense["radii"] > 0).all(dim=-1)  # (C, N)
    camera_ids, gaussian_ids = seen.nonzero(as_tuple=True)
    pairs = "depths", "opacities", "radii", "means2d", "normals"
    meta = dense | {name: dense[name][seen] for name in pairs}
    R_WC = torch.linalg.inv(viewmats)[camera_ids, :3, :3]
    meta["normals"] = (R_WC @ meta["normals"][..., None])[..., 0]
    meta |= {"camera_ids": camera_ids, "gaussian_ids": gaussian_ids}
    image = _over_backgrounds(backgrounds, image, alpha, options["render_mode"])
    return image, alpha, normals, surface, distort, median, meta


def _over_backgrounds(
    backgrounds: Tensor | None, image: Tensor, alpha: Tensor, render_mode: str
) -> Tensor:
    """The image (C, H, W, X) with colours (C, 3) behind its own, if it has some."""
    if backgrounds is None or "RGB" not in render_mode:
        return image
    color = image[..., :3] + (1 - alpha) * backgrounds[:, None, None, :]
    return torch.cat([color, image[..., 3:]], dim=-1)


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
