"""Reading the poses of captures."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.read_limit import read_text

_LAST_ROW = (0.0, 0.0, 0.0, 1.0)
_LARGEST = 1e8
"""[m], beyond which a position is not on Earth, whatever its origin."""


def read_rows(file: Path, columns: int, what: str) -> list[NDArray[np.float64]]:
    """Returns the rows of numbers of a text file, each (columns,); NaN is read as such.

    Lines that start with # and empty lines at the end are left out.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a line does not hold `columns` numbers, which `what` describes.
    """
    if not file.is_file():
        raise FileNotFoundError(f"{file}: the file is missing")
    rows = []
    for number, line in enumerate(read_text(file, "replace").rstrip().splitlines(), start=1):
        if line.startswith("#"):
            continue
        try:
            row = np.array(line.split(), dtype=np.float64)
        except ValueError:
            row = np.array([])
        if row.shape != (columns,):
            raise ValueError(f"{file}, line {number}: {line[:80]!r} is no {what}")
        rows.append(row)
    return rows


def read_matrix(file: Path) -> NDArray[np.float64]:
    """Returns the matrix (4, 4) in a text file; NaN and infinities are read as such.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it does not hold four rows of four numbers.
    """
    rows = read_rows(file, 4, "row of a 4x4 matrix; four numbers are needed")
    if len(rows) != 4:
        raise ValueError(f"{file}: {len(rows)} rows, 4 are needed")
    return np.array(rows)


def pose_from_quaternion(row: NDArray[np.float64], source: str) -> RigidTransform:
    """Returns the pose of a row tx ty tz qx qy qz qw.

    Raises:
        ValueError: if it is no pose; the message starts with `source`.
    """
    _require_finite(row, source)
    _require_position(row[:3], source)
    norm = np.linalg.norm(row[3:])
    if not abs(norm - 1) < 1e-3:
        raise ValueError(
            f"{source}: the quaternion has the length {norm:.6g}, 1 within 0.001 is needed; the "
            "order should be tx ty tz qx qy qz qw"
        )
    x, y, z, w = row[3:]
    return RigidTransform(Quaternion(np.array([w, x, y, z]) / norm), row[:3])


def pose_from_matrix(matrix: NDArray[np.float64], source: str) -> RigidTransform:
    """Returns the pose of a matrix (4, 4), or (3, 4) without its last row, whose rotation may be
    off by rounding.

    Raises:
        ValueError: if it is not a pose; the message starts with `source`.
    """
    _require_finite(matrix, source)
    if not np.allclose(matrix[3:], _LAST_ROW, atol=1e-6):
        columns = np.allclose(matrix[:, 3], _LAST_ROW, atol=1e-6)
        why = "the matrix is stored column by column; transpose it" if columns else "copy it again"
        raise ValueError(
            f"{source}: the last row of a pose must be 0 0 0 1, got {matrix[3].tolist()}: {why}"
        )
    R, p = matrix[:3, :3], matrix[:3, 3]
    _require_position(p, source)
    error = np.abs(R @ R.T - np.eye(3)).max()
    if error > 0.01 or np.linalg.det(R) < 0:
        raise ValueError(
            f"{source}: no rotation (R R^T is off by {error:.2g}, the determinant is "
            f"{np.linalg.det(R):.3g}); a rigid transform is needed"
        )
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)


def _require_finite(pose: NDArray[np.float64], source: str) -> None:
    if not np.isfinite(pose).all():
        raise ValueError(f"{source}: the pose is not finite (tracking was lost?)")


def _require_position(p: NDArray[np.float64], source: str) -> None:
    if np.abs(p).max() > _LARGEST:
        raise ValueError(f"{source}: the position {p} is more than {_LARGEST:g} m away")


def stray_frames(positions: NDArray[np.float64]) -> NDArray[np.intp]:
    """Returns the numbers of positions (N, 3) so far from the others that they must be mistakes.

    Those are farther from the median position than 20 times what four in five are, and than 10 m.
    """
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    return np.flatnonzero(distance > max(10.0, 20 * np.quantile(distance, 0.8)))
