"""What glTF 2.0 documents that embed everything are put together from.

glTF's y axis is up: its (x, y, z) is (x, -z, y) of a frame whose z axis is up.
"""

import base64
from typing import Any

import numpy as np

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
