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
    x = (torch.arange(W, dtype=depths.dtype) + 0.5 - Ks[:, None, 0, 2]) / Ks[:, None, 0, 0]
    y = (torch.arange(H, dtype=depths.dtype) + 0.5 - Ks[:, None, 1, 2]) / Ks[:, None, 1, 1]
    rays = torch.stack(
        [x[:, None, :].expand(C, H, W), y[:, :, None].expand(C, H, W), torch.ones(C, H, W)], -1
    )
    points = depths * rays.to(depths.dtype)  # (C, H, W, 3) in the camera frame
    down = points[:, 2:, 1:-1] - points[:, :-2, 1:-1]
    right = points[:, 1:-1, 2:] - points[:, 1:-1, :-2]
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, right), dim=-1)
    padded = torch.nn.functional.pad(normals, (0, 0, 1, 1, 1, 1))
    return torch.einsum("cji,chwj->chwi", viewmats[:, :3, :3], padded)
