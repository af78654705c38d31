"""Meshes as they are drawn: faces have two sides, and alpha is what glTF says.

Drake draws any alpha as translucent, and its depth ignores alpha. So it gets a mesh without alpha
but that of panes, whose depth is that of the pane; `CutOuts` draws surfaces with holes in their
textures.
"""

import base64
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
from splatpilot.training.captures.capture import CaptureFrame, pixel_rays

SUFFIXES = (".gltf", ".glb", ".obj")
_GAMMA = 2.2
"""Of textures and images, as in VTK."""
_GLOSS = 0.01
"""Fraction of white light that VTK's rough surfaces reflect, whatever their color."""
_STEP = 1e-4
"""[m], and fraction of the depth, from a surface to the start of the search for the next."""
_HIDDEN = 0.01
"""Fraction of the light from behind below which the search ends."""
_MAX_POSITION = 1e6  # [m]
_CUTOFF = 0.5
"""glTF's default alpha from which a MASK is opaque."""
_VISIBLE = 1 / 255
"""Alpha from which a BLEND is visible."""
_NEAREST = 9728
_WRAPS = {33071: "clamp", 33648: "mirror"}
_UP = {
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
"""R_WM, of the axes of a file M by the one that points up."""


def _sample_surface(
    path: Path, triangles: NDArray[np.float64], density: float
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Returns points (N, 3) [m] on triangles (T, 3, 3), with a density [1/m^2], and the triangle
    (N,) of each."""
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    surface = trimesh.Trimesh(triangles.reshape(-1, 3), faces, process=False)
    if not 0 < surface.area < np.inf:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.intp)
    count = int(density * surface.area) + 1
    require_readable_size(path, 64.0 * count)
    points, triangle = trimesh.sample.sample_surface(surface, count, seed=0)[:2]
    return np.asarray(points, dtype=np.float64), np.asarray(triangle)


@dataclass(frozen=True, eq=False)
class CutMaterial:
    """The base color of a surface with holes."""

    pixels: NDArray[np.float32]  # (H, W, 4), linear, colors times alpha
    transform: NDArray[np.float64]  # (2, 3), of texture coordinates
    wrap: Sequence[str]  # repeat, mirror or clamp, across and down
    nearest: bool  # whether texels are not interpolated
    cutoff: float  # alpha from which the surface exists
    translucent: bool  # or opaque

    def sample(self, uv: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns linear colors (n, 3) and alphas (n,), 0 in holes.

        Args:
            uv: (n, 2), texture coordinates as in glTF, from the upper left corner.
        """
        size = np.array(self.pixels.shape[1::-1])
        position = (uv @ self.transform[:, :2].T + self.transform[:, 2]) * size - 0.5
        if self.nearest:
            position = np.round(position)
        first = np.floor(position).astype(int)
        weight = position - first
        texel = np.zeros((len(uv), 4))
        for down in (0, 1):
            for across in (0, 1):
                column, row = (
                    _wrap(first[:, k] + step, size[k], self.wrap[k])
                    for k, step in enumerate((across, down))
                )
                share = np.abs(1 - across - weight[:, 0]) * np.abs(1 - down - weight[:, 1])
                texel += share[:, None] * self.pixels[row, column]
        alpha = texel[:, 3]
        color = texel[:, :3] / np.maximum(alpha, 1e-6)[:, None]
        return color, np.where(alpha >= self.cutoff, alpha if self.translucent else 1.0, 0.0)


def _wrap(texel: NDArray[np.intp], size: int, wrap: str) -> NDArray[np.intp]:
    if wrap == "clamp":
        return texel.clip(0, size - 1)
    if wrap == "mirror":
        texel = texel % (2 * size)
        return np.minimum(texel, 2 * size - 1 - texel)
    return texel % size


def _shade(
    albedo: NDArray[np.float64],
    normal: NDArray[np.float64],
    lamps: Sequence[tuple[Sequence[float], float]],
) -> NDArray[np.float64]:
    """Returns colors (n, 3), 0 to 1, of rough dielectric surfaces as VTK lights them."""
    light = np.zeros(len(normal))
    for direction, intensity in lamps:
        toward = -np.asarray(direction) / np.linalg.norm(direction)
        light += intensity / np.pi * np.maximum(normal @ toward, 0)
    return np.clip((albedo + _GLOSS) * light[:, None], 0, 1) ** (1 / _GAMMA)


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
                "textures with holes need embreex, which has no wheel for this processor; render "
                "the capture on another machine",
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

    def _sample_at(
        self, triangle: NDArray[np.intp], p_WQ: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns colors (n, 3) and alphas (n,) of points (n, 3) on triangles (n,)."""
        weights = trimesh.triangles.points_to_barycentric(self.triangles[triangle], p_WQ)
        uv = (weights[..., None] * self.uv[triangle]).sum(axis=1)
        color, alpha = np.zeros((len(uv), 3)), np.zeros(len(uv))
        for i, material in enumerate(self.materials):
            own = self.material[triangle] == i
            color[own], alpha[own] = material.sample(uv[own])
        return color, alpha

    def sample(self, path: Path, density: float) -> NDArray[np.float64]:
        """Returns points (N, 3) [m] outside of holes; see `_sample_surface`."""
        points, triangle = _sample_surface(path, self.triangles, density)
        return points[self._sample_at(triangle, points)[1] > 0]

    def draw(
        self, frame: CaptureFrame, min_depth: float, lamps: Sequence[tuple[Sequence[float], float]]
    ) -> CaptureFrame:
        """Returns the frame with these surfaces drawn where nothing in it hides them.

        Depth is that of the first surface, opaque or not.

        Args:
            min_depth: [m], from which surfaces are visible.
            lamps: direction of the light, and its intensity.
        """
        height, width = frame.depth.shape
        # Rays have depth 1, so that distances along them are depths.
        rays = pixel_rays(frame.K, width, height).reshape(-1, 3)
        rays = rays @ frame.X_WC.rotation().matrix().T
        p_WC = frame.X_WC.translation()
        depth, color = frame.depth.reshape(-1).astype(np.float64), np.zeros((len(rays), 3))
        limit = depth.copy()
        behind, reached = np.ones(len(rays)), np.full(len(rays), min_depth)
        active = np.flatnonzero(limit > min_depth)
        while len(active):
            triangle = self._first_hit(p_WC + reached[active, None] * rays[active], rays[active])
            active, triangle = active[triangle >= 0], triangle[triangle >= 0]
            # Intersect again in double precision.
            normal, ray = self._normals[triangle], rays[active]
            slope = (ray * normal).sum(axis=1)
            offset = ((self.triangles[triangle, 0] - p_WC) * normal).sum(axis=1)
            z = np.maximum(offset / np.where(slope == 0, 1, slope), reached[active])
            seen = z < limit[active]
            active, triangle, z, ray = active[seen], triangle[seen], z[seen], ray[seen]
            albedo, alpha = self._sample_at(triangle, p_WC + z[:, None] * ray)
            facing = -np.sign(slope[seen])[:, None] * normal[seen]
            share = behind[active] * alpha
            color[active] += share[:, None] * _shade(albedo, facing, lamps)
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

    def _first_hit(self, origins: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray:
        """Returns the first triangle (n,) on each ray, -1 for none."""
        hits = self._scene.run(
            origins.astype(np.float32), rays.astype(np.float32), query="INTERSECT"
        )
        return np.asarray(hits, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """A mesh in two parts, either of which may be missing."""

    path: Path  # where it comes from
    solid: Path | None  # .gltf without holes
    triangles: NDArray[np.float64]  # (T, 3, 3) [m] of the same, corners in W
    cut_outs: CutOuts | None  # in W

    def sample(self, density: float) -> NDArray[np.float64]:
        """Returns points (N, 3) [m] on its surfaces in W, with a density [1/m^2]."""
        points = [_sample_surface(self.path, self.triangles, density)[0]]
        if self.cut_outs is not None:
            points.append(self.cut_outs.sample(self.path, density))
        return np.concatenate(points)


@contextmanager
def drawn_mesh(path: Path, up: str) -> Iterator[DrawnMesh]:
    """Opens a mesh for drawing.

    Args:
        path: .gltf, .glb or .obj.
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
    file = _read_gltf(path)
    _check_for_vtk(file.document)
    for i, content in enumerate(file.buffers):
        (folder / f"{i}.bin").write_bytes(content)
    given = file.document.get("materials", [])
    cut = {i: found for i in range(len(given)) if (found := _cut_material(file, i))}
    # A mask without a texture is visible or not as a whole.
    invisible = {
        i
        for i, material in enumerate(given)
        if material.get("alphaMode") == "MASK"
        and i not in cut
        and _base_color(material)[3] < material.get("alphaCutoff", _CUTOFF)
    }
    solid = _part(file, lambda i: i not in cut and i not in invisible)
    triangles, cut_outs, solid_file = np.zeros((0, 3, 3)), None, None
    if solid is not None:
        triangles, _, _ = _triangles(solid, folder, R_WM)
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
        solid_file = folder / "solid.gltf"
        solid_file.write_text(json.dumps(solid))
    rest = _part(file, lambda i: i in cut)
    if rest is not None:
        holed, uv, numbers = _triangles(rest, folder, R_WM)
        order = {number: i for i, number in enumerate(cut)}
        cut_outs = CutOuts(holed, uv, np.array([order[i] for i in numbers]), list(cut.values()))
    return DrawnMesh(path, solid_file, triangles, cut_outs)


@dataclass(frozen=True, eq=False)
class _Gltf:
    """A glTF document with its buffers."""

    folder: Path  # that URIs are relative to
    document: dict[str, Any]
    buffers: list[bytes]

    def image(self, number: int) -> Image.Image:
        """Returns an image, not yet decoded."""
        image = self.document["images"][number]
        if "bufferView" in image:
            view = self.document["bufferViews"][image["bufferView"]]
            start = view.get("byteOffset", 0)
            content = self.buffers[view["buffer"]][start : start + view["byteLength"]]
        else:
            content = _read_uri(self.folder, image["uri"])
        opened = Image.open(BytesIO(content))
        require_readable_size(self.folder, 4 * opened.width * opened.height)
        return opened


def _read_gltf(path: Path) -> _Gltf:
    require_readable_size(path, 4 * path.stat().st_size)
    content, binary = path.read_bytes(), b""
    if path.suffix == ".obj":
        scene: Any = trimesh.load(path, force="scene", process=False)
        for mesh in scene.geometry.values():
            # Its materials are not metallic, as glTF's are by default.
            mesh.visual = mesh.visual if mesh.visual.kind == "texture" else TextureVisuals()
            mesh.visual.material = mesh.visual.material.to_pbr()
            mesh.visual.material.metallicFactor, mesh.visual.material.roughnessFactor = 0.0, 1.0
        content = scene.export(file_type="glb")
    if content.startswith(b"glTF"):  # binary: a header, then the document and a buffer
        (size,) = struct.unpack_from("<I", content, 12)
        binary, content = content[28 + size :], content[20 : 20 + size]
    document = json.loads(content)
    buffers = [
        _read_uri(path.parent, buffer["uri"]) if "uri" in buffer else binary[: buffer["byteLength"]]
        for buffer in document["buffers"]
    ]
    return _Gltf(path.parent, document, buffers)


def _read_uri(folder: Path, uri: str) -> bytes:
    start, comma, data = uri.partition(",")
    if start.startswith("data:") and comma:
        return base64.b64decode(data, validate=True)
    file = folder / urllib.parse.unquote(uri)
    require_readable_size(file, file.stat().st_size)
    return file.read_bytes()


def _check_for_vtk(document: dict[str, Any]) -> None:
    """Refuses what ends the process in VTK: attributes of different lengths and loops of nodes."""
    accessors = document.get("accessors", [])
    if not all("bufferView" in each and "sparse" not in each for each in accessors):
        raise ValueError("an accessor without a buffer view")
    for mesh in document.get("meshes", []):
        for primitive in mesh["primitives"]:
            used = [accessors[number] for number in primitive["attributes"].values()]
            if len({accessor["count"] for accessor in used}) > 1:
                raise ValueError("attributes of different lengths")
    children = [node.get("children", []) for node in document.get("nodes", [])]
    listed = [child for each in children for child in each]
    reached = [i for i in range(len(children)) if i not in listed]
    if len(set(listed)) < len(listed):
        raise ValueError("a node in two others")
    for i in reached:
        reached.extend(children[i])
    if len(reached) < len(children):
        raise ValueError("a node in itself")


def _part(file: _Gltf, has: Callable[[int], bool]) -> dict[str, Any] | None:
    """Returns the document with only those primitives whose material is one of the part, -1 for
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


def _without_alpha(file: _Gltf, number: int) -> dict[str, Any]:
    """Returns an image that is embedded and opaque."""
    image = file.document["images"][number]
    opened = file.image(number)
    if not opened.has_transparency_data and "bufferView" in image:
        return image
    stream = BytesIO()
    opened.convert("RGB").save(stream, "PNG")
    return {"uri": data_uri("image/png", stream.getvalue())}


def _cut_material(file: _Gltf, number: int) -> CutMaterial | None:
    """Returns a material whose texture has holes, None for any other."""
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
        raise ValueError("the texture of a cut-out must use TEXCOORD_0")
    pixels = np.asarray(image.convert("RGBA"), dtype=np.float32) / 255
    pixels[..., :3] **= _GAMMA
    pixels *= np.asarray(_base_color(material), dtype=np.float32)
    pixels[..., :3] *= pixels[..., 3:]
    sampler = file.document.get("samplers", [{}])[texture.get("sampler", 0)]
    transform = texture_info.get("extensions", {}).get("KHR_texture_transform", {})
    cos, sin = np.cos(transform.get("rotation", 0.0)), np.sin(transform.get("rotation", 0.0))
    linear = np.array([[cos, -sin], [sin, cos]]) * transform.get("scale", [1.0, 1.0])
    return CutMaterial(
        pixels.astype(np.float32),
        np.column_stack([linear, transform.get("offset", [0.0, 0.0])]),
        wrap=[_WRAPS.get(sampler.get(key, 0), "repeat") for key in ("wrapS", "wrapT")],
        nearest=sampler.get("magFilter") == _NEAREST,
        cutoff=material.get("alphaCutoff", _CUTOFF) if mode == "MASK" else _VISIBLE,
        translucent=mode == "BLEND",
    )


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
    triangles, uv, material = [np.zeros((0, 3, 3))], [np.zeros((0, 3, 2))], [np.zeros(0, int)]
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
    corners = np.concatenate(triangles)
    if not len(corners):
        raise ValueError("it holds no triangles")
    if not (np.abs(corners) <= _MAX_POSITION).all():
        raise ValueError(f"positions must be finite and within {_MAX_POSITION:g} m")
    return corners, np.concatenate(uv), np.concatenate(material)
