"""Files of Gaussians: PLY (plain, compressed or of surfels), SPZ and `.splat`."""

import logging
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import (
    LFS_ERROR,
    LFS_POINTER,
    read_ply_file,
    readable,
    require_file,
    require_readable_size,
)
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.scene import GaussianScene, choose_origin, color_to_sh

_log = logging.getLogger(__name__)

_MAX_INVALID = 0.2  # fraction of invalid Gaussians that are dropped instead of refusing the file
_MIN_OPACITY = 1e-6  # of an opacity that a format rounds to 0
_EXPORT = "export the scene in the layout of 3D Gaussian splatting"

type Arrays = dict[str, NDArray[Any]]  # of `GaussianScene`, in its order, not checked yet


def _drop_invalid(path: Path, arrays: Arrays, recenter: bool = True) -> GaussianScene:
    """Makes a scene of the valid Gaussians of a file; logs dropped ones and a new origin."""
    means = arrays["means"]
    require(len(means) > 0, f"{path}: the number of Gaussians", ">= 1", 0, "export the scene again")
    origin = (0.0, 0.0, 0.0)
    if recenter and len(finite := means[np.isfinite(means).all(axis=1)]):
        x, y, z = choose_origin(np.asarray(finite, dtype=np.float64)).tolist()
        if origin != (x, y, z):
            origin, arrays = (x, y, z), arrays | {"means": means - np.array([x, y, z])}
            listed = ", ".join(f"{each:.10g}" for each in origin)
            _log.warning("%s: positions are relative to %s, close to the Gaussians", path, listed)
    with np.errstate(over="ignore", invalid="ignore"):
        arrays = {name: np.asarray(array, np.float32) for name, array in arrays.items()}
        rotates = np.linalg.norm(arrays["quats"].astype(float), axis=1) > 1e-6
    visible = (arrays["opacities"] > 0) & (arrays["opacities"] <= 1)
    valid = rotates & visible & (arrays["scales"] > 0).all(axis=1)
    for array in arrays.values():
        valid &= np.isfinite(array.reshape(len(array), -1)).all(axis=1)
    count = int((~valid).sum())
    if count > _MAX_INVALID * len(valid):
        try:
            return GaussianScene(*arrays.values())  # names the first invalid one
        except ValueError as error:
            invalid = f"{count} of {len(valid)} Gaussians are invalid"
            raise ValueError(f"{path}: {invalid}; {error}") from None
    if count:
        _log.warning("%s: %d of %d Gaussians are invalid and dropped", path, count, len(valid))
        arrays = {name: array[valid] for name, array in arrays.items()}
    return GaussianScene(*arrays.values(), origin=origin)


def _insert_largest(small: NDArray, index: NDArray) -> NDArray[np.float64]:
    """Inserts the largest component, of this index and >= 0, into unit quaternions (N, 4)."""
    quats = np.empty((len(small), 4))
    others = np.array([[i for i in range(4) if i != k] for k in range(4)])[index]
    np.put_along_axis(quats, others, small, axis=1)
    largest = np.sqrt(np.maximum(1 - (small**2).sum(axis=1, keepdims=True), 0))
    np.put_along_axis(quats, index[:, None], largest, axis=1)
    return quats


# PlayCanvas's compressed PLY: vertices are four words of 32 bits. Each 256 share a row of the
# element `chunk`, between whose bounds they are interpolated: positions and logarithms of scales in
# 11, 10 and 11 bits, colors and opacity in 8 each (colors only if it has such bounds), rotations as
# the three smaller components in 10 bits each and 2 bits for the index of the largest. Harmonics
# are bytes in an element of their own.

_CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def _names(element: PlyElement) -> set[str]:
    return {p.name for p in element.properties}


def _column(element: PlyElement, name: str, kind: str) -> NDArray:
    column = np.asarray(element[name])
    valid = column.dtype.newbyteorder("=") == np.dtype(kind)
    require(valid, f"{element.name}.{name}", f"of type {kind}", column.dtype)
    return column.astype(kind if kind == "u4" else float)


def _bits(words: NDArray, shift: int, count: int) -> NDArray[np.float64]:
    """Returns `count` bits above the lowest `shift` ones, as fractions of their largest value."""
    largest = (1 << count) - 1
    return ((words >> np.uint32(shift)) & np.uint32(largest)) / largest


def _fields(words: NDArray, *fields: tuple[int, int]) -> NDArray[np.float64]:
    return np.stack([_bits(words, *field) for field in fields], axis=1)


def _unpack_ply(ply: PlyData) -> Arrays:
    vertex, chunk, count = ply["vertex"], ply["chunk"], ply["vertex"].count
    position, rotation, scale, color = (_column(vertex, name, "u4") for name in _PACKED)
    row, three = np.arange(count) // _CHUNK, ((21, 11), (11, 10), (0, 11))

    def between(part: str, axes: str, weights: NDArray) -> NDArray:
        lower, upper = (
            np.stack([_column(chunk, f"{end}{part}_{a}", "f4")[row] for a in axes], 1)
            for end in ("min", "max")
        )
        return lower + (upper - lower) * weights

    colors = _fields(color, (24, 8), (16, 8), (8, 8))
    if "min_r" in _names(chunk):
        colors = between("", "rgb", colors)
    sh = color_to_sh(colors)[:, None, :]
    if "sh" in ply:
        sh = np.concatenate([sh, _unpack_harmonics(ply["sh"], count)], axis=1)
    small = (_fields(rotation, (20, 10), (10, 10), (0, 10)) - 0.5) * np.sqrt(2)
    return {
        "means": between("", "xyz", _fields(position, *three)),
        "quats": _insert_largest(small, (rotation >> 30).astype(int)),
        "scales": np.exp(between("_scale", "xyz", _fields(scale, *three))),
        "opacities": np.maximum(_bits(color, 0, 8), _MIN_OPACITY),
        "sh": sh,
    }


def _unpack_harmonics(element: PlyElement, count: int) -> NDArray[np.float64]:
    """Returns coefficients above degree 0 (N, K - 1, 3) from the middles of 256 steps, -4 to 4."""
    number = len(element.properties)
    valid, got = number in (9, 24, 45) and element.count == count, f"{element.count} x {number}"
    require(valid, "the table of harmonics", f"{count} x 9, 24 or 45", got)
    raw = np.stack([_column(element, f"f_rest_{i}", "u1") for i in range(number)], axis=1)
    values = np.where(raw == 0, 0.0, np.where(raw == 255, 1.0, (raw + 0.5) / 256))
    return ((values - 0.5) * 8).reshape(count, 3, -1).transpose(0, 2, 1)


# The PLY layout of the original 3D Gaussian splatting code: f_rest is channel-major, opacity a
# logit, scales are natural logarithms and rotations wxyz.

_NORMALS = ["nx", "ny", "nz"]
_MEANS = ["x", "y", "z"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_OPACITY = ["opacity"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]

# The largest float32 below 1 is 1 - 2^-24. An opacity of exactly 1 has no finite logit; it is
# written as that of 1 - 2^-26, which is read as 1.
_OPAQUE = 1 - 2.0**-26
_THICKNESS = 0.01  # of surfels, relative to the smaller of their scales
_INVISIBLE_LOGIT = -87.0  # below, the opacity is not a normal float32


def read_ply(path: str | Path, recenter: bool = False) -> GaussianScene:
    """Reads the Gaussians of a PLY file: binary of either byte order, ASCII, or compressed.

    Surfels, whose files have two scales (2DGS), get a third of `_THICKNESS` times the smaller one.

    Raises FileNotFoundError, or ValueError for a file that is damaged or without Gaussians.
    """
    path = Path(path)
    ply = read_ply_file(path)
    if "vertex" not in ply:
        raise ValueError(f"{path}: no element 'vertex'; {_EXPORT}")
    names, unpack = _names(ply["vertex"]), _unpack_ply
    if _PACKED[0] not in names:
        unpack, required = _unpack_plain, (*_MEANS, *_DC, *_OPACITY, *_SCALES[:2], *_QUATS)
        if missing := ", ".join(name for name in required if name not in names):
            what = "mesh" if "face" in ply else "point cloud"
            raise ValueError(f"{path}: {what} without Gaussians, missing {missing}; {_EXPORT}")
    # Numbers that overflow are invalid.
    with np.errstate(over="ignore", invalid="ignore"), readable(path, "PLY file of Gaussians"):
        arrays = unpack(ply)
    return _drop_invalid(path, arrays, recenter)


def _unpack_plain(ply: PlyData) -> Arrays:
    vertex, names = ply["vertex"], _names(ply["vertex"])
    rest = [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in names))]
    numbered = len(rest) in (0, 9, 24, 45) and names.issuperset(rest)
    require(numbered, "properties f_rest_*", "0, 9, 24 or 45, from 0", len(rest))

    def columns(properties: list[str]) -> np.ndarray:
        return np.stack([np.asarray(vertex[name], dtype=np.float64) for name in properties], 1)

    sh = columns(_DC)[:, None, :]
    if rest and vertex.count:
        # (N, 3 (K - 1)) channel-major -> (N, K - 1, 3)
        higher = columns(rest).reshape(vertex.count, 3, -1).transpose(0, 2, 1)
        sh = np.concatenate([sh, higher], axis=1)
    scales = np.exp(columns([name for name in _SCALES if name in names]))
    if scales.shape[1] == 2:
        scales = np.column_stack([scales, _THICKNESS * scales.min(axis=1)])
    return {
        "means": columns(_MEANS),
        "quats": columns(_QUATS),
        "scales": scales,
        "opacities": 1 / (1 + np.exp(-np.maximum(columns(_OPACITY)[:, 0], _INVISIBLE_LOGIT))),
        "sh": sh,
    }


def write_ply(scene: GaussianScene, path: str | Path) -> None:
    """Writes a scene atomically as binary little-endian PLY."""
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


# Niantic's SPZ, versions 2 to 4: a header (NGSP, version, count, degree of harmonics, fractional
# bits of positions, flags) and six sections: positions in 3 x 24 bits; opacities, colors and
# logarithms of scales in bytes; rotations (the imaginary part in three bytes, from version 3 on the
# three smaller components in 10 bits each and 2 bits for the index of the largest); harmonics in
# bytes. Versions 2 and 3 are one stream of gzip. The header of version 4 is not compressed; it
# continues with the offset of a table of the compressed and full sizes of the sections, each a
# stream of zstd, without empty ones. Axes are x right, y up and z back.

_GZIP, _MAGIC = b"\x1f\x8b", b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")
_TABLE = struct.Struct("<I12x")  # behind the header, from version 4 on
_STREAM = struct.Struct("<QQ")
_COEFFICIENTS = (0, 3, 8, 15)  # above degree 0, by degree
_X_PS = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])))  # SPZ's axes in a PLY's


def _read_spz(path: Path) -> GaussianScene:
    """Reads an SPZ file in the axes of a PLY; version 4 needs the extra `spz`."""
    require_readable_size(path, path.stat().st_size)
    content = path.read_bytes()
    in_zstd, gzip = content.startswith(_MAGIC), zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    zstandard = import_extra("zstandard", "spz") if in_zstd else None
    with readable(path, "SPZ file"):
        start = content[: _HEADER.size] if in_zstd else gzip.decompress(content, _HEADER.size)
        magic, version, count, degree, bits, _, _ = _HEADER.unpack(start)
        require(magic == _MAGIC, "the content of gzip", "SPZ", magic, "unpack it first")
        known = (4,) if in_zstd else (2, 3)
        require(version in known, "the version", " or ".join(map(str, known)), version)
        require(degree < len(_COEFFICIENTS), "the degree", "in [0, 3]", degree)
        require(bits <= 24, "the number of fractional bits", "in [0, 24]", bits)
    widths = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * _COEFFICIENTS[degree])
    sizes = [count * width for width in widths]
    require_readable_size(path, 8 * sum(sizes))  # as floats
    with readable(path, "SPZ file"):
        if zstandard:
            body = _unpack_zstd(zstandard, content, [size for size in sizes if size])
        else:
            body = gzip.decompress(gzip.unconsumed_tail, sum(sizes)) if count else b""
        require(len(body) == sum(sizes), "the content", f"of {sum(sizes)} bytes", len(body))
    parts = np.split(np.frombuffer(body, np.uint8), np.cumsum(sizes)[:-1])
    position, opacity, color, scale, rotation, rest = (
        part.reshape(count, width) for part, width in zip(parts, widths, strict=True)
    )
    first = ((color / 255 - 0.5) / 0.15)[:, None, :]
    higher = (rest.astype(float).reshape(count, widths[-1] // 3, 3) - 128) / 128
    low, middle, high = np.moveaxis(position.reshape(-1, 3, 3).astype(np.int32), 2, 0)
    fixed = ((low | middle << 8 | high << 16) ^ 0x800000) - 0x800000  # signed numbers of 24 bits
    if version == 2:
        quats = _insert_largest(rotation / 127.5 - 1, np.full(count, 3))
    else:  # words with z lowest, each a sign above 9 bits
        words = np.ascontiguousarray(rotation).view("<u4")[:, 0]
        fields = np.stack([(words >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
        small = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / 511 * np.sqrt(0.5)
        quats = _insert_largest(small, (words >> 30).astype(int))
    arrays = {
        "means": fixed / 2.0**bits,
        "quats": np.roll(quats, 1, axis=1),  # from x y z w
        "scales": np.exp(scale / 16 - 10),
        "opacities": np.maximum(opacity[:, 0] / 255, _MIN_OPACITY),
        "sh": np.concatenate([first, higher], axis=1),
    }
    return _drop_invalid(path, arrays).transformed_by(_X_PS)


def _unpack_zstd(zstandard: Any, content: bytes, sizes: list[int]) -> bytes:
    """Returns the sections, of `sizes` [bytes], of version 4."""
    [table] = _TABLE.unpack_from(content, _HEADER.size)
    begin, sections = table + len(sizes) * _STREAM.size, []
    for i, size in enumerate(sizes):
        compressed, _ = _STREAM.unpack_from(content, table + i * _STREAM.size)
        stream = zstandard.ZstdDecompressor().stream_reader(content[begin : begin + compressed])
        sections.append(stream.read(size))
        begin += compressed
    return b"".join(sections)


_CONVERT = "convert it to PLY, for example with PlayCanvas's splat-transform"
# Starts, or suffixes, of other files that are mistaken for Gaussians.
_OTHERS = {
    LFS_POINTER: LFS_ERROR,
    b"glTF": f"a binary glTF; {_CONVERT}, or render a mesh with `splatpilot capture render`",
    b"PK": f"an archive; if it is SOG, {_CONVERT}",
    b"<": "a web page or an XML file, perhaps of a link saved instead of the file",
}
_BY_SUFFIX = {".ksplat": f"a KSPLAT; {_CONVERT}", ".sog": f"a SOG; {_CONVERT}"}
# Positions and scales [m], color and opacity, rotation (wxyz), as in antimatter15's viewer.
_RECORD = np.dtype([("p", "<f4", 3), ("s", "<f4", 3), ("rgba", "u1", 4), ("q", "u1", 4)])


def read_splats(path: str | Path) -> GaussianScene:
    """Reads the Gaussians of a PLY, SPZ or `.splat` file; for errors see `read_ply`."""
    path = Path(path)
    require_file(path)
    with path.open("rb") as file:
        start = file.read(32)
    require(start, f"{path}: the size", "> 0 bytes", 0, "copy it again")
    if start.startswith(b"ply"):
        return read_ply(path, recenter=True)
    if start.startswith((_GZIP, _MAGIC)):
        return _read_spz(path)
    suffix = path.suffix.lower()
    other = _BY_SUFFIX.get(suffix) or next((_OTHERS[s] for s in _OTHERS if start.startswith(s)), "")
    if other or suffix != ".splat":
        raise ValueError(f"{path}: {other or f'not PLY, SPZ or .splat; {_CONVERT}'}")
    return _read_records(path)


def _read_records(path: Path) -> GaussianScene:
    """Reads a `.splat`: 32 bytes per Gaussian, without header and harmonics."""
    size, width = path.stat().st_size, _RECORD.itemsize
    what, condition = f"{path}: the size", f"a multiple of {width} bytes"
    require(size % width == 0, what, condition, size, "copy it again")
    require_readable_size(path, 3 * size)
    records = np.fromfile(path, _RECORD)
    color = records["rgba"] / 255
    arrays = {
        "means": records["p"],
        "quats": (records["q"].astype(float) - 128) / 128,
        "scales": records["s"],
        "opacities": np.maximum(color[:, 3], _MIN_OPACITY),
        "sh": color_to_sh(color[:, :3])[:, None, :],
    }
    return _drop_invalid(path, arrays)
