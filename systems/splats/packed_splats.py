"""Packed files of Gaussians: compressed PLY and SOG of PlayCanvas, SPZ of Niantic."""

import gzip
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData, PlyElement

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.readers import read_text, readable, require_readable_size
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.scene import color_to_sh

type Arrays = dict[str, NDArray[Any]]
"""The arrays of `GaussianScene`, in its order, as a file holds them, not checked yet."""

MIN_OPACITY = 1e-6  # of an opacity that a format rounds to 0


def insert_largest(small: NDArray, index: NDArray) -> NDArray[np.float64]:
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
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def property_names(element: PlyElement) -> set[str]:
    """Returns the names of the properties of an element."""
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


def unpack_ply(ply: PlyData) -> Arrays:
    """Returns the Gaussians of a compressed PLY."""
    vertex, chunk, count = ply["vertex"], ply["chunk"], ply["vertex"].count
    position, rotation, scale, color = (_column(vertex, name, "u4") for name in PACKED)
    row, three = np.arange(count) // _CHUNK, ((21, 11), (11, 10), (0, 11))

    def between(part: str, axes: str, weights: NDArray) -> NDArray:
        lower, upper = (
            np.stack([_column(chunk, f"{end}{part}_{a}", "f4")[row] for a in axes], 1)
            for end in ("min", "max")
        )
        return lower + (upper - lower) * weights

    colors = _fields(color, (24, 8), (16, 8), (8, 8))
    if "min_r" in property_names(chunk):
        colors = between("", "rgb", colors)
    sh = color_to_sh(colors)[:, None, :]
    if "sh" in ply:
        sh = np.concatenate([sh, _unpack_harmonics(ply["sh"], count)], axis=1)
    small = (_fields(rotation, (20, 10), (10, 10), (0, 10)) - 0.5) * np.sqrt(2)
    return {
        "means": between("", "xyz", _fields(position, *three)),
        "quats": insert_largest(small, (rotation >> 30).astype(int)),
        "scales": np.exp(between("_scale", "xyz", _fields(scale, *three))),
        "opacities": np.maximum(_bits(color, 0, 8), MIN_OPACITY),
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


# Niantic's SPZ, versions 2 to 4: a header (NGSP, version, count, degree of harmonics, fractional
# bits of positions, flags) and six sections: positions in 3 x 24 bits; opacities, colors and
# logarithms of scales in bytes; rotations (the imaginary part in three bytes, from version 3 on the
# three smaller components in 10 bits each and 2 bits for the index of the largest); harmonics in
# bytes. Versions 2 and 3 are one stream of gzip. The header of version 4 is not compressed; it
# continues with the offset of a table of the compressed and full sizes of the sections, each a
# stream of zstd, without empty ones. Axes are x right, y up and z back.

GZIP, MAGIC = b"\x1f\x8b", b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")
_TABLE = struct.Struct("<I12x")  # behind the header, from version 4 on
_STREAM = struct.Struct("<QQ")
_COEFFICIENTS = (0, 3, 8, 15)  # above degree 0, by degree
_ANTIALIASED = 1  # of the flags


def unpack_spz(path: Path) -> tuple[Arrays, bool]:
    """Returns the Gaussians of an SPZ file in its axes, and whether they were trained antialiased;
    version 4 needs the extra `spz`."""
    require_readable_size(path, path.stat().st_size)
    content = path.read_bytes()
    in_zstd, stream = content.startswith(MAGIC), zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    zstandard = import_extra("zstandard", "spz") if in_zstd else None
    with readable(path, "SPZ file"):
        start = content[: _HEADER.size] if in_zstd else stream.decompress(content, _HEADER.size)
        magic, version, count, degree, bits, flags, _ = _HEADER.unpack(start)
        require(magic == MAGIC, "the content of gzip", "SPZ", magic, "unpack it first")
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
            body = stream.decompress(stream.unconsumed_tail, sum(sizes)) if count else b""
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
        quats = insert_largest(rotation / 127.5 - 1, np.full(count, 3))
    else:  # words with z lowest, each a sign above 9 bits
        words = np.ascontiguousarray(rotation).view("<u4")[:, 0]
        fields = np.stack([(words >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
        small = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / 511 * np.sqrt(0.5)
        quats = insert_largest(small, (words >> 30).astype(int))
    arrays = {
        "means": fixed / 2.0**bits,
        "quats": np.roll(quats, 1, axis=1),  # from x y z w
        "scales": np.exp(scale / 16 - 10),
        "opacities": np.maximum(opacity[:, 0] / 255, MIN_OPACITY),
        "sh": np.concatenate([first, higher], axis=1),
    }
    return arrays, bool(flags & _ANTIALIASED)


def pack_spz(arrays: Arrays, antialiased: bool) -> bytes:
    """Returns an SPZ file of version 3 of Gaussians in its axes.

    Positions keep 12 fractional bits, or as many as the farthest of them leaves of 24.
    """
    count, higher = len(arrays["means"]), arrays["sh"].shape[1] - 1
    farthest = max(float(np.abs(arrays["means"]).max()), 2.0**-12)
    bits = max(0, min(12, 22 - int(np.floor(np.log2(farthest)))))
    fixed = np.clip(np.round(arrays["means"] * 2.0**bits), -(2**23), 2**23 - 1).astype(np.int32)
    quats = np.roll(arrays["quats"], -1, axis=1)  # to x y z w
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    index = np.abs(quats).argmax(axis=1)
    quats *= np.where(np.take_along_axis(quats, index[:, None], axis=1) < 0, -1, 1)
    small = quats[np.arange(4) != index[:, None]].reshape(count, 3)
    fields = np.round(np.abs(small) * (511 / np.sqrt(0.5))).astype(np.uint32)
    fields = np.minimum(fields, 511) | (small < 0).astype(np.uint32) << 9
    words = index.astype(np.uint32) << 30
    for i, shift in enumerate((20, 10, 0)):
        words |= fields[:, i] << shift

    def steps(values: NDArray) -> bytes:
        return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()

    content = b"".join((
        _HEADER.pack(
            MAGIC, 3, count, _COEFFICIENTS.index(higher), bits, _ANTIALIASED * antialiased, 0
        ),
        np.ascontiguousarray(fixed, "<i4").view(np.uint8).reshape(count, 3, 4)[..., :3].tobytes(),
        steps(255 * arrays["opacities"]),
        steps(255 * (0.15 * arrays["sh"][:, 0] + 0.5)),
        steps(16 * (np.log(arrays["scales"]) + 10)),
        words.astype("<u4").tobytes(),
        steps(128 * arrays["sh"][:, 1:] + 128),
    ))  # fmt: skip
    return gzip.compress(content, mtime=0)


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


# PlayCanvas's SOG: `meta.json` and images whose pixels, row by row, are Gaussians. Positions have
# 16 bits in two images, between bounds of sign(x) ln(1 + |x|); rotations are the three smaller
# components in bytes and, as alpha, 252 plus the index of the largest. Logarithms of scales, colors
# and harmonics are bytes: in version 2 indices of a codebook, in version 1 steps between bounds.
# Alpha of `sh0` is the opacity, in version 1 a step of its logit. Harmonics are those of one of the
# `centroids`, 64 a row, whose number the red and green of `labels` give.

SOG_META = "meta.json"
_PER_ROW = 64


def unpack_sog(path: Path) -> tuple[Arrays, bool]:
    """Returns the Gaussians of a SOG archive, or of the `meta.json` of a folder, and whether they
    were trained antialiased."""
    if path.name == SOG_META:
        return _unpack_images(path, read_text(path), lambda name: (path.parent / name).read_bytes())
    with readable(path, "SOG archive"), zipfile.ZipFile(path) as archive:
        files = archive.infolist()
        require_readable_size(path, sum(file.file_size for file in files))
        [meta] = [f.filename for f in files if f.filename.rpartition("/")[2] == SOG_META]
        content = {file.filename: archive.read(file) for file in files}
    folder = meta.removesuffix(SOG_META)
    return _unpack_images(path, content[meta].decode(), lambda name: content[folder + name])


def _unpack_images(path: Path, text: str, read: Callable[[str], bytes]) -> tuple[Arrays, bool]:
    with readable(path, "SOG"):
        meta = json.loads(text)
        version = meta.get("version", 1)
        require(version in (1, 2), "the version", "1 or 2", version)
        count = int(meta["count"] if version == 2 else meta["means"]["shape"][0])
    require_readable_size(path, 300.0 * count)  # as floats

    def pixels(part: str, i: int = 0) -> NDArray[np.uint8]:
        with Image.open(io.BytesIO(read(meta[part]["files"][i]))) as image:
            require_readable_size(path, 4 * image.width * image.height)
            return np.asarray(image.convert("RGBA"))

    def each(part: str, i: int = 0) -> NDArray[np.uint8]:
        rows = pixels(part, i).reshape(-1, 4)[:count]
        require(len(rows) == count, f"the pixels of {part}", f">= {count}", len(rows))
        return rows

    def decode(part: str, values: NDArray[np.uint8]) -> NDArray[np.float64]:
        about = meta[part]
        if version == 2:
            return np.asarray(about["codebook"], dtype=float)[values]
        lower, upper = (np.asarray(about[end], dtype=float) for end in ("mins", "maxs"))
        return lower + (upper - lower) * (values / 255)

    with readable(path, "SOG"):
        words = each("means", 1)[:, :3].astype(float) * 256 + each("means")[:, :3]
        lower, upper = (np.asarray(meta["means"][end], dtype=float) for end in ("mins", "maxs"))
        logs = lower + (upper - lower) * (words / 65535)
        rotation, color = each("quats"), each("sh0")
        if version == 2:
            dc, opacity = decode("sh0", color[:, :3]), color[:, 3] / 255
        else:
            decoded = decode("sh0", color)
            dc, opacity = decoded[:, :3], 1 / (1 + np.exp(-decoded[:, 3]))
        sh = dc[:, None, :]
        if "shN" in meta:
            centroids, labels = pixels("shN")[..., :3], each("shN", 1).astype(int)
            # (rows, 64 (K - 1), 3) -> (centroids, K - 1, 3)
            table = centroids.reshape(len(centroids) * _PER_ROW, -1, 3)
            require(table.shape[1] in (3, 8, 15), "coefficients", "3, 8 or 15", table.shape[1])
            sh = np.concatenate([sh, decode("shN", table[labels[:, 0] + 256 * labels[:, 1]])], 1)
        arrays = {
            "means": np.sign(logs) * np.expm1(np.abs(logs)),
            "quats": insert_largest(
                (rotation[:, :3] / 127.5 - 1) * np.sqrt(0.5), rotation[:, 3].clip(252) - 252
            ),
            "scales": np.exp(decode("scales", each("scales")[:, :3])),
            "opacities": np.maximum(opacity, MIN_OPACITY),
            "sh": sh,
        }
    model = meta.get("model") or meta.get("antialias")
    return arrays, model in (True, "antialiased")
