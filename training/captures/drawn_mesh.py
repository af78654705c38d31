"""Meshes as they are drawn: every face has two sides, and alpha is what glTF says that it is.

Drake draws all alpha as translucency, and its depth knows none. So what it is given has no alpha
but that of panes, whose depth is that of the pane; and surfaces whose textures cut holes are taken
out of it, for `CutOuts` to draw.
"""

import copy
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from splatpilot.systems.array_files import reason_of
from splatpilot.systems.gltf import data_uri
from splatpilot.training.captures.cut_outs import GAMMA, CutMaterial, CutOuts, sample_surface
from splatpilot.training.captures.gltf_claims import check_gltf_claims
from splatpilot.training.captures.gltf_files import GltfFile, read_gltf

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
