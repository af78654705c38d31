"""Worlds as glTF files, for Drake's render engines and everything else that reads meshes."""

import json
from pathlib import Path
from typing import Any

import cv2

from splatpilot.diagrams.worlds.solids.solid import WorldSpec
from splatpilot.diagrams.worlds.solids.solid_mesh import Mesh, mesh_of, mesh_of_gaussians
from splatpilot.diagrams.worlds.solids.surfaces import merge
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.field_mesh import add_primitive, data_uri
from splatpilot.systems.common.files import written_atomically

_NEAREST, _LINEAR, _CLAMP = 9728, 9729, 33071


def write_gltf(spec: WorldSpec, path: Path, texel: float = 0.02) -> None:
    """Writes the world of a spec as one self-contained .gltf file.

    Its light is baked into the pictures, which are emitted as they are: an engine shows the same
    colors whatever lamps it has. The file is y-up, as glTF is: W's (x, y, z) is its (x, z, -y).
    Drake's render engines turn glTF's y up to z themselves: there it stands in W at the identity.

    Args:
        texel: [m], size of a pixel of the pictures on the solids.

    Raises:
        OSError: if the file cannot be written.
    """
    light = spec.light(esdf_from_distance_field(spec.distance_field, spec.voxel_size))
    meshes = mesh_of(spec, light, texel)
    surroundings = spec.surroundings()
    if surroundings:
        meshes.append(mesh_of_gaussians(merge(surroundings)))
    with written_atomically(path) as temporary:
        temporary.write_text(json.dumps(_document(meshes)))


def _document(meshes: list[Mesh]) -> dict[str, Any]:
    """The meshes as a glTF 2.0 document with everything embedded."""
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "splatpilot"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "samplers": [
            {"magFilter": f, "minFilter": f, "wrapS": _CLAMP, "wrapT": _CLAMP}
            for f in (_NEAREST, _LINEAR)
        ],
    }
    for name in (
        "nodes", "meshes", "materials", "textures", "images", "accessors", "bufferViews", "buffers"
    ):  # fmt: skip
        document[name] = []
    for k, mesh in enumerate(meshes):
        primitive = add_primitive(document, mesh.vertices, mesh.uv, mesh.triangles)
        document["nodes"].append({"mesh": k})
        document["meshes"].append({"primitives": [{**primitive, "material": k}]})
        document["materials"].append(
            {
                "pbrMetallicRoughness": {
                    "baseColorFactor": [0, 0, 0, 1],
                    "metallicFactor": 0,
                    "roughnessFactor": 1,
                },
                "emissiveFactor": [1, 1, 1],
                "emissiveTexture": {"index": k},
                "doubleSided": not mesh.smooth,
            }
        )
        document["textures"].append({"source": k, "sampler": int(mesh.smooth)})
        document["images"].append({"uri": _picture_uri(mesh)})
    return document


def _picture_uri(mesh: Mesh) -> str:
    """The picture as a data URI: JPEG, but PNG where pixels must not run into each other."""
    kind, options = ("jpeg", [cv2.IMWRITE_JPEG_QUALITY, 92]) if mesh.smooth else ("png", [])
    _, content = cv2.imencode(f".{kind}", mesh.picture[..., ::-1], options)
    return data_uri(f"image/{kind}", content.tobytes())
