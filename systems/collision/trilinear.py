"""Trilinear interpolation of a regular grid, written once for numpy arrays and torch tensors."""

from typing import Any

import numpy as np


def grid_strides(shape: tuple[int, ...]) -> np.ndarray:
    """Distance, in elements, between neighbours along x, y and z of a C-ordered grid; (3,) int."""
    return np.array([shape[1] * shape[2], shape[2], 1], dtype=np.intp)


def corner_offsets(shape: tuple[int, ...]) -> np.ndarray:
    """Flat-index offsets of the eight corners of a cell from its lowest one; (2, 2, 2, 1) int."""
    sx, sy, sz = grid_strides(shape)
    step = np.arange(2)
    return (
        step[:, None, None, None] * sx + step[:, None, None] * sy + step[:, None] * sz
    )  # (2, 2, 2, 1)


def trilinear(corners: Any, fx: Any, fy: Any, fz: Any) -> Any:
    """The interpolant of eight corner values at the fractions (fx, fy, fz) of the cell.

    Fractions outside [0, 1] extrapolate the cell's polynomial.

    Args:
        corners: (2, 2, 2, N), indexed by the corner's x, y and z.
        fx, fy, fz: (N,) each.

    Returns:
        (N,) values.
    """
    along_yz = corners[0] + fx * (corners[1] - corners[0])  # (2, 2, N)
    along_z = along_yz[0] + fy * (along_yz[1] - along_yz[0])  # (2, N)
    return along_z[0] + fz * (along_z[1] - along_z[0])


def trilinear_with_gradient(corners: Any, fx: Any, fy: Any, fz: Any) -> tuple[Any, Any, Any, Any]:
    """`trilinear` with its exact partial derivatives by fx, fy and fz.

    Returns:
        value, d/dfx, d/dfy, d/dfz: (N,) each.
    """
    slope_x = corners[1] - corners[0]  # (2, 2, N)
    along_yz = corners[0] + fx * slope_x
    slope_y = along_yz[1] - along_yz[0]  # (2, N)
    along_z = along_yz[0] + fy * slope_y
    slope_z = along_z[1] - along_z[0]  # (N,)
    slope_x = slope_x[0] + fy * (slope_x[1] - slope_x[0])  # (2, N)
    return (
        along_z[0] + fz * slope_z,
        slope_x[0] + fz * (slope_x[1] - slope_x[0]),
        slope_y[0] + fz * (slope_y[1] - slope_y[0]),
        slope_z,
    )
