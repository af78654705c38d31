"""What the rasterisers refuse and how they say so, and what else they share."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatpilot import _native

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
