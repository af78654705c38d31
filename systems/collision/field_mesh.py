"""The surface of a distance field as a collision mesh, and meshes as glTF and OBJ files."""

import base64
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.validation import require

if TYPE_CHECKING:
    import trimesh  # takes a third of the time of all imports of a flight

SUFFIXES = ".gltf", ".obj"

# [voxels] by which a surface may move where triangles are merged: the first without folds
_SHIFTS = 0.1, 0.05
# [rad] Largest angle between the normals of neighbors for which Drake computes distances
_FOLD = np.deg2rad(170)
_MIN_DISTANCE = 0.1  # [voxels] Minimum distance of voxel centers: slivers fold, or tear the mesh


def field_mesh(esdf: Esdf, conservative: bool = False) -> "trimesh.Trimesh":
    """Returns the surface at which a field's distance is 0, watertight, normals outwards.

    It is within half a voxel of the field's, with few triangles where that is flat. Solids end at
    the faces of the box; if `conservative`, unknown space and all outside the box are solid too: a
    shell around free space, a voxel thick at the box's faces.
    """
    import trimesh

    measure = import_extra("skimage.measure", "mesh")
    manifold = import_extra("manifold3d", "mesh")
    field = esdf.conservative() if conservative else esdf
    values = field.distances / np.float32(esdf.voxel_size)
    if conservative:  # a layer of solid voxels around the box
        values = _surround(values, np.pad(values, 1, mode="edge") - np.float32(1.0))
    # A layer of free voxels, so that solids end halfway.
    values = _surround(values, np.abs(np.pad(values, 1, mode="edge")))
    smallest = np.copysign(np.float32(_MIN_DISTANCE), values)
    values = np.where(np.abs(values) < _MIN_DISTANCE, smallest, values)
    if values.min() > 0.0:
        raise ValueError(
            "there is no surface in this field: no voxel is solid; see `splatpilot view`"
        )
    points, triangles, _, _ = measure.marching_cubes(values, 0.0, gradient_direction="descent")
    solid = manifold.Manifold(manifold.Mesh(points.astype(np.float32), triangles.astype(np.uint32)))
    require(solid.status() == manifold.Error.NoError, "surface", "closed", solid.status())
    first = 0.5 - (values.shape[0] - esdf.shape[0]) / 2  # [voxels] from the box's corner

    def as_mesh(solid: Any) -> "trimesh.Trimesh":
        mesh = solid.to_mesh()
        points = mesh.vert_properties[:, :3].astype(float)
        p_WV = esdf.lower_W + esdf.voxel_size * (points + first)
        return trimesh.Trimesh(p_WV, mesh.tri_verts, process=False)

    meshes = (as_mesh(solid.simplify(shift)) for shift in _SHIFTS)
    smooth = (mesh for mesh in meshes if mesh.face_adjacency_angles.max() < _FOLD)
    return next(smooth, None) or as_mesh(solid)


def _surround(values: np.ndarray, layer: np.ndarray) -> np.ndarray:
    layer[1:-1, 1:-1, 1:-1] = values
    return layer


def require_mesh_name(path: Path) -> None:
    """Checks the suffix of a mesh file."""
    suffix = path.suffix.lower()
    require(suffix in SUFFIXES, f"{path}: suffix", " or ".join(SUFFIXES), suffix or "none")


def write_mesh(path: Path, mesh: "trimesh.Trimesh") -> None:
    """Writes a mesh in world coordinates (z up) atomically: as OBJ, or as glTF (y up)."""
    import trimesh

    require_mesh_name(path)
    if path.suffix.lower() == ".obj":
        data = trimesh.exchange.obj.export_obj(mesh, include_normals=True)  # pyright: ignore
        content = str(data).encode()
    else:
        rotated = trimesh.Trimesh(y_up(mesh.vertices), mesh.faces, process=False)
        files = trimesh.exchange.gltf.export_gltf(  # pyright: ignore
            trimesh.Scene(rotated), merge_buffers=True, embed_buffers=True
        )
        [content] = files.values()
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_atomically(path) as partial:
        partial.write_bytes(content)


def y_up(p: np.ndarray) -> np.ndarray:
    """Converts points (N, 3) of a frame with z up to glTF's frame with y up."""
    x, y, z = p.T
    return np.column_stack([x, z, -y])


_FLOAT, _UINT = 5126, 5125  # component types of glTF 2.0
_VERTICES, _INDICES = 34962, 34963  # targets of its buffer views


def add_primitive(
    document: dict[str, Any], vertices: np.ndarray, uv: np.ndarray, triangles: np.ndarray
) -> dict[str, Any]:
    """Adds textured triangles to a glTF document; returns their primitive, without a material.

    Vertices (V, 3) [m] are z up, uv (V, 2) in [0, 1] from the picture's upper left corner.
    """
    return {
        "attributes": {
            "POSITION": _add_array(document, y_up(vertices).astype("<f4"), _VERTICES),
            "TEXCOORD_0": _add_array(document, uv.astype("<f4"), _VERTICES),
        },
        "indices": _add_array(document, triangles.astype("<u4").reshape(-1, 1), _INDICES),
    }


def _add_array(document: dict[str, Any], array: np.ndarray, target: int) -> int:
    """Adds the rows of an array (N, 1), (N, 2) or (N, 3); returns the index of the accessor."""
    accessors = document.setdefault("accessors", [])
    content, index = array.tobytes(), len(accessors)
    uri = data_uri("application/octet-stream", content)
    document.setdefault("buffers", []).append({"byteLength": len(content), "uri": uri})
    view = {"buffer": index, "byteLength": len(content), "target": target}
    document.setdefault("bufferViews", []).append(view)
    accessors.append(
        {
            "bufferView": index,
            "componentType": _UINT if target == _INDICES else _FLOAT,
            "count": len(array),
            "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3"}[array.shape[1]],
            "min": array.min(axis=0).tolist(),
            "max": array.max(axis=0).tolist(),
        }
    )
    return index


def data_uri(media_type: str, content: bytes) -> str:
    """Returns a URI that contains `content`."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode()}"
