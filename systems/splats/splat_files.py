"""Files of Gaussians, told apart by what they begin with: PLY as it is, compressed or of surfels,
SPZ, and `.splat`; whatever else is taken for one is named."""

import logging
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.common import readers as git_lfs
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import read_ply_file, require_readable_size
from splatpilot.systems.splats.scene import C0, GaussianScene, choose_origin

_log = logging.getLogger(__name__)

MAX_DAMAGED = 0.2
"""The largest part of a file's Gaussians that is left out without refusing the file."""


def sound_gaussians(
    path: Path,
    means: NDArray,
    quats: NDArray,
    scales: NDArray,
    opacities: NDArray,
    sh: NDArray,
    recenter: bool = True,
) -> GaussianScene:
    """The Gaussians of a file without those that are damaged, whose number is logged, and so is the
    new origin of those that are far from 0, see `choose_origin`.

    Args:
        path: the file, for messages.
        means, quats, scales, opacities, sh: as in `GaussianScene`, not yet checked.
        recenter: whether the origin may move.

    Raises:
        ValueError: if there are none, or more than `MAX_DAMAGED` of them are damaged.
    """
    if len(means) == 0:
        raise ValueError(f"{path}: holds no Gaussians; export the scene again")
    origin = (0.0, 0.0, 0.0)
    if recenter and len(known := means[np.isfinite(means).all(axis=1)]):
        x, y, z = choose_origin(np.asarray(known, dtype=np.float64)).tolist()
        if origin != (x, y, z):
            origin, means = (x, y, z), means - np.array([x, y, z])
            where = ", ".join(f"{each:.10g}" for each in origin)
            _log.warning(
                "%s: positions are relative to %s, about which its Gaussians are", path, where
            )
    with np.errstate(over="ignore", invalid="ignore"):
        arrays = [np.asarray(a, np.float32) for a in (means, quats, scales, opacities, sh)]
        finite = [np.isfinite(a.reshape(len(a), -1)).all(axis=1) for a in arrays]
        turns = np.linalg.norm(arrays[1].astype(float), axis=1) > 1e-6
        visible = (arrays[3] > 0) & (arrays[3] <= 1)
    sound = np.logical_and.reduce([*finite, turns, (arrays[2] > 0).all(axis=1), visible])
    damaged = int((~sound).sum())
    if damaged > MAX_DAMAGED * len(sound):
        try:
            return GaussianScene(*arrays)  # which says of the first what is wrong
        except ValueError as error:
            raise ValueError(
                f"{path}: {damaged} of {len(sound)} Gaussians are damaged; {error}"
            ) from None
    if damaged:
        _log.warning("%s: %d of %d Gaussians are damaged and left out", path, damaged, len(sound))
        arrays = [a[sound] for a in arrays]
    return GaussianScene(*arrays, origin=origin)


# Gaussians in PlayCanvas's compressed PLY, which SuperSplat writes.
#
# Vertices are four words of 32 bits; each 256 of them share a row of the element `chunk`, between
# whose bounds they are interpolated: positions and logarithms of scales in 11, 10 and 11 bits,
# colours and opacity in 8 each (colours between the chunk's bounds too, if it has any), rotations
# as the three components that are not the largest, in 10 bits each, and 2 that say which that is.
# Harmonics, if any, are bytes in an element of their own.


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
            quats=_unpack_compressed_quaternions(rotation),
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


def _unpack_compressed_quaternions(words: NDArray) -> NDArray[np.float64]:
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


# Reading and writing Gaussians in the PLY layout of the original 3D Gaussian splatting code.
#
# One element `vertex` with the float properties x y z (nx ny nz, unused and optional) f_dc_0..2
# f_rest_0..3(K-1)-1 (channel-major: all of red, then green, then blue) opacity (logit) scale_0..2
# (natural logarithm) rot_0..3 (wxyz). Most tools that make or show Gaussian splats speak it.


_NORMALS = ["nx", "ny", "nz"]
_MEANS = ["x", "y", "z"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_OPACITY = ["opacity"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]

# The largest float32 below 1 is 1 - 2^-24. An opacity of exactly 1 has no finite logit; it is
# written as that of 1 - 2^-26, which comes back as 1.
_OPAQUE = 1 - 2.0**-26
# Of surfels, beside the smaller of their extents.
_THICKNESS = 0.01
# Below this logit the opacity is no longer a normal float32; it is invisible anyway.
_INVISIBLE_LOGIT = -87.0


def read_ply(path: str | Path, recenter: bool = False) -> GaussianScene:
    """Reads the Gaussians in a PLY file: binary of either byte order, or ASCII.

    With `recenter` those that are far from 0 get an origin near them, see `sound_gaussians`.

    Surfels, whose files have two scales (2DGS), get a third of `_THICKNESS` times the smaller one;
    what PlayCanvas has compressed is unpacked. A few damaged Gaussians are left out, see
    `sound_gaussians`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is no PLY, is truncated, holds no Gaussians (a mesh or a plain point
            cloud), has a number of spherical-harmonic coefficients that belongs to no degree, or
            holds values that are no Gaussians.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; a PLY file with Gaussians is needed")
    ply = read_ply_file(path)
    if "vertex" not in ply:
        raise ValueError(f"{path}: no element 'vertex'; a PLY file with Gaussians is needed")
    if is_compressed(ply):
        return unpack(path, ply, recenter)
    vertex = ply["vertex"]
    names = {p.name for p in vertex.properties}
    if missing := [n for n in (*_MEANS, *_DC, *_OPACITY, *_SCALES[:2], *_QUATS) if n not in names]:
        what = "a mesh" if "face" in ply else "a point cloud"
        raise ValueError(
            f"{path}: {what}, no Gaussians: the vertices lack {', '.join(missing)}; export the "
            "scene in the layout of 3D Gaussian splatting"
        )
    if vertex.count == 0:
        raise ValueError(f"{path}: holds no Gaussians; export the scene again")
    rest = [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in names))]
    if len(rest) not in (0, 9, 24, 45) or not names.issuperset(rest):
        raise ValueError(
            f"{path}: {len(rest)} properties f_rest_*: 0, 9, 24 or 45, numbered from 0, are needed "
            "(spherical harmonics of degree 0 to 3)"
        )

    def columns(properties: list[str]) -> np.ndarray:
        try:
            return np.stack([np.asarray(vertex[name], dtype=np.float64) for name in properties], 1)
        except (ValueError, TypeError):
            raise ValueError(
                f"{path}: {', '.join(properties)} are not all plain numbers; export the scene in "
                "the layout of 3D Gaussian splatting"
            ) from None

    sh = columns(_DC)[:, None, :]
    if rest:
        # (N, 3 (K - 1)) channel-major -> (N, K - 1, 3)
        higher = columns(rest).reshape(vertex.count, 3, -1).transpose(0, 2, 1)
        sh = np.concatenate([sh, higher], axis=1)
    logits = np.maximum(columns(_OPACITY)[:, 0], _INVISIBLE_LOGIT)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is damaged
        scales = np.exp(columns([name for name in _SCALES if name in names]))
        if scales.shape[1] == 2:
            scales = np.column_stack([scales, _THICKNESS * scales.min(axis=1)])
        return sound_gaussians(
            path,
            means=columns(_MEANS),
            quats=columns(_QUATS),
            scales=scales,
            opacities=1 / (1 + np.exp(-logits)),
            sh=sh,
            recenter=recenter,
        )


def write_ply(scene: GaussianScene, path: str | Path) -> None:
    """Writes `scene` as binary little-endian PLY, atomically: a failure leaves no half file.

    Opacities of exactly 1, whose logit is infinite, are written as the logit of 1 - 2^-26, which
    reads back as 1.

    Raises:
        OSError: if the file cannot be written; the message names it.
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


# Gaussians in Niantic's SPZ, versions 2 to 4: fixed-point numbers, compressed.
#
# A header has the letters NGSP, version and count, then degree of the harmonics, fractional bits of
# positions, flags and a byte of other use. Six sections have of all Gaussians in turn: positions in
# 3 x 24 bits; opacities, colours and logarithms of scales in bytes; rotations (the imaginary part
# in three bytes, from version 3 on the three components that are not the largest in 10 bits each,
# and 2 that say which that is); harmonics in bytes. Versions 2 and 3 are one stream of gzip. From
# version 4 on the header is not compressed; it goes on with the place of a table of the compressed
# and whole sizes of sections, each a stream of zstd, those without bytes left out. Axes are x
# right, y up and z back, where a PLY of the same place has x right, y down and z forward; the
# latter are returned.


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
        quats=_unpack_spz_quaternions(rotation)
        if header.version == 2
        else _packed_quaternions(rotation),
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


def _unpack_spz_quaternions(rotation: NDArray[np.uint8]) -> NDArray[np.float64]:
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


_GZIP = b"\x1f\x8b"
_CONVERT = "convert it to PLY, for example with PlayCanvas's splat-transform"
# What files begin with, or end their name with, that are taken for Gaussians and are none we read.
_OTHERS = {
    git_lfs.POINTER: git_lfs.REFUSAL,
    b"glTF": f"a binary glTF; {_CONVERT}, or render a mesh with `splatpilot capture render`",
    b"PK": f"an archive; if it is SOG, {_CONVERT}",
    b"<": "a page or an XML file; a link that was saved in place of the file, perhaps",
}
_BY_NAME = {".ksplat": f"a KSPLAT; {_CONVERT}", ".sog": f"a SOG; {_CONVERT}"}
# Positions and scales [m], colour and opacity, rotation (wxyz), as antimatter15's viewer has them.
_RECORD = np.dtype([("p", "<f4", 3), ("s", "<f4", 3), ("rgba", "u1", 4), ("q", "u1", 4)])


def read_splats(path: str | Path) -> GaussianScene:
    """Reads the Gaussians in a file.

    PLY: see `read_ply`; SPZ: see `read_spz`. A `.splat` is 32 bytes a Gaussian, with neither header
    nor harmonics. A few damaged Gaussians are left out, see `sound_gaussians`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is none of these, empty, damaged or too large; the message names what it
            is, where that is known.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; a file of Gaussians is needed")
    with path.open("rb") as file:
        start = file.read(32)
    if not start:
        raise ValueError(f"{path}: the file is empty; copy it again")
    if start.startswith(b"ply"):
        return read_ply(path, recenter=True)
    if start.startswith((_GZIP, MAGIC)):
        return read_spz(path)
    suffix = path.suffix.lower()
    for what in [_BY_NAME.get(suffix), *(_OTHERS[k] for k in _OTHERS if start.startswith(k))]:
        if what is not None:
            raise ValueError(f"{path}: {what}")
    if suffix == ".splat":
        return _read_records(path)
    raise ValueError(
        f"{path}: neither PLY, SPZ nor .splat; a file of Gaussians is needed: {_CONVERT}"
    )


def _read_records(path: Path) -> GaussianScene:
    size = path.stat().st_size
    if size % _RECORD.itemsize:
        raise ValueError(
            f"{path}: {size} bytes are no multiple of the {_RECORD.itemsize} that a Gaussian has; "
            "it is cut short, copy it again"
        )
    require_readable_size(path, 3 * size)
    records = np.fromfile(path, _RECORD)
    color = records["rgba"] / 255
    return sound_gaussians(
        path,
        means=records["p"],
        quats=(records["q"].astype(float) - 128) / 128,
        scales=records["s"],
        opacities=np.maximum(color[:, 3], 1e-6),
        sh=((color[:, :3] - 0.5) / C0)[:, None, :],
    )
