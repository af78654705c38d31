"""Surface normals from depth images."""

import torch
from torch import Tensor


def depth_to_normals(depths: Tensor, viewmats: Tensor, Ks: Tensor) -> Tensor:
    """Unit normals of the surface that depth images show, by central differences.

    The normal at a pixel is that of the plane through the differences between its neighbours'
    points, ``(p_below - p_above) x (p_right - p_left)``, which faces the camera (Huang et al. 2024,
    equation 15). Differentiable with respect to depths and viewmats.

    Args:
        depths: (C, H, W, 1) depth along z [m].
        viewmats: (C, 4, 4) world to camera (x right, y down, z forward).
        Ks: (C, 3, 3) intrinsics [px]; pixel centres lie at +1/2.

    Returns:
        (C, H, W, 3) in the world; zero at the border and where the depth is zero all around.

    Raises:
        ValueError: the shapes do not fit.
    """
    if depths.ndim != 4 or depths.shape[-1] != 1:
        raise ValueError(f"depths has shape {tuple(depths.shape)}; it must be (C, H, W, 1)")
    C, H, W, _ = depths.shape
    for name, tensor, size in (("viewmats", viewmats, 4), ("Ks", Ks, 3)):
        if tensor.shape != (C, size, size):
            raise ValueError(
                f"{name} has shape {tuple(tensor.shape)}; it must be ({C}, {size}, {size})"
            )
    # Component by component: images of vectors take torch several times as long.
    x = ((torch.arange(W) + 0.5 - Ks[:, None, 0, 2]) / Ks[:, None, 0, 0])[:, None, :]
    y = ((torch.arange(H) + 0.5 - Ks[:, None, 1, 2]) / Ks[:, None, 1, 1])[:, :, None]
    z = depths[..., 0]  # (C, H, W)
    point = (x * z, y * z, z)  # in the camera frame
    a0, a1, a2 = (c[:, 2:, 1:-1] - c[:, :-2, 1:-1] for c in point)
    b0, b1, b2 = (c[:, 1:-1, 2:] - c[:, 1:-1, :-2] for c in point)
    n = (a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0)
    squared = n[0] * n[0] + n[1] * n[1] + n[2] * n[2]
    # Without a plane there is neither a normal nor a gradient, which division would make huge.
    inverse = torch.where(squared > 1e-24, torch.rsqrt(squared.clamp(min=1e-24)), 0.0)
    R = viewmats[:, :3, :3, None, None]
    normals = torch.stack(
        [(R[:, 0, i] * n[0] + R[:, 1, i] * n[1] + R[:, 2, i] * n[2]) * inverse for i in range(3)],
        -1,
    )
    return torch.nn.functional.pad(normals, (0, 0, 1, 1, 1, 1))
