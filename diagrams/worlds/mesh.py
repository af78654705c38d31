"""Reads meshes: glTF, binary glTF, and Wavefront .obj with its materials.

Drake draws any alpha as translucent, and its depth ignores alpha. So `split` separates surfaces
with holes in their textures, which are drawn by ray casting, from the others.
"""

import json
import logging
import struct
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from pydrake.math import RotationMatrix
from scipy.ndimage import binary_dilation, map_coordinates
from scipy.spatial import KDTree
from trimesh.exchange.gltf import export_gltf
from trimesh.resolvers import FilePathResolver
from trimesh.visual import TextureVisuals
from trimesh.visual.color import uv_to_interpolated_color
from trimesh.visual.material import PBRMaterial

from splatpilot.diagrams.worlds.building_blocks import suitable_voxel
from splatpilot.diagrams.worlds.splits import part_digests
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf, distances_from_band
from splatpilot.systems.collision.esdf_build import grid_shape
from splatpilot.systems.common.readers import readable, require_file, require_readable_size
from splatpilot.systems.common.validation import require

SUFFIXES = (".gltf", ".glb", ".obj")
GAMMA = 2.2  # of textures and images, as in VTK
_MAX_POSITION = 1e6  # [m]
_EXTENTS = (1.0, 1000.0)  # [m], of the longest side of an environment
# Units [m] that a file may have instead, the likely ones first.
_UNITS = {"centimeters": 0.01, "millimeters": 0.001, "inches": 0.0254, "kilometers": 1000.0}
_CUTOFF = 0.5  # glTF's default alpha from which a MASK is opaque
_VISIBLE = 1 / 255  # alpha from which a BLEND is visible
_SAMPLES_PER_VOXEL_FACE = 8
_NEAREST = 9728
_WRAPS = {33071: "clamp", 33648: "mirror"}
_UV, _FLOAT = "TEXCOORD_0", 5126
# Required extensions that cannot be read, with a remedy each.
_UNREAD = {
    "EXT_meshopt_compression": "decompress it with `gltf-transform copy IN.glb OUT.glb`",
    "KHR_meshopt_compression": "decompress it with `gltf-transform copy IN.glb OUT.glb`",
    "KHR_draco_mesh_compression": "decompress it with `gltf-transform copy IN.glb OUT.glb`",
    "EXT_mesh_gpu_instancing": "write them out with `gltf-transform uninstance IN.glb OUT.glb`",
    "KHR_mesh_quantization": "convert it with `gltf-transform dequantize IN.glb OUT.glb`",
    "KHR_texture_basisu": "convert its textures with `gltf-transform png IN.glb OUT.glb`",
}
# R_WM, of the axes of a file M by the one that points up.
UP = {"y": RotationMatrix.MakeXRotation(np.pi / 2).matrix().round(), "z": np.eye(3)}

_log = logging.getLogger(__name__)


def check_mesh(mesh: Path) -> None:
    """Checks the file and the required extensions of a mesh."""
    require_file(mesh)
    suffix, known = mesh.suffix.lower(), f"one of {', '.join(SUFFIXES)}"
    require(suffix in SUFFIXES, f"{mesh}: the suffix", known, mesh.suffix)
    if suffix != ".obj":
        with readable(mesh, "mesh"):
            description = _description(mesh.read_bytes())
            required = description.get("extensionsRequired", [])
            parts = [part for each in description.get("meshes", []) for part in each["primitives"]]
            found = {part["attributes"].get(_UV) for part in parts} - {None}
            types = {description["accessors"][index]["componentType"] for index in found}
        for extension, remedy in _UNREAD.items():
            what, condition = f"{mesh}: extensionsRequired", f"without {extension}"
            require(extension not in required, what, condition, required, remedy)
        what, remedy = f"{mesh}: componentType of {_UV}", _UNREAD["KHR_mesh_quantization"]
        require(types <= {_FLOAT}, what, f"{_FLOAT}, of floats", sorted(types), remedy)


def mesh_digests(mesh: Path) -> set[str]:
    """Returns a digest of each triangle of a mesh, by its corners to a millimeter, independent of
    the file's format and materials."""
    with readable(mesh, "mesh"):
        surface: Any = trimesh.load(mesh, force="mesh", resolver=_Files(str(mesh)))
        if not 0 < surface.area < np.inf:
            raise ValueError("it has no surface")
    corners = np.round(surface.triangles * 1000).astype(np.int64)
    packed = corners @ np.array([1 << 42, 1 << 21, 1])  # (N, 3): one number per corner
    triangles = np.unique(np.sort(packed, axis=1), axis=0)
    return part_digests(triangle.tobytes() for triangle in triangles)


def mesh_distance(mesh: Path, up: str, voxel_size: float, scale: float = 1.0) -> Esdf:
    """Returns the distance to the surface of a mesh, from points sampled on it outside of holes.
    `scale` [m] is the unit of the file. A `voxel_size` of 0 is a suitable one."""
    surface, cut_outs = split(mesh, up, scale)
    if voxel_size == 0:
        p_WV = np.concatenate([surface.vertices, cut_outs.surface.vertices])
        voxel_size = suitable_voxel(p_WV.min(axis=0), p_WV.max(axis=0))
    density = _SAMPLES_PER_VOXEL_FACE / voxel_size**2
    points, triangle = _sample_surface(mesh, cut_outs.surface, density)
    points = points[cut_outs.sample_at(triangle, points)[1] > 0]
    p_WQ = np.concatenate([_sample_surface(mesh, surface, density)[0], points])
    with readable(mesh, "mesh"):
        if not len(p_WQ):
            raise ValueError("it has no surface")
        lower_W, upper_W = p_WQ.min(axis=0) - voxel_size, p_WQ.max(axis=0) + voxel_size
        grid_shape(lower_W, upper_W, voxel_size)
    shape = np.ceil((upper_W - lower_W) / voxel_size).astype(int)
    occupied = np.zeros(shape, dtype=bool)
    occupied[tuple(((p_WQ - lower_W) / voxel_size).astype(int).T)] = True
    # The exact distances next to occupied voxels continue into the rest.
    near = binary_dilation(occupied, np.ones((3, 3, 3), bool)) & ~occupied
    band = np.full(shape, np.nan, np.float32)
    centers = lower_W + (np.argwhere(near) + 0.5) * voxel_size
    band[near] = KDTree(p_WQ, balanced_tree=False).query(centers, workers=-1)[0]
    distances = distances_from_band(occupied, band, voxel_size)
    states = occupied.astype(np.uint8) * np.uint8(FieldState.OCCUPIED)
    return Esdf(distances, states, lower_W, voxel_size)


def sample_colors(
    path: Path, up: str, scale: float, count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
    """Samples the surface of a mesh without its holes: points [m] and normals (N, 3) in W, linear
    base colors (N, 3), and the area [m^2] that they stand for. N is at most about `count`."""
    surface, cut_outs = split(path, up, scale)
    area = surface.area + cut_outs.surface.area
    with readable(path, "mesh"):
        scene, _ = _read(path)
        R_WM, parts = UP[up], []
        for node in scene.graph.nodes_geometry:
            X_MN, name = scene.graph[node]
            mesh = scene.geometry[name]
            if not isinstance(mesh, trimesh.Trimesh) or not mesh.area > 0:
                continue
            placed = mesh.copy().apply_transform(X_MN)
            number = max(round(count * scale**2 * placed.area / area), 1)
            drawn: Any = trimesh.sample.sample_surface(
                placed, number, return_barycentric=True, seed=0
            )
            points, face, weights = drawn
            colors = _base_colors(mesh, face, weights)
            mode = getattr(getattr(mesh.visual, "material", None), "alphaMode", None)
            seen = (colors[:, 3] >= _CUTOFF) | (mode not in ("MASK", "BLEND"))
            normals = placed.face_normals[face] @ R_WM.T
            sampled = scale * points @ R_WM.T, normals, colors[:, :3]
            parts.append([each[seen] for each in sampled])
    points, normals, colors = (np.concatenate(each) for each in zip(*parts, strict=True))
    return points, normals, colors, area


def _base_colors(mesh: trimesh.Trimesh, face: NDArray, weights: NDArray) -> NDArray[np.float64]:
    """Returns linear colors (N, 4), 0 to 1, at barycentric coordinates (N, 3) of faces (N,)."""
    visual: Any = mesh.visual
    if not isinstance(visual, TextureVisuals):
        return _linear(visual.face_colors[face])
    material = visual.material
    factor = getattr(material, "baseColorFactor", None)  # linear, as in glTF
    factor = np.ones(4) if factor is None else np.asarray(factor) / 255.0
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or visual.uv is None:
        is_pbr = hasattr(material, "baseColorFactor")
        return np.tile(factor if is_pbr else _linear(material.main_color), (len(face), 1))
    uv = (weights[..., None] * visual.uv[mesh.faces[face]]).sum(axis=1)
    return _linear(uv_to_interpolated_color(uv, image)) * factor


def _linear(colors: NDArray) -> NDArray[np.float64]:
    """Returns linear colors and alphas (..., 4), 0 to 1, of those of images, 0 to 255."""
    return (np.asarray(colors) / 255.0) ** [GAMMA, GAMMA, GAMMA, 1.0]


def _sample_surface(
    path: Path, surface: trimesh.Trimesh, density: float
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Returns points (N, 3) [m] on a surface, with a density [1/m^2], and the triangle of each."""
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
    nearest: bool  # if texels are not interpolated
    cutoff: float  # alpha from which the surface exists
    translucent: bool  # or opaque

    def sample(self, uv: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns linear colors (n, 3) and alphas (n,), 0 in holes, at texture coordinates `uv` (n,
        2) as in glTF, from the upper left corner."""
        size = self.pixels.shape[1::-1]
        position = (uv @ self.transform[:, :2].T + self.transform[:, 2]) * size - 0.5
        for x, n, wrap in zip(position.T, size, self.wrap, strict=True):
            if wrap == "mirror":
                x[:] = n - 0.5 - np.abs((x + 0.5) % (2 * n) - n)
            if wrap != "repeat":
                np.clip(x, 0, n - 1, out=x)
        order = 0 if self.nearest else 1
        channels = np.moveaxis(self.pixels, -1, 0)
        texel = np.column_stack(
            [
                map_coordinates(each, position.T[::-1], order=order, mode="grid-wrap")
                for each in channels
            ]
        ).astype(np.float64)
        alpha = texel[:, 3]
        color = texel[:, :3] / np.maximum(alpha, 1e-6)[:, None]
        return color, np.where(alpha >= self.cutoff, alpha if self.translucent else 1.0, 0.0)


@dataclass(frozen=True, eq=False)
class CutOuts:
    """Triangles with holes."""

    surface: trimesh.Trimesh  # T triangles [m], in W
    uv: NDArray[np.float64]  # (T, 3, 2)
    material: NDArray[np.intp]  # (T,)
    materials: Sequence[CutMaterial]

    def sample_at(
        self, triangle: NDArray[np.intp], p_WQ: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns colors (n, 3) and alphas (n,) of points (n, 3) on triangles (n,)."""
        weights = trimesh.triangles.points_to_barycentric(self.surface.triangles[triangle], p_WQ)
        uv = (weights[..., None] * self.uv[triangle]).sum(axis=1)
        color, alpha = np.zeros((len(uv), 3)), np.zeros(len(uv))
        for i, material in enumerate(self.materials):
            own = self.material[triangle] == i
            color[own], alpha[own] = material.sample(uv[own])
        return color, alpha


def split(
    path: Path, up: str, scale: float = 1.0, solid_file: Path | None = None
) -> tuple[trimesh.Trimesh, CutOuts]:
    """Returns the surfaces without and with holes, in W; writes those without, if any, to a .gltf
    file for Drake, in units of the file, `scale` [m]."""
    R_WM = scale * UP[up]
    with readable(path, "mesh"):
        scene, document = _read(path)
        materials = document.get("materials", [])
        cut_materials: dict[int, CutMaterial | None] = {}
        solid, cut = [], {}
        primitives = [p for mesh in document.get("meshes", []) for p in mesh["primitives"]]
        for primitive, (name, mesh) in zip(primitives, scene.geometry.items(), strict=True):
            if not isinstance(mesh, trimesh.Trimesh):
                continue
            number, visual = primitive.get("material", -1), cast(Any, mesh.visual)
            if number < 0:
                mesh.visual = _with_material(visual, PBRMaterial(doubleSided=True))
                solid.append(name)
                continue
            material = materials[number]
            if number not in cut_materials:
                cut_materials[number] = _cut_material(path, document, material, visual.material)
            if cut_materials[number] is not None:
                cut[name] = number
            # A mask without a texture is visible or not as a whole.
            elif material.get("alphaMode") != "MASK" or (
                _base_color(material)[3] >= material.get("alphaCutoff", _CUTOFF)
            ):
                visual.material = _opaque(visual.material, number)
                if visual.uv is None and visual.material.emissiveTexture is not None:
                    visual.uv = np.zeros((len(mesh.vertices), 2))
                solid.append(name)
        surface, _, _ = _surface(scene, solid, R_WM)
        holed, uv, names = _surface(scene, cut, R_WM)
        order = sorted(set(cut.values()))
        found = [each for number in order if (each := cut_materials[number]) is not None]
        material = np.array([order.index(cut[name]) for name in names], dtype=np.intp)
        if not solid and not cut:
            raise ValueError("it holds no triangles")
    _check_extent(path, np.concatenate([surface.vertices, holed.vertices]))
    if solid and solid_file is not None:
        with readable(path, "mesh"):
            scene.delete_geometry([name for name in scene.geometry if name not in solid])
            files = export_gltf(
                scene, merge_buffers=True, tree_postprocessor=lambda tree: _restore(tree, document)
            )
            for name, content in files.items():
                solid_file.with_name(name).write_bytes(content)
    return surface, CutOuts(holed, uv, material, found)


def _check_extent(path: Path, p_WQ: NDArray[np.float64]) -> None:
    """Checks that surfaces have the size of an environment; suggests another unit if not."""
    extent = np.ptp(p_WQ, axis=0) if len(p_WQ) else np.zeros(3)
    low, high = _EXTENTS
    fitting = [
        f"scale={unit:g} if it is in {name}"
        for name, unit in _UNITS.items()
        if 2 * low <= unit * extent.max() <= high / 2
    ]
    size = " x ".join(f"{length:.3g}" for length in extent)
    require(
        low <= extent.max() <= high,
        f"{path}: the longest side",
        f"in [{low:g}, {high:g}] m",
        f"{size} m",
        f"set {', or '.join(fitting)}" if fitting else "set scale to its unit in m",
    )


def _read(path: Path) -> tuple[Any, dict[str, Any]]:
    """Returns a mesh, and its description in glTF, whose primitives are in the mesh's order."""
    require_readable_size(path, 4 * path.stat().st_size)
    content, kind = path.read_bytes(), path.suffix.lower().lstrip(".")
    scene: Any = trimesh.load(
        BytesIO(content), file_type=kind, resolver=_Files(str(path)), force="scene", process=False
    )
    if kind == "obj":
        for mesh in scene.geometry.values():
            # Its materials are not metallic, as glTF's are by default.
            if mesh.visual.kind != "texture":
                mesh.visual = _with_material(mesh.visual)
            mesh.visual.material = mesh.visual.material.to_pbr()
            mesh.visual.material.metallicFactor, mesh.visual.material.roughnessFactor = 0.0, 1.0
        content = scene.export(file_type="glb")
        scene = trimesh.load(BytesIO(content), file_type="glb", force="scene", process=False)
    return scene, _description(content)


class _Files(FilePathResolver):
    """Files beside a mesh, whose names in glTF may be escaped."""

    def get(self, name: str) -> bytes:
        try:
            return super().get(name)
        except OSError:
            return super().get(unquote(name).replace("\\", "/"))


def _description(content: bytes) -> dict[str, Any]:
    """Returns the JSON of a glTF."""
    if content.startswith(b"glTF"):  # binary: a header, then the description
        (size,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + size]
    return json.loads(content)


def _with_material(visual: Any, material: PBRMaterial | None = None) -> TextureVisuals:
    """Returns a material, trimesh's default if None, with the vertex colors of `visual`."""
    textured = TextureVisuals(material=material)
    if visual.kind == "vertex":
        textured.vertex_attributes["color"] = visual.vertex_colors
    return textured


def _base_color(material: dict[str, Any]) -> list[float]:
    return material.get("pbrMetallicRoughness", {}).get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])


def _opaque(material: PBRMaterial, number: int) -> PBRMaterial:
    """Returns a material, named by its number, without alpha in its textures."""
    opaque = material.copy()
    opaque.name, opaque.alphaMode, opaque.doubleSided = str(number), None, True
    for key in ("baseColorTexture", "emissiveTexture", "occlusionTexture"):
        if (image := getattr(opaque, key)) is not None:
            if image.mode.startswith("I"):  # 16-bit grays, which Pillow would clip
                image = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
            converted = image.convert("RGB")
            converted.encoderinfo = {"compress_level": 0}  # Compression takes most of the export.
            setattr(opaque, key, converted)
    if opaque.emissiveTexture is None and np.any(opaque.emissiveFactor):
        opaque.emissiveTexture = Image.new("RGB", (1, 1), "white")  # VTK needs one.
    return opaque


def _restore(tree: dict[str, Any], document: dict[str, Any]) -> None:
    """Restores what trimesh does not keep of the materials of `document`: colors finer than 8 bits,
    samplers and transforms of textures, and the translucence of panes."""
    tree["samplers"] = document.get("samplers", [])
    for exported in tree.get("materials", []):
        if "name" not in exported:
            continue
        material = document["materials"][int(exported["name"])]
        color = _base_color(material)
        pbr = exported.setdefault("pbrMetallicRoughness", {})
        if material.get("alphaMode") == "BLEND":
            exported["alphaMode"], pbr["baseColorFactor"] = "BLEND", color
        else:
            pbr["baseColorFactor"] = [*color[:3], 1.0]
        originals = {**material, **material.get("pbrMetallicRoughness", {})}
        for key, info in [*exported.items(), *pbr.items()]:
            if key in originals and key.endswith("Texture"):
                texture = document["textures"][originals[key]["index"]]
                sampler = {"sampler": texture["sampler"]} if "sampler" in texture else {}
                tree["textures"][info["index"]].update(sampler)
                info.update(originals[key] | {"index": info["index"]})
    if not tree["samplers"]:
        del tree["samplers"]


def _cut_material(
    path: Path, document: dict[str, Any], material: dict[str, Any], read: PBRMaterial
) -> CutMaterial | None:
    """Returns a material whose texture has holes, None for any other."""
    pbr, mode = material.get("pbrMetallicRoughness", {}), material.get("alphaMode", "OPAQUE")
    for key, info in [*material.items(), *pbr.items()]:
        if not key.endswith("Texture"):
            continue
        if getattr(read, key, None) is None:
            texture = document["textures"][info["index"]]
            image = document["images"][texture["source"]] if "source" in texture else {}
            name = unquote(image.get("uri", image.get("name", f"of {texture}")))[:80]
            _log.warning("%s: cannot read the image %s; drawing its surfaces without", path, name)
        # trimesh reads no other.
        require(info.get("texCoord", 0) == 0, f"texCoord of {key}", "0", info.get("texCoord"))
    info, image = pbr.get("baseColorTexture", {}), read.baseColorTexture
    if mode == "OPAQUE" or image is None or not image.has_transparency_data:
        return None
    pixels = np.asarray(image.convert("RGBA"), dtype=np.float32) / 255
    pixels[..., :3] **= GAMMA
    pixels *= np.asarray(_base_color(material), dtype=np.float32)
    pixels[..., :3] *= pixels[..., 3:]
    texture = document["textures"][info["index"]]
    sampler = document["samplers"][texture["sampler"]] if "sampler" in texture else {}
    transform = info.get("extensions", {}).get("KHR_texture_transform", {})
    cos, sin = np.cos(transform.get("rotation", 0.0)), np.sin(transform.get("rotation", 0.0))
    linear = np.array([[cos, sin], [-sin, cos]]) * transform.get("scale", [1.0, 1.0])
    return CutMaterial(
        pixels.astype(np.float32),
        np.column_stack([linear, transform.get("offset", [0.0, 0.0])]),
        wrap=[_WRAPS.get(sampler.get(key, 0), "repeat") for key in ("wrapS", "wrapT")],
        nearest=sampler.get("magFilter") == _NEAREST,
        cutoff=material.get("alphaCutoff", _CUTOFF) if mode == "MASK" else _VISIBLE,
        translucent=mode == "BLEND",
    )


def _surface(
    scene: Any, names: Collection[str], R_WM: NDArray[np.float64]
) -> tuple[trimesh.Trimesh, NDArray[np.float64], list[str]]:
    """Returns the T triangles in W of geometries by name, their texture coordinates (T, 3, 2), 0
    without any, and the name of each."""
    corners, uv, found = [np.zeros((0, 3, 3))], [np.zeros((0, 3, 2))], []
    for node in scene.graph.nodes_geometry:
        X_MN, name = scene.graph[node]
        if name not in names:
            continue
        mesh = scene.geometry[name]
        corners.append((trimesh.transform_points(mesh.vertices, X_MN) @ R_WM.T)[mesh.faces])
        own = getattr(mesh.visual, "uv", None)
        own = np.zeros((len(mesh.vertices), 2)) if own is None else own * [1, -1] + [0, 1]
        uv.append(own[mesh.faces])
        found += len(mesh.faces) * [name]
    p_WQ = np.concatenate(corners).reshape(-1, 3)
    if not (np.abs(p_WQ) <= _MAX_POSITION).all():
        raise ValueError(f"positions must be finite and within {_MAX_POSITION:g} m")
    faces = np.arange(len(p_WQ)).reshape(-1, 3)
    return trimesh.Trimesh(p_WQ, faces, process=False), np.concatenate(uv), found
