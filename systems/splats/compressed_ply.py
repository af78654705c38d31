"""Gaussians in PlayCanvas's compressed PLY, which SuperSplat writes.

Vertices are four words of 32 bits; each 256 of them share a row of the element `chunk`, between
whose bounds they are interpolated: positions and logarithms of scales in 11, 10 and 11 bits,
colours and opacity in 8 each (colours between the chunk's bounds too, if it has any), rotations as
the three components that are not the largest, in 10 bits each, and 2 that say which that is.
Harmonics, if any, are bytes in an element of their own.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData

from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.splats.sound_gaussians import sound_gaussians
from splatpilot.systems.splats.spherical_harmonics import C0

_CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def is_compressed(ply: PlyData) -> bool:
    """Whether the vertices of a PLY are packed."""
    return "vertex" in ply and _PACKED[0] in {p.name for p in ply["vertex"].properties}


def unpack(path: Path, ply: PlyData, recenter: bool) -> GaussianScene:
    """The Gaussians of a compressed PLY.

    Args:
        path: the file, for messages.
        ply: its elements.
        recenter: see `sound_gaussians`.

    Raises:
        ValueError: if a property is missing or of another kind, rows are missing, or the Gaussians
            are damaged (see `sound_gaussians`).
    """
    vertex, count = ply["vertex"], ply["vertex"].count
    position, rotation, scale, color = (_column(path, vertex, name, "u4") for name in _PACKED)
    chunks = -(-count // _CHUNK)
    if "chunk" not in ply or ply["chunk"].count < chunks:
        raise ValueError(f"{path}: {count} packed Gaussians need {chunks} chunks; export it again")
    chunk, of_chunk = ply["chunk"], np.arange(count) // _CHUNK

    def between(part: str, axes: str, weights: NDArray) -> NDArray:
        lower, upper = (
            np.stack([_column(path, chunk, f"{end}{part}_{a}", "f4")[of_chunk] for a in axes], 1)
            for end in ("min", "max")
        )
        return lower + (upper - lower) * weights

    colors = np.stack([_bits(color, shift, 8) for shift in (24, 16, 8)], axis=1)
    if "min_r" in {p.name for p in chunk.properties}:
        colors = between("", "rgb", colors)
    sh = ((colors - 0.5) / C0)[:, None, :]
    if "sh" in ply:
        sh = np.concatenate([sh, _harmonics(path, ply["sh"], count)], axis=1)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is damaged
        return sound_gaussians(
            path,
            means=between("", "xyz", _three(position)),
            quats=_quaternions(rotation),
            scales=np.exp(between("_scale", "xyz", _three(scale))),
            opacities=np.maximum(_bits(color, 0, 8), 1e-6),
            sh=sh,
            recenter=recenter,
        )


def _column(path: Path, element, name: str, kind: str) -> NDArray:
    """A property, which must have that kind."""
    if name not in {p.name for p in element.properties}:
        raise ValueError(f"{path}: element {element.name} lacks {name}; export the scene again")
    column = np.asarray(element[name])
    if column.dtype.newbyteorder("=") != np.dtype(kind):
        raise ValueError(f"{path}: {name} is {column.dtype}, not {kind}; export the scene again")
    return column.astype(kind if kind == "u4" else float)


def _bits(words: NDArray, shift: int, count: int) -> NDArray[np.float64]:
    """`count` bits above the lowest `shift` ones, as parts of their largest value."""
    most = (1 << count) - 1
    return ((words >> np.uint32(shift)) & np.uint32(most)) / most


def _three(words: NDArray) -> NDArray[np.float64]:
    return np.stack([_bits(words, 21, 11), _bits(words, 11, 10), _bits(words, 0, 11)], axis=1)


def _quaternions(words: NDArray) -> NDArray[np.float64]:
    """wxyz (N, 4)."""
    small = np.stack([_bits(words, shift, 10) for shift in (20, 10, 0)], axis=1)
    small = (small - 0.5) * np.sqrt(2)
    largest = np.sqrt(np.maximum(1 - (small**2).sum(axis=1), 0))
    which = (words >> np.uint32(30)).astype(int)
    quats = np.empty((len(words), 4))
    others = np.array([[i for i in range(4) if i != k] for k in range(4)])[which]
    np.put_along_axis(quats, others, small, axis=1)
    np.put_along_axis(quats, which[:, None], largest[:, None], axis=1)
    return quats


def _harmonics(path: Path, element, count: int) -> NDArray[np.float64]:
    """Coefficients above degree 0 (N, K - 1, 3); bytes are the middles of 256 steps, -4 to 4."""
    number = len(element.properties)
    if number not in (9, 24, 45) or element.count != count:
        raise ValueError(
            f"{path}: {element.count} rows of {number} harmonics for {count} Gaussians; a row of "
            "9, 24 or 45 for each is needed: export the scene again"
        )
    columns = [_column(path, element, f"f_rest_{i}", "u1") for i in range(number)]
    raw = np.stack(columns, axis=1)
    values = np.where(raw == 0, 0.0, np.where(raw == 255, 1.0, (raw + 0.5) / 256))
    return ((values - 0.5) * 8).reshape(count, 3, -1).transpose(0, 2, 1)
