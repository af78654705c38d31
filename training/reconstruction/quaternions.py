"""Rotations of many vectors at once."""

import torch
from torch import Tensor


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Returns the vectors (N, 3) turned by the quaternions (N, 4) wxyz of any length but zero."""
    q = torch.nn.functional.normalize(quats, dim=1)
    w, axis = q[:, :1], q[:, 1:]
    across = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * across + torch.linalg.cross(axis, across)
