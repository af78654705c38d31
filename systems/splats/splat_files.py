"""Files of Gaussians: PLY (plain, compressed or of surfels), SPZ and `.splat`."""

import logging
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.common import readers
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import read_ply_file, require_readable_size
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.scene import GaussianScene, choose_origin, color_to_sh

_log = logging.getLogger(__name__)

MAX_INVALID = 0.2
"""Largest fraction of invalid Gaussians that are dropped from a file instead of refusing it."""

_MIN_OPACITY = 1e-6  # of an opacity that a format rounds to 0


def drop_invalid(
    path: Path,
    means: NDArray,
    quats: NDArray,
    scales: NDArray,
    opacities: NDArray,
    sh: NDArray,
    recenter: bool = True,
) -> GaussianScene:
    """Makes a scene of the valid Gaussians of a file; logs dropped ones and a new origin.

    Args:
        path: file, for messages.
        means, quats, scales, opacities, sh: as in `GaussianScene`, not checked yet.
        recenter: whether the origin may move, see `choose_origin`.

    Raises:
        ValueError: there are none, or more than `MAX_INVALID` are invalid.
    """
    require(len(means) > 0, f"{path}: the number of Gaussians", ">= 1", 0, "export the scene again")
    origin = (0.0, 0.0, 0.0)
    if recenter and len(known := means[np.isfinite(means).all(axis=1)]):
        x, y, z = choose_origin(np.asarray(known, dtype=np.float64)).tolist()
        if origin != (x, y, z):
            origin, means = (x, y, z), means - np.array([x, y, z])
            listed = ", ".join(f"{each:.10g}" for each in origin)
            _log.warning("%s: positions are relative to %s, close to the Gaussians", path, listed)
    with np.errstate(over="ignore", invalid="ignore"):
        arrays = [np.asarray(a, np.float32) for a in (means, quats, scales, opacities, sh)]
        finite = [np.isfinite(a.reshape(len(a), -1)).all(axis=1) for a in arrays]
        rotates = np.linalg.norm(arrays[1].astype(float), axis=1) > 1e-6
        visible = (arrays[3] > 0) & (arrays[3] <= 1)
    valid = np.logical_and.reduce([*finite, rotates, (arrays[2] > 0).all(axis=1), visible])
    count = int((~valid).sum())
    if count > MAX_INVALID * len(valid):
        try:
            return GaussianScene(*arrays)  # names the first invalid one
        except ValueError as error:
            raise ValueError(
                f"{path}: {count} of {len(valid)} Gaussians are invalid; {error}"
            ) from None
    if count:
        _log.warning("%s: %d of %d Gaussians are invalid and dropped", path, count, len(valid))
        arrays = [a[valid] for a in arrays]
    return GaussianScene(*arrays, origin=origin)


def _insert_largest(small: NDArray, which: NDArray) -> NDArray[np.float64]:
    """Inserts the largest component, of index `which` and >= 0, into unit quaternions (N, 4)."""
    quats = np.empty((len(small), 4))
    others = np.array([[i for i in range(4) if i != k] for k in range(4)])[which]
    np.put_along_axis(quats, others, small, axis=1)
    largest = np.sqrt(np.maximum(1 - (small**2).sum(axis=1, keepdims=True), 0))
    np.put_along_axis(quats, which[:, None], largest, axis=1)
    return quats


# PlayCanvas's compressed PLY, which SuperSplat writes.
#
# Vertices are four words of 32 bits; each 256 of them share a row of the element `chunk`, between
# whose bounds they are interpolated: positions and logarithms of scales in 11, 10 and 11 bits,
# colors and opacity in 8 each (colors between the chunk's bounds too, if it has any), rotations as
# the three components that are not the largest, in 10 bits each, and 2 bits for its index.
# Harmonics, if any, are bytes in an element of their own.

_CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def _names(element: PlyElement) -> set[str]:
    return {p.name for p in element.properties}


def _unpack_ply(path: Path, ply: PlyData, recenter: bool) -> GaussianScene:
    """Returns the Gaussians of a compressed PLY; see `drop_invalid`."""
    vertex, count = ply["vertex"], ply["vertex"].count
    position, rotation, scale, color = (_column(path, vertex, name, "u4") for name in _PACKED)
    chunks, found = -(-count // _CHUNK), ply["chunk"].count if "chunk" in ply else 0
    require(found >= chunks, f"{path}: the number of chunks", f">= {chunks}", found)
    chunk, row = ply["chunk"], np.arange(count) // _CHUNK

    def between(part: str, axes: str, weights: NDArray) -> NDArray:
        lower, upper = (
            np.stack([_column(path, chunk, f"{end}{part}_{a}", "f4")[row] for a in axes], 1)
            for end in ("min", "max")
        )
        return lower + (upper - lower) * weights

    colors = np.stack([_bits(color, shift, 8) for shift in (24, 16, 8)], axis=1)
    if "min_r" in _names(chunk):
        colors = between("", "rgb", colors)
    sh = color_to_sh(colors)[:, None, :]
    if "sh" in ply:
        sh = np.concatenate([sh, _unpack_harmonics(path, ply["sh"], count)], axis=1)
    small = np.stack([_bits(rotation, shift, 10) for shift in (20, 10, 0)], axis=1)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is invalid
        return drop_invalid(
            path,
            means=between("", "xyz", _three(position)),
            quats=_insert_largest((small - 0.5) * np.sqrt(2), (rotation >> 30).astype(int)),
            scales=np.exp(between("_scale", "xyz", _three(scale))),
            opacities=np.maximum(_bits(color, 0, 8), _MIN_OPACITY),
            sh=sh,
            recenter=recenter,
        )


def _column(path: Path, element: PlyElement, name: str, kind: str) -> NDArray:
    remedy = "export the scene again"
    require(name in _names(element), f"{path}: {element.name}.{name}", "there", "none", remedy)
    column = np.asarray(element[name])
    valid = column.dtype.newbyteorder("=") == np.dtype(kind)
    require(valid, f"{path}: {element.name}.{name}", f"of type {kind}", column.dtype, remedy)
    return column.astype(kind if kind == "u4" else float)


def _bits(words: NDArray, shift: int, count: int) -> NDArray[np.float64]:
    """Returns `count` bits above the lowest `shift` ones, as fractions of their largest value."""
    largest = (1 << count) - 1
    return ((words >> np.uint32(shift)) & np.uint32(largest)) / largest


def _three(words: NDArray) -> NDArray[np.float64]:
    return np.stack([_bits(words, 21, 11), _bits(words, 11, 10), _bits(words, 0, 11)], axis=1)


def _unpack_harmonics(path: Path, element: PlyElement, count: int) -> NDArray[np.float64]:
    """Returns coefficients above degree 0 (N, K - 1, 3) from the middles of 256 steps, -4 to 4."""
    number = len(element.properties)
    what, got = f"{path}: the table of harmonics", f"{element.count} x {number}"
    require(number in (9, 24, 45) and element.count == count, what, f"{count} x 9, 24 or 45", got)
    raw = np.stack([_column(path, element, f"f_rest_{i}", "u1") for i in range(number)], axis=1)
    values = np.where(raw == 0, 0.0, np.where(raw == 255, 1.0, (raw + 0.5) / 256))
    return ((values - 0.5) * 8).reshape(count, 3, -1).transpose(0, 2, 1)


# The PLY layout of the original 3D Gaussian splatting code.
#
# One element `vertex` with the float properties x y z (nx ny nz, unused and optional) f_dc_0..2
# f_rest_0..3(K-1)-1 (channel-major: all of red, then green, then blue) opacity (logit) scale_0..2
# (natural logarithm) rot_0..3 (wxyz).

_NORMALS = ["nx", "ny", "nz"]
_MEANS = ["x", "y", "z"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_OPACITY = ["opacity"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]

# The largest float32 below 1 is 1 - 2^-24. An opacity of exactly 1 has no finite logit; it is
# written as that of 1 - 2^-26, which comes back as 1.
_OPAQUE = 1 - 2.0**-26
_THICKNESS = 0.01  # of surfels, relative to the smaller of their scales
_INVISIBLE_LOGIT = -87.0  # below, the opacity is not a normal float32
_EXPORT = "export the scene in the layout of 3D Gaussian splatting"


def read_ply(path: str | Path, recenter: bool = False) -> GaussianScene:
    """Reads the Gaussians of a PLY file: binary of either byte order, ASCII, or compressed.

    Surfels, whose files have two scales (2DGS), get a third of `_THICKNESS` times the smaller one.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a PLY of Gaussians, or damaged; see `drop_invalid`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"No such file: {path}")
    ply = read_ply_file(path)
    if "vertex" not in ply:
        raise ValueError(f"{path}: no element 'vertex'; {_EXPORT}")
    vertex = ply["vertex"]
    names = _names(vertex)
    if _PACKED[0] in names:
        return _unpack_ply(path, ply, recenter)
    if missing := [n for n in (*_MEANS, *_DC, *_OPACITY, *_SCALES[:2], *_QUATS) if n not in names]:
        what = "mesh" if "face" in ply else "point cloud"
        listed = ", ".join(missing)
        raise ValueError(f"{path}: {what} without Gaussians, missing {listed}; {_EXPORT}")
    rest = [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in names))]
    numbered = len(rest) in (0, 9, 24, 45) and names.issuperset(rest)
    require(numbered, f"{path}: properties f_rest_*", "0, 9, 24 or 45, from 0", len(rest))

    def columns(properties: list[str]) -> np.ndarray:
        try:
            return np.stack([np.asarray(vertex[name], dtype=np.float64) for name in properties], 1)
        except (ValueError, TypeError):
            listed = ", ".join(properties)
            raise ValueError(f"{path}: {listed} must be plain numbers; {_EXPORT}") from None

    sh = columns(_DC)[:, None, :]
    if rest and vertex.count:
        # (N, 3 (K - 1)) channel-major -> (N, K - 1, 3)
        higher = columns(rest).reshape(vertex.count, 3, -1).transpose(0, 2, 1)
        sh = np.concatenate([sh, higher], axis=1)
    logits = np.maximum(columns(_OPACITY)[:, 0], _INVISIBLE_LOGIT)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is invalid
        scales = np.exp(columns([name for name in _SCALES if name in names]))
        if scales.shape[1] == 2:
            scales = np.column_stack([scales, _THICKNESS * scales.min(axis=1)])
        return drop_invalid(
            path,
            means=columns(_MEANS),
            quats=columns(_QUATS),
            scales=scales,
            opacities=1 / (1 + np.exp(-logits)),
            sh=sh,
            recenter=recenter,
        )


def write_ply(scene: GaussianScene, path: str | Path) -> None:
    """Writes a scene atomically as binary little-endian PLY.

    Raises:
        OSError: the file cannot be written.
    """
    path = Path(path)
    N = len(scene)
    rest = [f"f_rest_{i}" for i in range(3 * (scene.sh.shape[1] - 1))]
    opacities = np.minimum(scene.opacities.astype(np.float64), _OPAQUE)
    blocks = [
        (_MEANS, scene.means),
        (_NORMALS, np.zeros((N, 3))),
        (_DC, scene.sh[:, 0]),
        (rest, scene.sh[:, 1:].transpose(0, 2, 1).reshape(N, len(rest))),
        (_OPACITY, np.log(opacities / (1 - opacities))[:, None]),
        (_SCALES, np.log(scene.scales.astype(np.float64))),
        (_QUATS, scene.quats),
    ]
    names = [name for block, _ in blocks for name in block]
    table = np.concatenate([values for _, values in blocks], axis=1).astype("<f4", order="C")
    vertex = table.view([(name, "<f4") for name in names])[:, 0]
    with written_atomically(path) as partial:
        PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(partial))


# Niantic's SPZ, versions 2 to 4: fixed-point numbers, compressed.
#
# A header has the letters NGSP, version and count, then degree of the harmonics, fractional bits of
# positions, flags and a byte of other use. Six sections have of all Gaussians in turn: positions in
# 3 x 24 bits; opacities, colors and logarithms of scales in bytes; rotations (the imaginary part in
# three bytes, from version 3 on the three components that are not the largest in 10 bits each, and
# 2 bits for its index); harmonics in bytes. Versions 2 and 3 are one stream of gzip. From version 4
# on the header is not compressed; it continues with the place of a table of the compressed and
# whole sizes of sections, each a stream of zstd, those without bytes left out. Axes are x right,
# y up and z back, where a PLY of the same scene has x right, y down and z forward.

MAGIC = b"NGSP"
"""Start of files from version 4 on, and of the unpacked stream before."""

_HEADER = struct.Struct("<4sIIBBBB")
_TABLE = struct.Struct("<I12x")  # behind the header, from version 4 on
_STREAM = struct.Struct("<QQ")
_COEFFICIENTS = (0, 3, 8, 15)  # above degree 0, by degree
_MAX_BITS = 24
_X_PS = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])))  # SPZ's axes in a PLY's
_COPY = "copy the file again"


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


def _read_spz(path: Path) -> GaussianScene:
    """Reads an SPZ file in the axes of a PLY; version 4 needs the extra `spz`."""
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
    low, middle, high = np.moveaxis(position.reshape(-1, 3, 3).astype(np.int32), 2, 0)
    fixed = ((low | middle << 8 | high << 16) ^ 0x800000) - 0x800000  # signed numbers of 24 bits
    if header.version == 2:
        quats = _insert_largest(rotation / 127.5 - 1, np.full(count, 3))
    else:  # words in which z comes lowest, each a sign above 9 bits
        words = np.ascontiguousarray(rotation).view("<u4")[:, 0]
        fields = np.stack([(words >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
        small = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / 511 * np.sqrt(0.5)
        quats = _insert_largest(small, (words >> 30).astype(int))
    return drop_invalid(
        path,
        means=fixed / 2.0**header.bits,
        quats=np.roll(quats, 1, axis=1),  # from x y z w
        scales=np.exp(scale / 16 - 10),
        opacities=np.maximum(opacity[:, 0] / 255, _MIN_OPACITY),
        sh=np.concatenate([first, higher], axis=1),
    ).transformed_by(_X_PS)


def _unpack_gzip(path: Path, content: bytes) -> tuple[_Header, bytes]:
    """Returns the header and the sections of versions 2 and 3."""
    stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    try:
        start = stream.decompress(content, _HEADER.size)
        if not start.startswith(MAGIC):
            raise ValueError(f"{path}: gzip of something that is not SPZ; unpack it first")
        header = _read_header(path, start, (2, 3))
        body = stream.decompress(stream.unconsumed_tail, sum(header.sizes))
    except zlib.error as error:
        raise ValueError(f"{path}: gzip is not readable ({error}); {_COPY}") from None
    return header, _require_whole(path, body, sum(header.sizes))


def _unpack_zstd(path: Path, content: bytes) -> tuple[_Header, bytes]:
    """Returns the header and the sections of version 4."""
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
        raise ValueError(f"{path}: SPZ is not readable ({error}); {_COPY}") from None
    return header, b"".join(sections)


def _read_header(path: Path, start: bytes, versions: tuple[int, ...]) -> _Header:
    """Reads the header of one of the `versions` that are compressed as this file is."""
    if len(start) < _HEADER.size:
        raise ValueError(f"{path}: the header is truncated; {_COPY}")
    _, version, count, degree, bits, _, _ = _HEADER.unpack_from(start)
    known = " or ".join(map(str, versions))
    require(version in versions, f"{path}: the version of SPZ", f"{known} so compressed", version)
    require(count > 0, f"{path}: the number of Gaussians", ">= 1", count, _COPY)
    highest = len(_COEFFICIENTS) - 1
    require(degree <= highest, f"{path}: the degree", f"in [0, {highest}]", degree, _COPY)
    require(bits <= _MAX_BITS, f"{path}: fractional bits", f"<= {_MAX_BITS}", bits, _COPY)
    widths = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * _COEFFICIENTS[degree])
    header = _Header(version, count, bits, widths)
    require_readable_size(path, 8 * sum(header.sizes))  # as floats
    return header


def _require_whole(path: Path, body: bytes, size: int) -> bytes:
    require(len(body) == size, f"{path}: the section", f"of {size} bytes", len(body), _COPY)
    return body


_GZIP = b"\x1f\x8b"
_CONVERT = "convert it to PLY, for example with PlayCanvas's splat-transform"
# Starts, or suffixes, of other files that are mistaken for Gaussians.
_OTHERS = {
    readers.POINTER: readers.REFUSAL,
    b"glTF": f"a binary glTF; {_CONVERT}, or render a mesh with `splatpilot capture render`",
    b"PK": f"an archive; if it is SOG, {_CONVERT}",
    b"<": "a web page or an XML file, perhaps of a link saved in place of the file",
}
_BY_SUFFIX = {".ksplat": f"a KSPLAT; {_CONVERT}", ".sog": f"a SOG; {_CONVERT}"}
# Positions and scales [m], color and opacity, rotation (wxyz), as in antimatter15's viewer.
_RECORD = np.dtype([("p", "<f4", 3), ("s", "<f4", 3), ("rgba", "u1", 4), ("q", "u1", 4)])


def read_splats(path: str | Path) -> GaussianScene:
    """Reads the Gaussians of a PLY, SPZ or `.splat` file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is another file, empty, damaged or too large; see `drop_invalid`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"No such file: {path}")
    with path.open("rb") as file:
        start = file.read(32)
    if not start:
        raise ValueError(f"{path}: the file is empty; {_COPY}")
    if start.startswith(b"ply"):
        return read_ply(path, recenter=True)
    if start.startswith((_GZIP, MAGIC)):
        return _read_spz(path)
    suffix = path.suffix.lower()
    other = _BY_SUFFIX.get(suffix) or next((_OTHERS[s] for s in _OTHERS if start.startswith(s)), "")
    if other:
        raise ValueError(f"{path}: {other}")
    if suffix == ".splat":
        return _read_records(path)
    raise ValueError(f"{path}: not PLY, SPZ or .splat; {_CONVERT}")


def _read_records(path: Path) -> GaussianScene:
    """Reads a `.splat`: 32 bytes per Gaussian, without header and harmonics."""
    size, width = path.stat().st_size, _RECORD.itemsize
    require(size % width == 0, f"{path}: the size", f"a multiple of {width} bytes", size, _COPY)
    require_readable_size(path, 3 * size)
    records = np.fromfile(path, _RECORD)
    color = records["rgba"] / 255
    return drop_invalid(
        path,
        means=records["p"],
        quats=(records["q"].astype(float) - 128) / 128,
        scales=records["s"],
        opacities=np.maximum(color[:, 3], _MIN_OPACITY),
        sh=color_to_sh(color[:, :3])[:, None, :],
    )
