"""Meshes as they are drawn: every face has two sides, and alpha is what glTF says that it is.

Drake draws all alpha as translucency, and its depth knows none. So what it is given has no alpha
but that of panes, whose depth is that of the pane; and surfaces whose textures cut holes are taken
out of it, for `CutOuts` to draw.
"""

import base64
import binascii
import copy
import json
import struct
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual import TextureVisuals

from splatpilot.systems.collision.field_mesh import data_uri
from splatpilot.systems.common.readers import reason_of, require_readable_size
from splatpilot.training.captures.capture import CaptureFrame

GAMMA = 2.2
"""Of textures and images, as VTK has it."""
_GLOSS = 0.01
"""What VTK's rough surfaces reflect of white light, whatever their color."""
_STEP = 1e-4
"""[m], and of the depth, from one surface to where the next is looked for."""
_HIDDEN = 0.01
"""Part of the light from behind below which nothing there is looked for."""


def sample_surface(
    path: Path, surface: trimesh.Trimesh, density: float
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Returns points (N, 3) [m] on a surface, so many [1/m^2], and the triangle (N,) of each.

    Raises:
        ValueError: if they would take too much memory; the message names the file `path`.
    """
    if not 0 < surface.area < np.inf:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.intp)
    count = int(density * surface.area) + 1
    require_readable_size(path, 64.0 * count)
    points, triangle = trimesh.sample.sample_surface(surface, count, seed=0)[:2]
    return np.asarray(points, dtype=np.float64), np.asarray(triangle)


@dataclass(frozen=True, eq=False)
class CutMaterial:
    """The base color of a surface, and where it is."""

    pixels: NDArray[np.float32]  # (H, W, 4), linear, colors times alpha
    transform: NDArray[np.float64]  # (2, 3), of texture coordinates
    wrap: tuple[str, str]  # repeat, mirror or clamp, across and down
    nearest: bool  # whether texels are not interpolated
    cutoff: float  # alpha from which there is a surface
    translucent: bool  # or opaque

    def at(self, uv: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns colors (n, 3), linear, and alphas (n,), 0 where there is no surface.

        Args:
            uv: (n, 2), texture coordinates as glTF has them, from the upper left corner.
        """
        size = np.array(self.pixels.shape[1::-1])
        position = (uv @ self.transform[:, :2].T + self.transform[:, 2]) * size - 0.5
        if self.nearest:
            position = np.round(position)
        first = np.floor(position).astype(int)
        weight = position - first
        found = np.zeros((len(uv), 4))
        for down in (0, 1):
            for across in (0, 1):
                column, row = (
                    _wrapped(first[:, k] + step, size[k], self.wrap[k])
                    for k, step in enumerate((across, down))
                )
                share = np.abs(1 - across - weight[:, 0]) * np.abs(1 - down - weight[:, 1])
                found += share[:, None] * self.pixels[row, column]
        alpha = found[:, 3]
        color = found[:, :3] / np.maximum(alpha, 1e-6)[:, None]
        there = alpha >= self.cutoff
        return color, np.where(there, alpha if self.translucent else 1.0, 0.0)


def _lit(
    albedo: NDArray[np.float64],
    normal: NDArray[np.float64],
    lamps: Sequence[tuple[Sequence[float], float]],
) -> NDArray[np.float64]:
    """Returns colors (n, 3), 0 to 1, of surfaces as VTK lights rough ones that are not metal."""
    light = np.zeros(len(normal))
    for direction, intensity in lamps:
        toward = -np.asarray(direction) / np.linalg.norm(direction)
        light += intensity / np.pi * np.maximum(normal @ toward, 0)
    return np.clip((albedo + _GLOSS) * light[:, None], 0, 1) ** (1 / GAMMA)


def _wrapped(texel: NDArray[np.intp], size: int, wrap: str) -> NDArray[np.intp]:
    if wrap == "clamp":
        return texel.clip(0, size - 1)
    if wrap == "mirror":
        texel = texel % (2 * size)
        return np.minimum(texel, 2 * size - 1 - texel)
    return texel % size


@dataclass(frozen=True, eq=False)
class CutOuts:
    """Triangles with holes."""

    triangles: NDArray[np.float64]  # (T, 3, 3) [m], corners in W
    uv: NDArray[np.float64]  # (T, 3, 2)
    material: NDArray[np.intp]  # (T,)
    materials: Sequence[CutMaterial]

    @cached_property
    def _scene(self) -> Any:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ModuleNotFoundError:
            raise ModuleNotFoundError(
                "textures that cut holes need embreex, of which there is no wheel for this "
                "processor; render the capture on another machine",
                name="embreex",
            ) from None
        scene = EmbreeScene()
        TriangleMesh(scene, self.triangles.astype(np.float32))
        return scene

    @cached_property
    def _normals(self) -> NDArray[np.float64]:
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        normals = np.cross(b - a, c - a)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)

    def _at(
        self, triangle: NDArray[np.intp], weights: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns colors (n, 3) and alphas (n,) of points by their barycentric weights (n, 3)."""
        uv = (weights[..., None] * self.uv[triangle]).sum(axis=1)
        color, alpha = np.zeros((len(uv), 3)), np.zeros(len(uv))
        for i, material in enumerate(self.materials):
            own = self.material[triangle] == i
            color[own], alpha[own] = material.at(uv[own])
        return color, alpha

    def sample(self, path: Path, density: float) -> NDArray[np.float64]:
        """Returns points (N, 3) [m] that are in no hole; see `sample_surface`."""
        faces = np.arange(3 * len(self.triangles)).reshape(-1, 3)
        surface = trimesh.Trimesh(self.triangles.reshape(-1, 3), faces, process=False)
        points, triangle = sample_surface(path, surface, density)
        weights = trimesh.triangles.points_to_barycentric(self.triangles[triangle], points)
        return points[self._at(triangle, weights)[1] > 0]

    def draw(
        self, frame: CaptureFrame, near: float, lamps: Sequence[tuple[Sequence[float], float]]
    ) -> CaptureFrame:
        """Returns the frame with these surfaces in it, where nothing in it hides them.

        Depth is that of the first surface, opaque or not.

        Args:
            near: [m], depth from which on surfaces are seen.
            lamps: direction of the light, and its intensity.
        """
        height, width = frame.depth.shape
        v, u = np.mgrid[:height, :width] + 0.5
        # Their depth is 1, so that distances along them are depths.
        rays = frame.back_project(u, v, np.ones_like(u)).reshape(-1, 3)
        rays = rays @ frame.X_WC.rotation().matrix().T
        p_WC = frame.X_WC.translation()
        depth, color = frame.depth.reshape(-1).astype(np.float64), np.zeros((len(rays), 3))
        limit = depth.copy()
        behind, reached = np.ones(len(rays)), np.full(len(rays), near)
        active = np.flatnonzero(limit > near)
        while len(active):
            triangle = self._first(p_WC + reached[active, None] * rays[active], rays[active])
            active, triangle = active[triangle >= 0], triangle[triangle >= 0]
            # Again in double precision.
            normal, ray = self._normals[triangle], rays[active]
            slope = (ray * normal).sum(axis=1)
            offset = ((self.triangles[triangle, 0] - p_WC) * normal).sum(axis=1)
            z = np.maximum(offset / np.where(slope == 0, 1, slope), reached[active])
            seen = z < limit[active]
            active, triangle, z, ray = active[seen], triangle[seen], z[seen], ray[seen]
            weights = trimesh.triangles.points_to_barycentric(
                self.triangles[triangle], p_WC + z[:, None] * ray
            )
            albedo, alpha = self._at(triangle, weights)
            facing = -np.sign(slope[seen])[:, None] * normal[seen]
            share = behind[active] * alpha
            color[active] += share[:, None] * _lit(albedo, facing, lamps)
            first = (behind[active] == 1) & (alpha > 0)
            depth[active[first]] = z[first]
            behind[active] -= share
            reached[active] = z + _STEP * np.maximum(z, 1)
            active = active[behind[active] > _HIDDEN]
        image = 255 * color.reshape(height, width, 3)
        image += behind.reshape(height, width, 1) * frame.image
        return replace(
            frame,
            image=np.round(image).clip(0, 255).astype(np.uint8),
            depth=depth.reshape(height, width).astype(np.float32),
        )

    def _first(self, origins: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.intp]:
        """Returns the first triangle (n,) that each ray meets, -1 for none."""
        found = self._scene.run(
            origins.astype(np.float32), rays.astype(np.float32), query="INTERSECT"
        )
        return np.asarray(found, dtype=np.intp)


SUFFIXES = (".gltf", ".glb", ".obj")
_GLB = b"glTF"


@dataclass(frozen=True, eq=False)
class GltfFile:
    """A glTF document whose buffers are read."""

    folder: Path  # to which URIs are relative
    document: dict[str, Any]
    buffers: list[bytes]

    def view(self, number: int) -> bytes:
        """Returns the content of a buffer view."""
        view = self.document["bufferViews"][number]
        start = view.get("byteOffset", 0)
        return self.buffers[view["buffer"]][start : start + view["byteLength"]]

    def image(self, number: int) -> Image.Image:
        """Returns an image, not yet decoded.

        Raises:
            ValueError, OSError: if it is missing or not an image.
        """
        image = self.document["images"][number]
        inside = "bufferView" in image
        content = self.view(image["bufferView"]) if inside else _read(self.folder, image["uri"])
        opened = Image.open(BytesIO(content))
        require_readable_size(self.folder, 4 * opened.width * opened.height)
        return opened


def read_gltf(path: Path) -> GltfFile:
    """Reads a mesh as glTF.

    Raises:
        Exception: anything, if it is damaged.
    """
    require_readable_size(path, 4 * path.stat().st_size)
    content, binary = path.read_bytes(), b""
    if path.suffix == ".obj":
        scene: Any = trimesh.load(path, force="scene", process=False)
        for mesh in scene.geometry.values():
            # Its materials are not of metal, as glTF's are if nothing is said.
            mesh.visual = mesh.visual if mesh.visual.kind == "texture" else TextureVisuals()
            mesh.visual.material = mesh.visual.material.to_pbr()
            mesh.visual.material.metallicFactor, mesh.visual.material.roughnessFactor = 0.0, 1.0
        content = scene.export(file_type="glb")
    if content.startswith(_GLB):
        content, binary = _chunks(content)
    document = json.loads(content)
    buffers = [
        _read(path.parent, buffer["uri"]) if "uri" in buffer else binary
        for buffer in document["buffers"]
    ]
    return GltfFile(path.parent, document, buffers)


def _chunks(content: bytes) -> tuple[bytes, bytes]:
    """Returns the document and the buffer of a binary glTF."""
    parts, start = [], 12
    for _ in range(2):
        if start + 8 <= len(content):
            (length,) = struct.unpack_from("<I", content, start)
            parts.append(content[start + 8 : start + 8 + length])
            start += 8 + length
    return parts[0], parts[1] if len(parts) > 1 else b""


def _read(folder: Path, uri: str) -> bytes:
    kind, comma, data = uri.partition(",")
    if kind.startswith("data:") and comma:
        try:
            return base64.b64decode(data, validate=True)
        except binascii.Error as error:
            raise ValueError(f"data that is not base64: {error}") from None
    file = folder / urllib.parse.unquote(uri)
    require_readable_size(file, file.stat().st_size)
    return file.read_bytes()


# Whether a glTF file is as large as it claims, and its triangles are of vertices that it has.
#
# Readers of meshes believe both: a count that is wrong makes them take all memory, and an index
# that is wrong ends the process.


_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_POSITION = 1e6  # [m]


def check_gltf_claims(document: dict[str, Any], buffers: list[bytes]) -> None:
    """
    Raises:
        ValueError: for a document whose accessors are not within their buffers, or whose triangles
            or positions are none.
    """
    _Claims(document, buffers).check()


class _Claims:
    def __init__(self, document: dict[str, Any], buffers: list[bytes]) -> None:
        self._document, self._buffers = document, buffers
        for buffer, content in zip(document["buffers"], buffers, strict=True):
            if _count(buffer["byteLength"]) > len(content):
                raise ValueError(f"a buffer claims {buffer['byteLength']} bytes of {len(content)}")

    def check(self) -> None:
        arrays = [self._array(accessor) for accessor in self._document.get("accessors", [])]
        for mesh in self._document.get("meshes", []):
            for primitive in mesh["primitives"]:
                self._check_primitive(primitive, arrays)
        _require_tree(self._document.get("nodes", []))

    def _array(self, accessor: dict[str, Any]) -> np.ndarray:
        """What an accessor is of, (count, width)."""
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError("an accessor without a view of a buffer")
        view = self._document["bufferViews"][_count(accessor["bufferView"])]
        content = self._buffers[_count(view["buffer"])]
        start, length = _count(view.get("byteOffset", 0)), _count(view["byteLength"])
        if start + length > len(content):
            raise ValueError(f"a view claims bytes {start} to {start + length} of {len(content)}")
        dtype, width = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        count, offset = _count(accessor["count"]), _count(accessor.get("byteOffset", 0))
        row = dtype.itemsize * width
        stride = _count(view.get("byteStride", row))
        if count == 0 or stride < row or offset + stride * (count - 1) + row > length:
            raise ValueError(f"an accessor claims {count} rows of {stride} bytes, of {length}")
        return np.ndarray((count, width), dtype, content, start + offset, (stride, dtype.itemsize))

    def _check_primitive(self, primitive: dict[str, Any], arrays: list[np.ndarray]) -> None:
        attributes = {
            name: arrays[_count(number)] for name, number in primitive["attributes"].items()
        }
        positions = attributes["POSITION"]
        if positions.dtype.kind != "f" or positions.shape[1] != 3:
            raise ValueError("positions are no vectors of floats")
        if not (np.abs(positions) <= _MAX_POSITION).all():
            raise ValueError(f"positions are not finite or beyond {_MAX_POSITION:g} m")
        for name, array in attributes.items():
            if len(array) != len(positions):
                raise ValueError(f"{len(array)} of {name} for {len(positions)} vertices")
        if "indices" in primitive:
            indices = arrays[_count(primitive["indices"])]
            if indices.dtype.kind != "u" or indices.shape[1] != 1:
                raise ValueError("indices are no whole numbers")
            if indices.max() >= len(positions):
                raise ValueError(f"vertex {indices.max()} of {len(positions)}")


def _count(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{value!r} stands where a count belongs")
    return value


def _require_tree(nodes: list[dict[str, Any]]) -> None:
    """Raises ValueError where a node is in itself, or in two others."""
    parents = [0] * len(nodes)
    for node in nodes:
        for child in node.get("children", []):
            parents[_count(child)] += 1
        for name, size in (("translation", 3), ("rotation", 4), ("scale", 3), ("matrix", 16)):
            values = np.array(node.get(name, np.zeros(size)), dtype=float)
            if values.shape != (size,) or not (np.abs(values) <= _MAX_POSITION).all():
                raise ValueError(f"{name} of a node is {node[name]}")
    if any(count > 1 for count in parents):
        raise ValueError("a node is in two others")
    reached = [i for i, count in enumerate(parents) if count == 0]
    for i in reached:
        reached.extend(nodes[i].get("children", []))
    if len(reached) < len(nodes):
        raise ValueError("a node is in itself")


_CUTOFF = 0.5
"""Alpha from which a MASK is opaque, where the file does not say."""
_VISIBLE = 1 / 255
"""Alpha from which a BLEND is there."""
_SOLID = "solid.gltf"
_NEAREST = 9728
_WRAPS = {33071: "clamp", 33648: "mirror"}
_UP = {
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
"""R_WM, of the axes of a file M by that which points up."""


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """A mesh in two parts, either of which may be missing."""

    path: Path  # where it comes from
    solid: Path | None  # .gltf without holes
    surface: trimesh.Trimesh  # of the same, in W
    cut_outs: CutOuts | None  # in W

    def sample(self, density: float) -> NDArray[np.float64]:
        """Returns points (N, 3) [m] on its surfaces in W, so many [1/m^2]; see `sample_surface`."""
        points = [sample_surface(self.path, self.surface, density)[0]]
        if self.cut_outs is not None:
            points.append(self.cut_outs.sample(self.path, density))
        return np.concatenate(points)


@contextmanager
def drawn_mesh(path: Path, up: str) -> Iterator[DrawnMesh]:
    """Opens a mesh as it is to be drawn.

    Args:
        path: see `read_gltf`.
        up: the axis of the file's coordinates that points up, "y" or "z".

    Raises:
        ValueError: if it is damaged; the message names the file.
    """
    with TemporaryDirectory(prefix="splatpilot-") as folder:
        try:
            mesh = _split(path, Path(folder), _UP[up])
        except Exception as error:  # readers of meshes and images raise anything of damaged files
            raise ValueError(
                f"{path}: not a readable mesh ({reason_of(error)}); export it again, with "
                "everything embedded"
            ) from None
        yield mesh


def _split(path: Path, folder: Path, R_WM: NDArray[np.float64]) -> DrawnMesh:
    file = read_gltf(path)
    check_gltf_claims(file.document, file.buffers)
    for i, content in enumerate(file.buffers):
        (folder / f"{i}.bin").write_bytes(content)
    given = file.document.get("materials", [])
    cut = {i: found for i in range(len(given)) if (found := _cut_material(file, i))}
    # A mask without a texture is there or not.
    gone = {
        i
        for i, material in enumerate(given)
        if material.get("alphaMode") == "MASK"
        and i not in cut
        and _base_color(material)[3] < material.get("alphaCutoff", _CUTOFF)
    }
    solid = _part(file, lambda i: i not in cut and i not in gone)
    surface, cut_outs = trimesh.Trimesh(), None
    if solid is not None:
        triangles, _, _ = _triangles(solid, folder, R_WM)
        faces = np.arange(3 * len(triangles)).reshape(-1, 3)
        surface = trimesh.Trimesh(triangles.reshape(-1, 3), faces, process=False)
        for mesh in solid["meshes"]:
            for primitive in mesh["primitives"]:
                primitive.setdefault("material", len(given))
        solid["materials"] = [*solid.get("materials", []), {}]
        for material in solid["materials"]:
            material["doubleSided"] = True
            if material.get("alphaMode") != "BLEND":
                color = [*_base_color(material)[:3], 1.0]
                material.setdefault("pbrMetallicRoughness", {})["baseColorFactor"] = color
                material["alphaMode"] = "OPAQUE"
        if "images" in solid:
            solid["images"] = [_without_alpha(file, i) for i in range(len(solid["images"]))]
        (folder / _SOLID).write_text(json.dumps(solid))
    rest = _part(file, lambda i: i in cut)
    if rest is not None:
        triangles, uv, numbers = _triangles(rest, folder, R_WM)
        order = {number: i for i, number in enumerate(cut)}
        cut_outs = CutOuts(triangles, uv, np.array([order[i] for i in numbers]), list(cut.values()))
    return DrawnMesh(path, folder / _SOLID if solid else None, surface, cut_outs)


def _part(file: GltfFile, has: Callable[[int], bool]) -> dict[str, Any] | None:
    """Returns the document with those primitives alone whose material is one of the part, -1 for
    those without; None if there are none."""
    document, kept, numbers = copy.deepcopy(file.document), [], {}
    for i, mesh in enumerate(document.get("meshes", [])):
        mesh["primitives"] = [p for p in mesh["primitives"] if has(p.get("material", -1))]
        if mesh["primitives"]:
            numbers[i] = len(kept)
            kept.append(mesh)
    document["meshes"] = kept
    for node in document.get("nodes", []):
        if "mesh" in node and (number := numbers.get(node.pop("mesh"))) is not None:
            node["mesh"] = number
    for i, buffer in enumerate(document["buffers"]):
        buffer["uri"] = f"{i}.bin"
    return document if kept else None


def _base_color(material: dict[str, Any]) -> list[float]:
    return material.get("pbrMetallicRoughness", {}).get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])


def _without_alpha(file: GltfFile, number: int) -> dict[str, Any]:
    """Returns an image that is in the document, and not translucent."""
    image = file.document["images"][number]
    opened = file.image(number)
    if not opened.has_transparency_data and "bufferView" in image:
        return image
    stream = BytesIO()
    opened.convert("RGB").save(stream, "PNG")
    return {"uri": data_uri("image/png", stream.getvalue())}


def _cut_material(file: GltfFile, number: int) -> CutMaterial | None:
    """Returns a material whose texture cuts holes, None for any other."""
    material = file.document["materials"][number]
    texture_info = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
    mode = material.get("alphaMode", "OPAQUE")
    if mode == "OPAQUE" or texture_info is None:
        return None
    texture = file.document["textures"][texture_info["index"]]
    image = file.image(texture["source"])
    if not image.has_transparency_data:
        return None
    if texture_info.get("texCoord", 0) != 0:
        raise ValueError("the texture of a cut-out uses TEXCOORD_1; only TEXCOORD_0 is read")
    pixels = np.asarray(image.convert("RGBA"), dtype=np.float32) / 255
    pixels[..., :3] **= GAMMA
    pixels *= np.asarray(_base_color(material), dtype=np.float32)
    pixels[..., :3] *= pixels[..., 3:]
    sampler = file.document.get("samplers", [{}])[texture.get("sampler", 0)]
    return CutMaterial(
        pixels.astype(np.float32),
        _transform(texture_info.get("extensions", {}).get("KHR_texture_transform", {})),
        wrap=tuple(_WRAPS.get(sampler.get(key, 0), "repeat") for key in ("wrapS", "wrapT")),  # pyright: ignore[reportArgumentType]
        nearest=sampler.get("magFilter") == _NEAREST,
        cutoff=material.get("alphaCutoff", _CUTOFF) if mode == "MASK" else _VISIBLE,
        translucent=mode == "BLEND",
    )


def _transform(given: dict[str, Any]) -> NDArray[np.float64]:
    """Returns the matrix (2, 3) of KHR_texture_transform."""
    cos, sin = np.cos(given.get("rotation", 0.0)), np.sin(given.get("rotation", 0.0))
    turned = np.array([[cos, -sin], [sin, cos]]) * given.get("scale", [1.0, 1.0])
    return np.column_stack([turned, given.get("offset", [0.0, 0.0])])


def _triangles(
    document: dict[str, Any], folder: Path, R_WM: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.intp]]:
    """Returns the corners (T, 3, 3) [m] of all triangles in W, their texture coordinates (T, 3, 2),
    0 without any, and the numbers of their materials (T,), -1 without one."""
    bare = {key: each for key, each in document.items() if key not in ("textures", "images")}
    bare["materials"] = [{"name": str(i)} for i in range(len(document.get("materials", [])))]
    file = folder / "bare.gltf"
    file.write_text(json.dumps(bare))
    scene: Any = trimesh.load(file, force="scene", process=False)
    triangles, uv, material = [], [], []
    for node in scene.graph.nodes_geometry:
        X_MN, name = scene.graph[node]
        mesh = scene.geometry[name]
        p_W = trimesh.transform_points(mesh.vertices, X_MN) @ R_WM.T
        triangles.append(p_W[mesh.faces])
        own = getattr(mesh.visual, "uv", None)
        own = np.zeros((len(p_W), 2)) if own is None else own * [1, -1] + [0, 1]  # from above
        uv.append(own[mesh.faces])
        named = getattr(getattr(mesh.visual, "material", None), "name", None)
        material.append(np.full(len(mesh.faces), -1 if named is None else int(named)))
    if not triangles:
        raise ValueError("it holds no triangles")
    return np.concatenate(triangles), np.concatenate(uv), np.concatenate(material)
