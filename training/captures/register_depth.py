"""Depth of one camera seen from another."""

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.training.captures.lens import back_project

# [m], stands for "beyond range" while points are moved; far enough that no baseline matters.
_FAR = 1e9


def register_depth(
    depth: NDArray[np.floating],
    K_D: NDArray[np.float64],
    X_CD: RigidTransform,
    K_C: NDArray[np.float64],
    width: int,
    height: int,
) -> NDArray[np.float32]:
    """Carries a depth image into the pixels of another camera.

    Each pixel of D becomes a point, or several where C resolves more finely; each pixel of C takes
    the nearest point that falls into it.

    Args:
        depth: (h, w) [m] along the optical axis of D; 0 unknown, inf beyond range.
        K_D: (3, 3) [px], intrinsics of D.
        X_CD: pose of D in C.
        K_C: (3, 3) [px], intrinsics of C.
        width, height: [px], of C's image.

    Returns:
        (height, width) [m] along the optical axis of C; 0 unknown, inf beyond range.
    """
    # At least one point a pixel of C, so that surfaces behind do not shine through.
    finer = max(1, int(np.ceil(1.05 * K_C[0, 0] / K_D[0, 0])))
    z = np.where(np.isinf(depth), _FAR, depth).repeat(finer, axis=0).repeat(finer, axis=1)
    rows, columns = np.nonzero(z > 0)
    z = z[rows, columns].astype(np.float64)
    p_DQ = back_project(K_D, (columns + 0.5) / finer, (rows + 0.5) / finer, z)
    x, y, z = X_CD.multiply(p_DQ.T)
    front = z > 0
    x, y, z = x[front], y[front], z[front]
    u = np.floor(K_C[0, 0] * x / z + K_C[0, 2])
    v = np.floor(K_C[1, 1] * y / z + K_C[1, 2])
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = v[inside].astype(np.intp) * width + u[inside].astype(np.intp)
    nearest = np.full(height * width, np.inf)
    np.minimum.at(nearest, index, z[inside])
    hit = np.zeros(height * width, dtype=bool)
    hit[index] = True
    nearest[nearest > _FAR / 2] = np.inf
    return np.where(hit, nearest, 0).astype(np.float32).reshape(height, width)
