"""A file of Gaussians in metres and with z up, as flights need it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.files import require_writable_folder
from splatpilot.systems.splats.gaussian_ply import write_ply
from splatpilot.systems.splats.splat_files import read_splats

# Rows are W's axes in the file's, by which of those is up; x stays where it can.
_R_WF = {
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "x": [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
    "-x": [[0, -1, 0], [0, 0, 1], [-1, 0, 0]],
}
UP_AXES = tuple(_R_WF)
"""Which way can be up in a file."""

_FLATTEST = 0.05  # of a triangle on the floor, twice its area over its longest side squared
_STEEPEST = 0.5  # cosine between a floor's normal and the axis that points up


@dataclass(frozen=True)
class FileSummary:
    """What was written."""

    file: Path
    gaussians: int
    factor: float
    size: NDArray[np.float64]  # (3,) [m], of the box of nearly all Gaussians
    origin: tuple[float, float, float]  # [m], of the written file in the other, scaled and turned

    def __str__(self) -> str:
        rows = {
            "file": self.file,
            "Gaussians": self.gaussians,
            "factor": f"{self.factor:.6g}",
            "size": " x ".join(f"{length:.3g}" for length in self.size) + " m",
        }
        if any(self.origin):
            rows["relative to [m]"] = ", ".join(f"{x:.10g}" for x in self.origin)
        return "\n".join(f"{name:<18} {value}" for name, value in rows.items())


def rescale_file(
    file: Path,
    out: Path,
    factor: float = 1.0,
    up: str = "z",
    floor: Sequence[ArrayLike] = (),
) -> FileSummary:
    """Writes the Gaussians of a file as PLY, all lengths times `factor`, turned so that z is up.

    Args:
        file: see `read_splats`.
        out: the PLY.
        factor: what one of the file's units is [m].
        up: which of the file's axes points up, one of `UP_AXES`; the PLYs of 3D Gaussian splatting
            mostly have -y there.
        floor: three points (3,) of the file's floor, or of another level surface: it becomes level,
            at z = 0, and `up` tells only its upper side.

    Raises:
        FileNotFoundError, ValueError: for a file that is damaged or none of Gaussians, three points
            that are no floor, or `out` that is no name of a PLY or exists.
        OSError: if it cannot be written.
    """
    if out.suffix.lower() != ".ply":
        raise ValueError(f"{out}: Gaussians are written as PLY; name it so, {out.stem}.ply")
    if out.exists():
        raise ValueError(f"{out}: exists already; choose another name for the scaled file")
    require_writable_folder(out.absolute().parent)
    X_WF = _upright(up, floor)
    gaussians = read_splats(file).transformed_by(X_WF).scaled_by(factor)
    write_ply(gaussians, out)
    lower_W, upper_W = np.percentile(gaussians.means.astype(float), [1, 99], axis=0)
    return FileSummary(out, len(gaussians), factor, upper_W - lower_W, gaussians.origin)


def _upright(up: str, floor: Sequence[ArrayLike]) -> RigidTransform:
    """X_WF, from the axis that points up and perhaps three points of the floor."""
    R_WF = np.array(_R_WF[up], dtype=float)
    if not len(floor):
        return RigidTransform(RotationMatrix(R_WF))
    a, b, c = (np.asarray(point, dtype=float) for point in floor)
    normal = np.cross(b - a, c - a)
    area, longest = np.linalg.norm(normal), max(np.linalg.norm(b - a), np.linalg.norm(c - a))
    if not area > _FLATTEST * longest**2:
        raise ValueError(
            f"the points {a.tolist()}, {b.tolist()} and {c.tolist()} lie in a line, or are one; "
            "give three corners of a floor"
        )
    z_F = normal / area
    steep = float(z_F @ R_WF[2])
    if abs(steep) < _STEEPEST:
        raise ValueError(
            f"the plane of these points stands at {np.rad2deg(np.arccos(abs(steep))):.0f} degrees "
            f"to a floor that has {up} up; say which axis points up, or choose other points"
        )
    z_F *= np.sign(steep)
    x_F = R_WF[0] - (R_WF[0] @ z_F) * z_F
    x_F /= np.linalg.norm(x_F)
    R = RotationMatrix(np.stack([x_F, np.cross(z_F, x_F), z_F]))
    return RigidTransform(R, np.array([0.0, 0.0, -(z_F @ a)]))
