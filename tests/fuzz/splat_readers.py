"""What reads files of Gaussians that other tools write."""

import gzip
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from plyfile import PlyData, PlyElement

from fuzz.readers import Reader, require_finite, see

_COUNT = 20
_WIDTHS = 9, 1, 3, 3, 4, 9  # [bytes] of a Gaussian in the sections of SPZ, of degree 1


def _write_packed(folder: Path) -> None:
    rng = np.random.default_rng(0)
    ends = [f"{end}_{part}{a}" for end in ("min", "max") for part in ("", "scale_") for a in "xyz"]
    chunk = np.array([(0.0, 0, 0, -3, -3, -3, 3, 3, 3, -2, -2, -2)], [(n, "f4") for n in ends])
    names = [f"packed_{what}" for what in ("position", "rotation", "scale", "color")]
    vertex = np.empty(_COUNT, [(name, "u4") for name in names])
    for name in names:
        vertex[name] = rng.integers(0, 2**32, _COUNT, dtype=np.uint32)
    sh = np.empty(_COUNT, [(f"f_rest_{i}", "u1") for i in range(9)])
    for name in sh.dtype.names or ():
        sh[name] = rng.integers(0, 256, _COUNT)
    elements = ("chunk", chunk), ("vertex", vertex), ("sh", sh)
    PlyData([PlyElement.describe(table, name) for name, table in elements]).write(
        str(folder / "scene.ply")
    )


def _spz_sections() -> list[bytes]:
    rng = np.random.default_rng(0)
    sections = [rng.integers(0, 256, _COUNT * width, dtype=np.uint8) for width in _WIDTHS]
    sections[0].reshape(-1, 3)[:, 2] = 0  # positions of 0 to 16 m
    return [section.tobytes() for section in sections]


def _write_spz_gzip(folder: Path) -> None:
    header = struct.pack("<4sII4B", b"NGSP", 3, _COUNT, 1, 12, 0, 0)
    (folder / "scene.spz").write_bytes(gzip.compress(header + b"".join(_spz_sections()), 0))


def _write_spz_zstd(folder: Path) -> None:
    sections = _spz_sections()
    streams = [zstandard.ZstdCompressor().compress(section) for section in sections]
    header = struct.pack("<4sII4BI12x", b"NGSP", 4, _COUNT, 1, 12, 0, len(streams), 32)
    table = b"".join(
        struct.pack("<QQ", len(stream), len(section))
        for stream, section in zip(streams, sections, strict=True)
    )
    (folder / "scene.spz").write_bytes(header + table + b"".join(streams))


def _write_records(folder: Path) -> None:
    rng = np.random.default_rng(0)
    records = np.zeros(_COUNT, [("p", "<f4", 3), ("s", "<f4", 3), ("bytes", "u1", 8)])
    records["p"], records["s"] = rng.uniform(0, 3, (2, _COUNT, 3))
    records["bytes"] = rng.integers(0, 256, (_COUNT, 8))
    records.tofile(folder / "scene.splat")


def _read(name: str) -> Callable[[Path], Any]:
    def read(folder: Path) -> Any:
        from splatpilot.systems.splats.splat_files import read_splats

        return read_splats(folder / name)

    return read


def _use(scene: Any) -> None:
    require_finite(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh)
    see(scene)


SPLAT_READERS = {
    "PLY, compressed": Reader(_write_packed, "*", _read("scene.ply"), _use),
    "SPZ, gzip": Reader(_write_spz_gzip, "*", _read("scene.spz"), _use),
    "SPZ, zstd": Reader(_write_spz_zstd, "*", _read("scene.spz"), _use),
    ".splat": Reader(_write_records, "*", _read("scene.splat"), _use),
}
"""By name."""
