"""Gaussian splatting with gsplat's interface: native kernels on the CPU, gsplat on CUDA."""

from collections.abc import Callable, Iterable, Sequence
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
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.baked_scene import EPS2D, check_camera, create_renderer

TILE_SIZE = 16  # [px]
CHANNELS = {"RGB": 3, "D": 1, "ED": 1, "MD": 1, "RGB+D": 4, "RGB+ED": 4, "RGB+MD": 4}
RASTERIZE_MODES = ("classic", "antialiased")
SCENE = ("means", "quats", "scales", "opacities", "colors")
TENSORS = (*SCENE, "viewmats", "Ks", "backgrounds")

type Arrays = dict[str, NDArray[Any]]


def by_name(*tensors: Tensor | None) -> dict[str, Tensor]:
    """Names the first of `TENSORS`, without those that are None."""
    given = zip(TENSORS, tensors, strict=False)
    return {name: tensor for name, tensor in given if tensor is not None}


def require_one_of(name: str, value: str, values: Iterable[str]) -> None:
    require(value in values, name, f"one of {', '.join(values)}", repr(value))


def check_shapes(tensors: dict[str, Tensor], sh_degree: int | None) -> None:
    """Raises ValueError for a tensor of a shape, dtype or device that cannot be rendered."""
    require(sh_degree in (None, 0, 1, 2, 3), "sh_degree", "0, 1, 2, 3 or None", sh_degree)
    N, C = (tensors[n].shape[0] if tensors[n].ndim else 0 for n in ("means", "viewmats"))
    color = (3,) if sh_degree is None else ("K", 3)
    allowed: dict[str, tuple[tuple[int | str, ...], ...]] = {
        "means": ((N, 3),),
        "quats": ((N, 4),),
        "scales": ((N, 3),),
        "opacities": ((N,),),
        "colors": ((N, *color), (C, N, *color)),
        "viewmats": ((C, 4, 4),),
        "Ks": ((C, 3, 3),),
        "backgrounds": ((C, 3),),
    }
    for name, tensor in tensors.items():
        fits = any(
            len(shape) == tensor.ndim
            and all(want in (have, "K") for want, have in zip(shape, tensor.shape, strict=True))
            for shape in allowed[name]
        )
        shapes = " or ".join("(" + ", ".join(map(str, s)) + ")" for s in allowed[name])
        require(fits, name, f"of shape {shapes}", tuple(tensor.shape))
        require(tensor.dtype == torch.float32, name, "torch.float32", tensor.dtype, "use .float()")
        device = tensors["means"].device
        require(tensor.device == device, name, f"on {device} like means", tensor.device)
    require(C > 0, "viewmats", "of at least one camera", "none")
    if sh_degree is not None:
        coefficients, needed = tensors["colors"].shape[-2], (sh_degree + 1) ** 2
        what = f"the number of coefficients in colors for sh_degree={sh_degree}"
        require(coefficients >= needed, what, f">= {needed}", coefficients)


def check_values(arrays: Arrays, renderer: _native.Renderer, scale_axes: int = 3) -> None:
    """Raises ValueError for values that cannot be rendered; the first `scale_axes` scales count."""
    scene = {name: arrays[name] for name in SCENE}
    scene["colors"] = scene["colors"].reshape(-1)
    fine = _native.scene_is_valid(renderer, **scene)
    if not fine:
        arrays = arrays | {"scales": np.ascontiguousarray(arrays["scales"][:, :scale_axes])}
    for name, array in arrays.items():
        if fine and name in SCENE:
            continue
        first = _native.first_nonfinite(renderer, array.reshape(-1))
        require_element(first, name, array, "finite")
    if not fine:
        scales, opacities, quats = (arrays[n] for n in ("scales", "opacities", "quats"))
        require_element(_first(scales <= 0), "scales", scales, "> 0 m")
        require_element(
            _first((opacities < 0) | (opacities > 1)), "opacities", opacities, "in [0, 1]"
        )
        row = _native.first_zero_quaternion(quats)
        remedy = "use (1, 0, 0, 0) for no rotation"
        require(row < 0, f"quats[{row}]", "of a length > 0", quats[row].tolist(), remedy)
    for c, X_CW in enumerate(arrays["viewmats"].astype(np.float64)):
        R = X_CW[:3, :3]
        error = max(np.abs(R @ R.T - np.eye(3)).max(), np.abs(X_CW[3] - (0, 0, 0, 1)).max())
        require(
            error <= 1e-3, f"viewmats[{c}]", "a rigid transform", f"one that is off by {error:.3g}"
        )


def _first(bad: NDArray[np.bool_]) -> int:
    """Returns the index of the first true value in the flat array, -1 without one."""
    return int(bad.argmax()) if bad.any() else -1


def require_element(flat_index: int, name: str, array: NDArray, condition: str) -> None:
    if flat_index >= 0:
        index = np.unravel_index(flat_index, array.shape)
        where = ", ".join(str(int(i)) for i in index)
        require(False, f"{name}[{where}]", condition, f"{array[index]:g}")


@dataclass(frozen=True)
class Cameras:
    """C pinhole cameras and the renderer of their images."""

    renderer: _native.Renderer
    intrinsics: list[NDArray[np.float64]]  # C x (3, 3) [px]
    poses: NDArray[np.float64]  # (C, 4, 4) X_CW
    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    sh_degree: int | None
    per_camera_colors: bool

    def arguments(self, c: int) -> dict[str, Any]:
        """Returns camera c as native renderers take it."""
        return {
            "K": self.intrinsics[c],
            "X_CW": self.poses[c],
            "width": self.width,
            "height": self.height,
            "near_plane": self.near_plane,
            "far_plane": self.far_plane,
            "radius_clip": self.radius_clip,
        }

    def scene(self, arrays: Arrays, c: int) -> dict[str, Any]:
        """Returns Gaussians or surfels as native functions take them for camera c."""
        colors = arrays["colors"] if self.sh_degree is not None else arrays["colors"][..., None, :]
        return {
            **{name: arrays[name] for name in SCENE},
            "colors": colors[c] if colors.ndim == 4 else colors,  # (N, K, 3), a view
            "sh_degree": -1 if self.sh_degree is None else self.sh_degree,
        }

    def project_backward(
        self, inputs: Sequence[Tensor], backward: Callable[..., NDArray[np.float64]]
    ) -> list[Tensor]:
        """Returns the gradients of means, quats, scales, opacities, colors and viewmats.

        Args:
            inputs: these six.
            backward: native function of a camera's index and the arguments of its scene and
                gradients; see `_native.project_backward`.
        """
        results = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs]
        results[-1].zero_()
        scene, gradients = (
            {name: to_numpy(tensor) for name, tensor in zip(SCENE, tensors, strict=False)}
            for tensors in (inputs, results)
        )
        for c, X_CW in enumerate(self.poses):
            outputs = self.scene(gradients, c)
            sums = backward(
                c,
                **self.scene(scene, c),
                **{f"v_{name}": outputs[name] for name in SCENE},
                overwrite=c == 0,
                overwrite_colors=c == 0 or self.per_camera_colors,
            )
            results[-1][c, :3] = torch.from_numpy(_pose_gradient(sums, X_CW))
        return results


def _pose_gradient(sums: NDArray[np.float64], X_CW: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns dL/d[R | t] (3, 4) from dL/dR with the center held, dL/dp_C and dL/d(p_W - center).

    p_C = R p_W + t, with p_W = d + center; spherical harmonics look from center = -R^-1 t.
    """
    v_p: NDArray[np.float64] = sums[3]
    v_direction: NDArray[np.float64] = sums[4]
    R, t = X_CW[:3, :3], X_CW[:3, 3]
    v_t = v_p + np.linalg.solve(R.T, v_direction)
    return np.column_stack([sums[:3] - np.outer(v_t, np.linalg.solve(R, t)), v_t])


def prepare(
    tensors: dict[str, Tensor],
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    sh_degree: int | None,
    renderer: _native.Renderer | None,
    scale_axes: int = 3,
) -> tuple[Cameras, Arrays]:
    """Checks CPU tensors that have passed `check_shapes`; returns cameras and arrays."""
    device = tensors["means"].device
    require(device.type == "cpu", "the device", "'cpu' or 'cuda'", device, "move the tensors")
    if torch.is_grad_enabled() and tensors["Ks"].requires_grad:
        raise ValueError("Ks must be without a gradient; use Ks.detach()")
    require(0 <= radius_clip < np.inf, "radius_clip", "finite and >= 0 px", radius_clip)
    renderer = create_renderer() if renderer is None else renderer
    arrays = {name: to_numpy(tensor) for name, tensor in tensors.items()}
    check_values(arrays, renderer, scale_axes)
    cameras = Cameras(
        renderer=renderer,
        intrinsics=[check_camera(K, width, height, near_plane, far_plane) for K in arrays["Ks"]],
        poses=arrays["viewmats"].astype(np.float64),
        width=width,
        height=height,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        sh_degree=sh_degree,
        per_camera_colors=tensors["colors"].ndim == (3 if sh_degree is None else 4),
    )
    return cameras, arrays


def requires_gradients(tensors: dict[str, Tensor]) -> bool:
    return torch.is_grad_enabled() and any(t.requires_grad for t in tensors.values())


def to_numpy(tensor: Tensor) -> NDArray[Any]:
    return np.ascontiguousarray(tensor.detach().numpy())


def joined(parts: Sequence[NDArray]) -> Tensor:
    return torch.from_numpy(parts[0] if len(parts) == 1 else np.concatenate(parts))


def pair_meta(counts: list[int], width: int, height: int) -> dict[str, Any]:
    """Returns gsplat's meta of both rasterizers for `counts` visible Gaussians of each camera."""
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


def over_backgrounds(
    backgrounds: Tensor | None, image: Tensor, alpha: Tensor, render_mode: str
) -> Tensor:
    """Returns the image (C, H, W, X) with colors (C, 3) behind its own, if it has some."""
    if backgrounds is None or "RGB" not in render_mode:
        return image
    color = image[..., :3] + (1 - alpha) * backgrounds[:, None, None, :]
    return torch.cat([color, image[..., 3:]], dim=-1)


# The native renderer draws the whole image at once. `Project` then takes the scene to `means2d`,
# and `Composite` takes `means2d` to the image. So the screen-space gradients that densification
# needs are the gradient of an ordinary intermediate tensor.

SPLAT_GRADIENT = 16
"""Floats of a splat's gradient: mean 2, ln opacity, shape 3, color 3, depth; 6 unused."""


@dataclass(frozen=True)
class Style:
    """What is drawn of Gaussians."""

    eps2d: float
    antialiased: bool
    backgrounds: NDArray[np.float32]  # (C, 3)
    channels: int
    depth_mode: _native.DepthMode


class Drawing(NamedTuple):
    """Images of C cameras with M visible (camera, Gaussian) pairs, and their frames."""

    image: Tensor  # (C, H, W, X)
    alpha: Tensor  # (C, H, W, 1)
    frames: list[_native.Frame]
    projected: list[tuple[NDArray[Any], ...]]  # of each camera, see `_native.projected`

    def means2d(self) -> Tensor:
        """Returns (M, 2) [px]."""
        return joined([of_camera[2] for of_camera in self.projected])


def draw(cameras: Cameras, style: Style, arrays: Arrays, keep: bool) -> Drawing:
    """Renders; with `keep`, a backward pass can start from the frames."""
    size = (len(cameras.poses), cameras.height, cameras.width)
    drawing = Drawing(torch.empty((*size, style.channels)), torch.empty((*size, 1)), [], [])
    for c in range(len(cameras.poses)):
        frame = _native.render(
            cameras.renderer,
            **cameras.scene(arrays, c),
            **cameras.arguments(c),
            eps2d=style.eps2d,
            antialiased=style.antialiased,
            depth_mode=style.depth_mode,
            background=style.backgrounds[c],
            image=drawing.image[c].numpy(),
            alpha=drawing.alpha[c].numpy(),
            keep=keep,
        )
        given = None if style.antialiased else arrays["opacities"]
        drawing.projected.append(_native.projected(cameras.renderer, frame, given))
        drawing.frames.append(frame)
    return drawing


def _pair_rows(frames: Sequence[_native.Frame]) -> list[slice]:
    """Returns the rows of the M visible pairs that belong to each camera."""
    ends = np.cumsum([0] + [frame.splat_count for frame in frames])
    return [slice(*pair) for pair in pairwise(ends)]


class Project(torch.autograd.Function):
    """(means, quats, scales, opacities, colors, viewmats) -> means2d (M, 2), splats (M, 16).

    `splats` has no values: it stands for the rest of the splats in the backward pass.
    """

    @staticmethod
    def forward(ctx, cameras: Cameras, drawing: Drawing, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        ctx.cameras, ctx.frames = cameras, drawing.frames
        ctx.save_for_backward(*inputs)
        ctx.set_materialize_grads(False)
        means2d = drawing.means2d()
        return means2d, torch.full((1, 1), torch.nan).expand(len(means2d), SPLAT_GRADIENT)

    @staticmethod
    @once_differentiable
    def backward(ctx, v_means2d: Tensor | None, v_splats: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        rows = _pair_rows(ctx.frames)
        means2d, splats = (
            (torch.zeros(rows[-1].stop, n) if v is None else v.contiguous()).numpy()
            for v, n in ((v_means2d, 2), (v_splats, SPLAT_GRADIENT))
        )
        gradients = ctx.cameras.project_backward(
            ctx.saved_tensors,
            lambda c, **arguments: _native.project_backward(
                ctx.cameras.renderer,
                ctx.frames[c],
                v_splats=splats[rows[c]],
                v_means2d=means2d[rows[c]],
                **arguments,
            ),
        )
        return None, None, *gradients


class Composite(torch.autograd.Function):
    """(means2d, splats, backgrounds or None) -> image (C, H, W, X), alpha (C, H, W, 1)."""

    @staticmethod
    def forward(
        ctx,
        cameras: Cameras,
        style: Style,
        drawing: Drawing,
        means2d: Tensor,
        splats: Tensor,
        backgrounds: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        # The frames alone: an output that its own node refers to is never freed.
        ctx.renderer, ctx.style, ctx.frames = cameras.renderer, style, drawing.frames
        ctx.save_for_backward(drawing.image, drawing.alpha)
        return drawing.image, drawing.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx, v_image: Tensor, v_alpha: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        style: Style = ctx.style
        image, alpha = ctx.saved_tensors
        v_image, v_alpha = v_image.contiguous(), v_alpha.contiguous()
        if style.depth_mode == _native.DepthMode.MEDIAN:
            v_image = v_image.clone()
            v_image[..., -1] = 0
        v_means2d = v_splats = v_backgrounds = None
        if ctx.needs_input_grad[3]:
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
                    background=style.backgrounds[c],
                    expected_depth=style.depth_mode == _native.DepthMode.EXPECTED,
                    v_splats=v_splats[rows].numpy(),
                    v_means2d=v_means2d[rows].numpy(),
                )
        if ctx.needs_input_grad[5] and style.channels > 1:
            v_backgrounds = (v_image[..., :3] * (1 - alpha)).sum((1, 2))
        return None, None, None, v_means2d, v_splats, v_backgrounds


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
    and T is the transmittance of those in front. S is its covariance projected by the Jacobian at
    its center, plus eps2d on the diagonal. Contributions with a < 1/255 are skipped, and a pixel is
    finished before T would fall to 1e-4. Gaussians of equal depth blend in the order of the input.

    z is the depth of the center for "D" and "ED". The median depth is that of a surface (Zhang et
    al. 2024, RaDe-GS): z of the point of greatest density along the pixel's ray, at the Gaussian
    where the transmittance of footprints without eps2d falls to one half; 0 if it never does. A
    flat Gaussian has the depth of its plane, n . p = n . c with n = covariance^-1 c for a center c
    in the camera frame. Where z exceeds c_z, d counts z / c_z times.

    Color, depth and alpha are differentiable with respect to means, quats, scales, opacities,
    colors, viewmats (all twelve numbers, taken as free) and backgrounds. A Gaussian that is skipped
    or clamped at a = .99 has no derivative there, and a median depth is constant. Results are
    deterministic and independent of the number of threads.

    Args:
        means: (N, 3) centers [m].
        quats: (N, 4) wxyz orientations, of any length > 0.
        scales: (N, 3) standard deviations [m], positive.
        opacities: (N,) in [0, 1].
        colors: (N, 3) or (C, N, 3); with `sh_degree`, spherical-harmonic coefficients (N, K, 3) or
            (C, N, K, 3) of the colors ``max(0, 0.5 + sum_k Y_k c_k)``.
        viewmats: (C, 4, 4) world to camera (x right, y down, z forward).
        Ks: (C, 3, 3) intrinsics [px]; skew is ignored. Pixel centers lie at +1/2.
        width: Image width [px].
        height: Image height [px].
        near_plane: Gaussians whose center is nearer along z are left out [m].
        far_plane: The same for those farther away [m].
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

    Raises:
        ValueError: a tensor has the wrong shape, dtype, device or values, or Ks a gradient.
        NotImplementedError: median depth of tensors on a GPU.
        ModuleNotFoundError: tensors are on a GPU and gsplat is not installed.
    """
    scene = (means, quats, scales, opacities, colors, viewmats)
    tensors = by_name(*scene, Ks, backgrounds)
    require_one_of("render_mode", render_mode, CHANNELS)
    require_one_of("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
    median, antialiased = "MD" in render_mode, rasterize_mode == "antialiased"
    what = f"rasterize_mode of render_mode {render_mode!r}"
    require(not (median and antialiased), what, "'classic'", repr(rasterize_mode))
    check_shapes(tensors, sh_degree)
    if means.device.type == "cuda":
        if median:
            raise NotImplementedError(f"render_mode {render_mode!r} needs CPU tensors; use .cpu()")
        gsplat = import_extra("gsplat", "cuda")  # 1.5.3 fails on backgrounds of packed Gaussians
        image, alpha, meta = gsplat.rasterization(
            *scene,
            Ks,
            width,
            height,
            near_plane=near_plane,
            far_plane=far_plane,
            radius_clip=radius_clip,
            eps2d=eps2d,
            sh_degree=sh_degree,
            render_mode=render_mode,
            rasterize_mode=rasterize_mode,
        )
        return over_backgrounds(backgrounds, image, alpha, render_mode), alpha, meta
    require(0 <= eps2d < np.inf, "eps2d", "finite and >= 0 px^2", eps2d)
    size = (width, height, near_plane, far_plane, radius_clip)
    cameras, arrays = prepare(tensors, *size, sh_degree, renderer)
    mode = _native.DepthMode
    depth_mode = mode.EXPECTED if "ED" in render_mode else mode.ACCUMULATED
    style = Style(
        eps2d=eps2d,
        antialiased=antialiased,
        backgrounds=arrays.get("backgrounds", np.zeros((len(viewmats), 3), dtype=np.float32)),
        channels=CHANNELS[render_mode],
        depth_mode=mode.MEDIAN if median else depth_mode,
    )
    keep = requires_gradients(tensors)
    drawing = draw(cameras, style, arrays, keep)
    if not keep:
        return drawing.image, drawing.alpha, _meta(drawing, drawing.means2d())
    splats = Project.apply(cameras, drawing, *scene)
    image, alpha = Composite.apply(cameras, style, drawing, *splats, backgrounds)  # pyright: ignore[reportGeneralTypeIssues]
    return image, alpha, _meta(drawing, splats[0])


def _meta(drawing: Drawing, means2d: Tensor) -> dict[str, Any]:
    ids, radii, _, depths, conics, opacities = map(joined, zip(*drawing.projected, strict=True))
    counts = [len(p[0]) for p in drawing.projected]
    return pair_meta(counts, *drawing.image.shape[2:0:-1]) | {
        "gaussian_ids": ids,
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "conics": conics,
        "opacities": opacities,
    }
