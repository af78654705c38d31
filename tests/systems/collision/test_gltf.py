"""Parts of glTF documents."""

import base64

import numpy as np
from pydrake.math import RotationMatrix

from splatpilot.systems.collision.field_mesh import add_primitive, data_uri, y_up

TYPES = {5126: "<f4", 5125: "<u4"}
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


def _read(document: dict, number: int) -> np.ndarray:
    """The array of an accessor, as the specification says."""
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    buffer = document["buffers"][view["buffer"]]
    content = base64.b64decode(buffer["uri"].split(",")[1])
    assert len(content) == buffer["byteLength"] == view["byteLength"]
    array = np.frombuffer(content, TYPES[accessor["componentType"]])
    return array.reshape(accessor["count"], COLUMNS[accessor["type"]])


def test_turned_by_a_right_angle_about_x_points_are_back():
    """Drake turns what a file says by 90 degrees about x: that undoes the change of axes."""
    p = np.random.default_rng(0).normal(size=(20, 3))
    back = RotationMatrix.MakeXRotation(np.pi / 2).multiply(y_up(p).T).T
    np.testing.assert_allclose(back, p, atol=1e-12)


def test_every_primitive_of_a_document_reads_as_written():
    """Two primitives in one document keep their own vertices, uv and triangles, with bounds."""
    rng, document, written = np.random.default_rng(0), {}, []
    for count in (4, 7):
        p, uv = rng.normal(size=(count, 3)), rng.uniform(size=(count, 2))
        triangles = rng.integers(0, count, (5, 3))
        written.append((p, uv, triangles, add_primitive(document, p, uv, triangles)))
    for p, uv, triangles, primitive in written:
        position = primitive["attributes"]["POSITION"]
        np.testing.assert_allclose(_read(document, position), y_up(p), atol=1e-6)
        np.testing.assert_allclose(_read(document, primitive["attributes"]["TEXCOORD_0"]), uv, 1e-6)
        np.testing.assert_array_equal(
            _read(document, primitive["indices"]).reshape(-1, 3), triangles
        )
        np.testing.assert_allclose(document["accessors"][position]["max"], y_up(p).max(0), 1e-6)


def test_data_uri_holds_its_content():
    """What stands after the comma decodes to the content; before it, the media type."""
    head, _, content = data_uri("image/png", b"\x00\xff splat").partition(",")
    assert head == "data:image/png;base64" and base64.b64decode(content) == b"\x00\xff splat"
