"""Gaussians in Niantic's SPZ, versions 2 to 4: fixed-point numbers, compressed.

A header has the letters NGSP, version and count, then degree of the harmonics, fractional bits of
positions, flags and a byte of other use. Six sections have of all Gaussians in turn: positions in
3 x 24 bits; opacities, colours and logarithms of scales in bytes; rotations (the imaginary part in
three bytes, from version 3 on the three components that are not the largest in 10 bits each, and 2
that say which that is); harmonics in bytes. Versions 2 and 3 are one stream of gzip. From version 4
on the header is not compressed; it goes on with the place of a table of the compressed and whole
sizes of sections, each a stream of zstd, those without bytes left out. Axes are x right, y up and
z back, where a PLY of the same place has x right, y down and z forward; the latter are returned.
"""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.extras import import_extra
from splatpilot.systems.read_limit import require_readable_size
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.splats.sound_gaussians import sound_gaussians

MAGIC = b"NGSP"
"""What files begin with from version 4 on; those before begin as gzip does."""

_HEADER = struct.Struct("<4sIIBBBB")
_TABLE = struct.Struct("<I12x")  # behind the header, from version 4 on
_STREAM = struct.Struct("<QQ")
_COEFFICIENTS = (0, 3, 8, 15)  # above degree 0, by degree
_LARGEST_BITS = 24
_X_PS = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])))  # SPZ's axes in a PLY's


@dataclass(frozen=True)
class _Header:
    version: int
    count: int
    bits: int  # fractional, of positions
    widths: tuple[int, ...]  # [bytes] of a Gaussian in each section

    @property
    def sizes(self) -> list[int]:
        """[bytes] of each section."""
        return [self.count * width for width in self.widths]


def read_spz(path: Path) -> GaussianScene:
    """Reads the Gaussians of an SPZ file.

    Returns:
        Them in the axes of a PLY.

    Raises:
        ValueError: if it is damaged, of another version, cut short or too large, or its Gaussians
            are damaged (see `sound_gaussians`).
        ModuleNotFoundError: version 4 needs the extra `spz`.
    """
    require_readable_size(path, path.stat().st_size)
    content = path.read_bytes()
    header, body = (_unpack_zstd if content.startswith(MAGIC) else _unpack_gzip)(path, content)
    count = header.count
    parts = np.split(np.frombuffer(body, np.uint8), np.cumsum(header.sizes)[:-1])
    position, opacity, color, scale, rotation, rest = (
        part.reshape(count, width) for part, width in zip(parts, header.widths, strict=True)
    )
    first = ((color / 255 - 0.5) / 0.15)[:, None, :]
    higher = (rest.astype(float).reshape(count, -1, 3) - 128) / 128
    gaussians = sound_gaussians(
        path,
        means=_fixed_point(position) / 2.0**header.bits,
        quats=_quaternions(rotation) if header.version == 2 else _packed_quaternions(rotation),
        scales=np.exp(scale / 16 - 10),
        opacities=np.maximum(opacity[:, 0] / 255, 1e-6),
        sh=np.concatenate([first, higher], axis=1),
    )
    return gaussians.transformed_by(_X_PS)


def _unpack_gzip(path: Path, content: bytes) -> tuple[_Header, bytes]:
    """The header and the sections of versions 2 and 3."""
    stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    try:
        start = stream.decompress(content, _HEADER.size)
        if not start.startswith(MAGIC):
            raise ValueError(f"{path}: gzip of something that is not SPZ; unpack it first")
        header = _read_header(path, start, (2, 3))
        body = stream.decompress(stream.unconsumed_tail, sum(header.sizes))
    except zlib.error as error:
        raise ValueError(f"{path}: not readable gzip ({error}); copy it again") from None
    return header, _require_whole(path, body, sum(header.sizes))


def _unpack_zstd(path: Path, content: bytes) -> tuple[_Header, bytes]:
    """The header and the sections of version 4."""
    header = _read_header(path, content, (4,))
    zstandard = import_extra("zstandard", "spz")
    sizes, sections = [size for size in header.sizes if size], []
    try:
        [table] = _TABLE.unpack_from(content, _HEADER.size)
        begin = table + len(sizes) * _STREAM.size
        for i, size in enumerate(sizes):
            compressed, _ = _STREAM.unpack_from(content, table + i * _STREAM.size)
            stream = zstandard.ZstdDecompressor().stream_reader(content[begin : begin + compressed])
            sections.append(_require_whole(path, stream.read(size), size))
            begin += compressed
    except (struct.error, zstandard.ZstdError) as error:
        raise ValueError(f"{path}: not readable SPZ ({error}); copy it again") from None
    return header, b"".join(sections)


def _read_header(path: Path, start: bytes, versions: tuple[int, ...]) -> _Header:
    if len(start) < _HEADER.size:
        raise ValueError(f"{path}: the header is cut short; copy it again")
    _, version, count, degree, bits, _, _ = _HEADER.unpack_from(start)
    if version not in versions:
        if version in (2, 3, 4):
            how = "are compressed as one gzip, and this is not" if version < 4 else "are no gzip"
            raise ValueError(
                f"{path}: says that it is SPZ of version {version}, whose files {how}; export it "
                "again"
            )
        raise ValueError(f"{path}: SPZ of version {version}; 2 to 4 are read: convert it to PLY")
    if degree >= len(_COEFFICIENTS) or bits > _LARGEST_BITS or count == 0:
        raise ValueError(
            f"{path}: {count} Gaussians, harmonics of degree {degree}, {bits} fractional bits; at "
            f"least 1, at most {len(_COEFFICIENTS) - 1} and {_LARGEST_BITS} are possible: the file "
            "is damaged, copy it again"
        )
    widths = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * _COEFFICIENTS[degree])
    header = _Header(version, count, bits, widths)
    require_readable_size(path, 8 * sum(header.sizes))  # as floats
    return header


def _require_whole(path: Path, body: bytes, size: int) -> bytes:
    if len(body) != size:
        raise ValueError(f"{path}: {len(body)} bytes stand where {size} belong; copy it again")
    return body


def _fixed_point(position: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Signed numbers of 24 bits, (N, 9) bytes to (N, 3)."""
    low, middle, high = np.moveaxis(position.reshape(-1, 3, 3).astype(np.int32), 2, 0)
    return ((low | middle << 8 | high << 16) ^ 0x800000) - 0x800000


def _quaternions(rotation: NDArray[np.uint8]) -> NDArray[np.float64]:
    """wxyz (N, 4) from bytes of xyz."""
    xyz = rotation / 127.5 - 1
    w = np.sqrt(np.maximum(1 - (xyz**2).sum(axis=1, keepdims=True), 0))
    return np.concatenate([w, xyz], axis=1)


def _packed_quaternions(rotation: NDArray[np.uint8]) -> NDArray[np.float64]:
    """wxyz (N, 4) from words in which z comes lowest, each a sign above 9 bits."""
    words = np.ascontiguousarray(rotation).view("<u4")[:, 0]
    which = (words >> 30).astype(int)  # of x, y, z, w
    fields = np.stack([(words >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    small = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / 511 * np.sqrt(0.5)
    xyzw = np.empty((len(words), 4))
    others = np.array([[i for i in range(4) if i != k] for k in range(4)])[which]
    np.put_along_axis(xyzw, others, small, axis=1)
    largest = np.sqrt(np.maximum(1 - (small**2).sum(axis=1), 0))
    np.put_along_axis(xyzw, which[:, None], largest[:, None], axis=1)
    return xyzw[:, [3, 0, 1, 2]]
