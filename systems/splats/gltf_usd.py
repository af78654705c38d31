"""Gaussians in glTF 2.0, the ratified extension KHR_gaussian_splatting, and in USD, the schema
ParticleField3DGaussianSplat, by the extra `usd`."""

import base64
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import readable, require_readable_size
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.packed_splats import Arrays
from splatpilot.systems.splats.scene import (
    MAX_DEGREE,
    GaussianScene,
    color_to_sh,
    concatenated,
    rotated_sh,
)

_EXTENSION = "KHR_gaussian_splatting"
_READ = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
_HARMONICS = [f"SH_DEGREE_{d}_COEF_{n}" for d in range(MAX_DEGREE + 1) for n in range(2 * d + 1)]
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_FLOAT, _VERTICES = 5126, 34962
_JSON, _BIN = b"JSON", b"BIN\x00"
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")


def unpack_gltf(path: Path) -> Arrays:
    """Returns the Gaussians of all nodes of the scene, in its axes, y up."""
    require_readable_size(path, path.stat().st_size)
    with readable(path, "glTF file"):
        document, body = _open(path.read_bytes())
        used = document.get("extensionsUsed", [])
    if _EXTENSION not in used:
        raise ValueError(
            f"{path}: a glTF without {_EXTENSION}, so a mesh; render a capture of it with "
            "`splatpilot capture render`"
        )
    packed = [name for name in used if name.startswith(f"{_EXTENSION}_") or "compression" in name]
    if packed:
        raise ValueError(f"{path}: compressed by {packed[0]}; export it without compression")
    file = _Buffers(path, document, body)
    with readable(path, f"glTF file of {_EXTENSION}"):
        parts = [
            _moved(_unpack_primitive(file, primitive), X)
            for X, mesh in _placed_meshes(document)
            for primitive in document["meshes"][mesh]["primitives"]
            if _EXTENSION in primitive.get("extensions", {})
        ]
        return concatenated(parts)


def _moved(arrays: Arrays, X: NDArray[np.float64]) -> Arrays:
    """Returns Gaussians under an affine transform (4, 4) that does not mirror."""
    M = X[:3, :3]
    if np.array_equal(X, np.eye(4)):
        return arrays
    require(np.linalg.det(M) > 0, "a transform of Gaussians", "one without mirroring", M.tolist())
    U, stretch, V = np.linalg.svd(M)
    turn, quats, scales = U @ V, arrays["quats"], arrays["scales"]
    known = np.isfinite(quats).all(axis=1) & quats.any(axis=1) & np.isfinite(scales).all(axis=1)
    R, sizes = Rotation.from_quat(quats[known], scalar_first=True).as_matrix(), scales[known]
    if np.ptp(stretch) < 1e-5 * stretch[0]:
        R, sizes = turn @ R, stretch.mean() * sizes
    else:
        R, sizes, _ = np.linalg.svd(M @ (R * sizes[:, None, :]))
        R[:, :, 2] *= np.linalg.det(R)[:, None]
    # Invalid ones are dropped later.
    quats, scales = (np.full(array.shape, np.nan) for array in (quats, scales))
    quats[known], scales[known] = Rotation.from_matrix(R).as_quat(scalar_first=True), sizes
    means, sh = arrays["means"] @ M.T + X[:3, 3], rotated_sh(arrays["sh"], turn)
    return arrays | {"means": means, "quats": quats, "scales": scales, "sh": sh}


def _open(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Returns the document and the binary part of a `.gltf` or `.glb`."""
    if not content.startswith(b"glTF"):
        return json.loads(content.decode("utf-8-sig")), b""
    chunks, at = {}, _HEADER.size
    while at + _CHUNK.size <= len(content):
        size, kind = _CHUNK.unpack_from(content, at)
        at += _CHUNK.size
        chunks.setdefault(kind, content[at : at + size])
        at += size
    return json.loads(chunks[_JSON]), chunks.get(_BIN, b"")


class _Buffers:
    """Accessors of a glTF file."""

    def __init__(self, path: Path, document: dict[str, Any], body: bytes):
        self._path, self._document, self._body = path, document, body
        self._read: dict[int, bytes] = {}

    def _buffer(self, index: int) -> bytes:
        if index not in self._read:
            uri = self._document["buffers"][index].get("uri")
            if uri is None:
                content = self._body
            elif uri.startswith("data:"):
                content = base64.b64decode(uri.partition(",")[2])
            else:
                content = (self._path.parent / unquote(uri)).read_bytes()
            self._read[index] = content
        return self._read[index]

    def array(self, index: int) -> NDArray[np.float64]:
        """Returns the values (N, width) of an accessor."""
        accessor = self._document["accessors"][index]
        require("sparse" not in accessor, f"accessor {index}", "dense", "a sparse one")
        view = self._document["bufferViews"][accessor["bufferView"]]
        dtype, width = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        count, step = accessor["count"], view.get("byteStride") or dtype.itemsize * width
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        values = np.ndarray(
            (count, width), dtype, self._buffer(view["buffer"]), start, (step, dtype.itemsize)
        )
        found = values.astype(np.float64)
        if not accessor.get("normalized"):
            return found
        return np.maximum(found / np.iinfo(dtype).max, -1.0)


def _unpack_primitive(file: _Buffers, primitive: dict[str, Any]) -> Arrays:
    about = primitive["extensions"][_EXTENSION]
    for name, known in _READ.items():
        value = about.get(name, known)
        require(value == known, f"the {name}", known, value)
    attributes = primitive["attributes"]

    def attribute(name: str) -> NDArray[np.float64]:
        return file.array(attributes[f"{_EXTENSION}:{name}"])

    sh = [attribute(name) for name in _HARMONICS if f"{_EXTENSION}:{name}" in attributes]
    return {
        "means": file.array(attributes["POSITION"]),
        "quats": np.roll(attribute("ROTATION"), 1, axis=1),  # from x y z w
        "scales": attribute("SCALE"),
        "opacities": attribute("OPACITY")[:, 0],
        "sh": np.stack(sh, axis=1),
    }


def _placed_meshes(document: dict[str, Any]) -> Iterator[tuple[NDArray[np.float64], int]]:
    """Yields the transform (4, 4) and number of each mesh in the scene."""
    nodes = document.get("nodes", [])
    scenes = document.get("scenes", [])
    inner = {child for node in nodes for child in node.get("children", [])}
    outer = [index for index in range(len(nodes)) if index not in inner]
    roots = scenes[document.get("scene", 0)].get("nodes", []) if scenes else outer
    pending = [(np.eye(4), index, 0) for index in roots]
    while pending:
        X, index, depth = pending.pop()
        require(depth <= len(nodes), "nodes", "a tree", "a cycle")
        node = nodes[index]
        X = X @ _node_transform(node)
        if "mesh" in node:
            yield X, node["mesh"]
        pending += [(X, child, depth + 1) for child in node.get("children", [])]


def _node_transform(node: dict[str, Any]) -> NDArray[np.float64]:
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T.astype(float)
    X = np.eye(4)
    R = Rotation.from_quat(node.get("rotation", (0.0, 0.0, 0.0, 1.0))).as_matrix()
    X[:3, :3] = R * np.asarray(node.get("scale", (1.0, 1.0, 1.0)))
    X[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return X


def write_gltf(scene: GaussianScene, path: Path) -> None:
    """Writes a scene, given in axes with y up, atomically: as `.glb`, or as `.gltf` with its data
    inside."""
    linear = _from_srgb(scene.base_colors.astype(np.float64))
    named = {
        "POSITION": scene.means,
        "COLOR_0": np.column_stack([linear, scene.opacities]),  # for viewers of points
        f"{_EXTENSION}:ROTATION": np.roll(scene.quats, -1, axis=1),
        f"{_EXTENSION}:SCALE": scene.scales,
        f"{_EXTENSION}:OPACITY": scene.opacities[:, None],
        **{f"{_EXTENSION}:{_HARMONICS[k]}": scene.sh[:, k] for k in range(scene.sh.shape[1])},
    }
    arrays = [np.ascontiguousarray(array, "<f4") for array in named.values()]
    kinds = {width: kind for kind, width in _WIDTHS.items()}
    accessors = [
        {"bufferView": i, "componentType": _FLOAT, "count": len(a), "type": kinds[a.shape[1]]}
        for i, a in enumerate(arrays)
    ]
    accessors[0] |= {"min": scene.means.min(0).tolist(), "max": scene.means.max(0).tolist()}
    starts = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    body = b"".join(array.tobytes() for array in arrays)
    primitive = {"mode": 0, "attributes": {name: i for i, name in enumerate(named)}}
    node: dict[str, Any] = {"mesh": 0}
    if any(scene.origin):
        node["translation"] = list(scene.origin)
    document = {
        "asset": {"version": "2.0", "generator": "splatpilot"},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive | {"extensions": {_EXTENSION: _READ}}]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": a.nbytes, "target": _VERTICES}
            for start, a in zip(starts, arrays, strict=False)
        ],
        "buffers": [{"byteLength": len(body)}],
    }
    if path.suffix.lower() == ".glb":
        text = json.dumps(document).encode()
        chunks = [(_JSON, text + b" " * (-len(text) % 4)), (_BIN, body)]
        packed = b"".join(_CHUNK.pack(len(each), kind) + each for kind, each in chunks)
        content = _HEADER.pack(b"glTF", 2, _HEADER.size + len(packed)) + packed
    else:
        data = base64.b64encode(body).decode()
        document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{data}"
        content = json.dumps(document).encode()
    with written_atomically(path) as partial:
        partial.write_bytes(content)


def _from_srgb(color: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


_SCHEMA = "ParticleField3DGaussianSplat"
_COEFFICIENTS, _DEGREE = (
    "radiance:sphericalHarmonicsCoefficients",
    "radiance:sphericalHarmonicsDegree",
)


def unpack_usd(path: Path) -> tuple[Arrays, float, bool]:
    """Returns the Gaussians of all prims of the stage in its axes and units, the length of a unit
    [m], and whether y is up."""
    Usd, UsdGeom = (import_extra(f"pxr.{name}", "usd") for name in ("Usd", "UsdGeom"))
    require_readable_size(path, path.stat().st_size)
    with readable(path, "USD file"):
        stage = Usd.Stage.Open(str(path))
        found = [prim for prim in stage.Traverse() if prim.GetTypeName() == _SCHEMA]
    if not found:
        raise ValueError(f"{path}: a USD file without {_SCHEMA}; export the Gaussians as that")
    first = Usd.TimeCode.EarliestTime()
    transforms = UsdGeom.XformCache(first)
    with readable(path, f"USD file of {_SCHEMA}"):
        parts = []
        for prim in found:
            X = np.array(transforms.GetLocalToWorldTransform(prim)).T  # USD's vectors are rows
            parts.append(_moved(_unpack_prim(prim, first), X))
        meters = float(UsdGeom.GetStageMetersPerUnit(stage))
        return concatenated(parts), meters, UsdGeom.GetStageUpAxis(stage) == "Y"


def _unpack_prim(prim: Any, time: Any) -> Arrays:
    def attribute(name: str) -> NDArray[np.float64] | None:
        for each in (name, f"{name}h"):  # in half precision
            value = prim.GetAttribute(each).Get(time)
            if value is not None and len(value):
                return np.array(value, dtype=np.float64)
        return None

    means = attribute("positions")
    if means is None:
        raise ValueError(f"{prim.GetPath()} must have positions, got none")
    count = len(means)
    quats, scales, opacities = map(attribute, ("orientations", "scales", "opacities"))
    sh, colors = attribute(_COEFFICIENTS), attribute("primvars:displayColor")
    if sh is None:
        colors = np.full((1, 3), 0.5) if colors is None else colors
        sh = color_to_sh(np.broadcast_to(colors, (count, 3)))
    return {
        "means": means,
        # Imaginary parts come first in memory.
        "quats": np.eye(4)[[0]].repeat(count, 0) if quats is None else np.roll(quats, 1, axis=1),
        "scales": np.ones((count, 3)) if scales is None else scales,
        "opacities": np.ones(count) if opacities is None else opacities,
        "sh": sh.reshape(count, -1, 3),
    }


def write_usd(scene: GaussianScene, path: Path) -> None:
    """Writes a scene with z up, in meters, atomically."""
    Usd, UsdGeom, Vt = (import_extra(f"pxr.{name}", "usd") for name in ("Usd", "UsdGeom", "Vt"))
    values = {
        "positions": ("Point3fArray", Vt.Vec3fArray, scene.means),
        "orientations": ("QuatfArray", Vt.QuatfArray, np.roll(scene.quats, -1, axis=1)),
        "scales": ("Float3Array", Vt.Vec3fArray, scene.scales),
        "opacities": ("FloatArray", Vt.FloatArray, scene.opacities),
        _COEFFICIENTS: ("Float3Array", Vt.Vec3fArray, scene.sh.reshape(-1, 3)),
    }
    Sdf, Gf = (import_extra(f"pxr.{name}", "usd") for name in ("Sdf", "Gf"))
    with written_atomically(path) as partial:
        stage = Usd.Stage.CreateNew(str(partial))
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdGeom.SetStageUpAxis(stage, "Z")
        prim = stage.DefinePrim("/Gaussians", _SCHEMA)
        stage.SetDefaultPrim(prim)
        for name, (kind, array, content) in values.items():
            of_kind = getattr(Sdf.ValueTypeNames, kind)
            prim.CreateAttribute(name, of_kind, custom=False).Set(
                array.FromNumpy(np.ascontiguousarray(content, np.float32))
            )
        degree = prim.CreateAttribute(_DEGREE, Sdf.ValueTypeNames.Int, custom=False)
        degree.Set(scene.sh_degree)
        if any(scene.origin):
            UsdGeom.Xformable(prim).AddTranslateOp().Set(Gf.Vec3d(*scene.origin))
        stage.Save()
