"""glTF documents with their buffers, from `.gltf`, `.glb` and, converted, `.obj` files."""

import base64
import binascii
import json
import struct
import urllib.parse
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals

from splatpilot.systems.read_limit import require_readable_size

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
