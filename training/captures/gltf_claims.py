"""Whether a glTF file is as large as it claims, and its triangles are of vertices that it has.

Readers of meshes believe both: a count that is wrong makes them take all memory, and an index that
is wrong ends the process.
"""

from typing import Any

import numpy as np

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
