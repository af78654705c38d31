"""The surface of a distance field as a mesh that bodies collide with."""

import base64
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import written_atomically

SUFFIXES = ".gltf", ".obj"
"""Kinds of files that are written."""

_MOVED = 0.1, 0.05
"""[voxels] by which a surface may move where triangles are merged: the first that folds none."""
_FOLD = np.deg2rad(170)
"""Between the normals of neighbors; where they are turned further Drake knows no distances."""
_LEAST = 0.1
"""[voxels] that a voxel's center counts as from a surface that is nearer: triangles of next to no
area fold, or tear the mesh."""


def field_mesh(esdf: Esdf, conservative: bool = False) -> trimesh.Trimesh:
    """
    Returns the surface at which a field's distance is 0, normals out of what is solid.

    The mesh is watertight: what is solid at the faces of the box ends there. Its surface is within
    half a voxel of the field's, with few triangles where that is flat. The same field gives the
    same mesh.

    Args:
        esdf: of a place.
        conservative: whether unknown space and all outside the box are solid too, as they are for
            vehicles: the mesh is then a shell around what is free, a voxel thick at the box's
            faces.

    Raises:
        ValueError: if there is no surface.
        ModuleNotFoundError: where what the extra `mesh` brings is not installed.
    """
    measure = import_extra("skimage.measure", "mesh")
    manifold = import_extra("manifold3d", "mesh")
    field = esdf.conservative() if conservative else esdf
    values = field.distances / np.float32(esdf.voxel_size)
    if conservative:  # A voxel beyond the box, where all is solid.
        values = _around(values, np.pad(values, 1, mode="edge") - np.float32(1.0))
    # Beyond that the same distances, and all free: what is solid ends halfway.
    values = _around(values, np.abs(np.pad(values, 1, mode="edge")))
    values = np.where(np.abs(values) < _LEAST, np.copysign(np.float32(_LEAST), values), values)
    if values.min() > 0.0:
        raise ValueError(
            "there is no surface in this field: nothing in it is solid; look at it with "
            "`splatpilot view`"
        )
    points, triangles, _, _ = measure.marching_cubes(values, 0.0, gradient_direction="descent")
    solid = manifold.Manifold(manifold.Mesh(points.astype(np.float32), triangles.astype(np.uint32)))
    if solid.status() != manifold.Error.NoError:
        raise ValueError(f"the field's surface is no closed mesh: {solid.status()}")
    first = 0.5 - (values.shape[0] - esdf.shape[0]) / 2  # [voxels] from the box's corner

    def as_mesh(solid: Any) -> trimesh.Trimesh:
        mesh = solid.to_mesh()
        points = mesh.vert_properties[:, :3].astype(float)
        p_WV = esdf.lower_W + esdf.voxel_size * (points + first)
        return trimesh.Trimesh(p_WV, mesh.tri_verts, process=False)

    choices = (solid.simplify(moved) for moved in _MOVED)
    smooth = filter(_is_smooth, map(as_mesh, choices))
    return next(smooth, None) or as_mesh(solid)


def _is_smooth(mesh: trimesh.Trimesh) -> bool:
    return mesh.face_adjacency_angles.max() < _FOLD


def _around(values: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Values within, a layer of others around them."""
    around[1:-1, 1:-1, 1:-1] = values
    return around


def require_mesh_name(path: Path) -> None:
    """Raises ValueError for a name of another kind of file than `SUFFIXES`."""
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: a mesh is written as {' or '.join(SUFFIXES)}; name it so")


def write_mesh(path: Path, mesh: trimesh.Trimesh) -> None:
    """
    Writes a mesh in world coordinates (z up), whole or not at all: as OBJ, which has them as they
    are, or as glTF, which is y up, in one file.

    Raises:
        ValueError: for a name of another kind.
        OSError: if it cannot be written.
    """
    require_mesh_name(path)
    if path.suffix.lower() == ".obj":
        data = trimesh.exchange.obj.export_obj(mesh, include_normals=True)  # pyright: ignore
        content = str(data).encode()
    else:
        x, y, z = mesh.vertices.T
        turned = trimesh.Trimesh(np.stack([x, z, -y], axis=1), mesh.faces, process=False)
        files = trimesh.exchange.gltf.export_gltf(  # pyright: ignore
            trimesh.Scene(turned), merge_buffers=True, embed_buffers=True
        )
        [content] = files.values()
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_atomically(path) as partial:
        partial.write_bytes(content)


# What glTF 2.0 documents that embed everything are put together from.
#
# glTF's y axis is up: its (x, y, z) is (x, -z, y) of a frame whose z axis is up.


_FLOAT, _UINT = 5126, 5125  # component types
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}


def y_up(p: np.ndarray) -> np.ndarray:
    """Points p (N, 3) of a frame whose z axis is up in glTF's axes, (N, 3)."""
    x, y, z = p.T
    return np.column_stack([x, z, -y])


def add_primitive(
    document: dict[str, Any], vertices: np.ndarray, uv: np.ndarray, triangles: np.ndarray
) -> dict[str, Any]:
    """Adds textured triangles to the accessors, views and buffers of a document.

    Args:
        vertices: (V, 3) [m], z up.
        uv: (V, 2) in [0, 1], from the upper left corner of the picture.
        triangles: (T, 3) int, counter-clockwise seen from outside.

    Returns:
        The primitive of a mesh, without a material.
    """
    return {
        "attributes": {
            "POSITION": _add_array(document, y_up(vertices).astype("<f4"), _VERTICES),
            "TEXCOORD_0": _add_array(document, uv.astype("<f4"), _VERTICES),
        },
        "indices": _add_array(document, triangles.astype("<u4").reshape(-1, 1), _INDICES),
    }


def _add_array(document: dict[str, Any], array: np.ndarray, target: int) -> int:
    """Adds the rows of an array (N, 1), (N, 2) or (N, 3); returns the number of the accessor."""
    for name in ("accessors", "bufferViews", "buffers"):
        document.setdefault(name, [])
    content, number = array.tobytes(), len(document["accessors"])
    uri = data_uri("application/octet-stream", content)
    document["buffers"].append({"byteLength": len(content), "uri": uri})
    document["bufferViews"].append({"buffer": number, "byteLength": len(content), "target": target})
    document["accessors"].append(
        {
            "bufferView": number,
            "componentType": _UINT if target == _INDICES else _FLOAT,
            "count": len(array),
            "type": _KINDS[array.shape[1]],
            "min": array.min(axis=0).tolist(),
            "max": array.max(axis=0).tolist(),
        }
    )
    return number


def data_uri(media_type: str, content: bytes) -> str:
    """`content` as a URI that holds it."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode()}"
