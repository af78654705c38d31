import json
import os
from base64 import b64decode
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from pydrake.math import RigidTransform

from splatpilot.diagrams.worlds.mesh import check_mesh, mesh_digests, mesh_distance
from splatpilot.diagrams.worlds.mesh_renderer import MeshRenderer, MeshScene
from splatpilot.diagrams.worlds.splits import find_test_source
from splatpilot.systems.collision.field_mesh import add_primitive, data_uri
from splatpilot.training.captures.coverage import look_along

K = np.array([[16.0, 0, 16], [0, 16, 12], [0, 0, 1]])
X_WC = look_along(np.zeros(3), 0.0, 0.0)  # along x
WALL, QUAD = 3.0, 2.0  # [m], along x
SKY = (0.0, 0.0, 1.0)
RED, GREEN = [0.8, 0.0, 0.0, 1.0], [0.0, 0.8, 0.0, 1.0]


def square(x: float, half: float, back: bool = False):
    p = np.array([[x, half, half], [x, -half, half], [x, -half, -half], [x, half, -half]])
    uv = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    triangles = np.array([[0, 3, 2], [0, 2, 1]])
    return p, uv, triangles[:, ::-1] if back else triangles


def encoded(image: Image.Image, kind: str = "PNG") -> str:
    stream = BytesIO()
    image.save(stream, kind)
    return data_uri(f"image/{kind.lower()}", stream.getvalue())


def png(alpha: np.ndarray, color: int = 255) -> str:
    pixels = np.full((*alpha.shape, 4), color, np.uint8)
    pixels[..., 3] = alpha
    return encoded(Image.fromarray(pixels))


@pytest.fixture
def scene(tmp_path):
    """Writes a scene, whose document `change` may change."""

    def scene(material: dict, picture="", back=False, binary=False, change=lambda document: None):
        document: dict = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0, 1]}]}
        base = {"metallicFactor": 0, "roughnessFactor": 1}
        wall = {"pbrMetallicRoughness": base | {"baseColorFactor": RED}, "doubleSided": True}
        pbr = base | material.get("pbrMetallicRoughness", {"baseColorFactor": GREEN})
        if picture:
            pbr["baseColorTexture"] = {"index": 0}
            document |= {"images": [{"uri": picture}], "textures": [{"source": 0}]}
        document["materials"] = [wall, material | {"pbrMetallicRoughness": pbr}]
        shapes = square(WALL, 4.0), square(QUAD, 1.0, back)
        document["meshes"] = [
            {"primitives": [{**add_primitive(document, *shape), "material": i}]}
            for i, shape in enumerate(shapes)
        ]
        document["nodes"] = [{"mesh": 0}, {"mesh": 1}]
        change(document)
        file = tmp_path / "scene.gltf"
        file.write_text(json.dumps(document))
        if binary:
            trimesh.load(file, force="scene").export(file.with_suffix(".glb"))
        return file.with_suffix(".glb") if binary else file

    return scene


def view(file, X_WC=X_WC, K=K, up="y", scale=1.0):
    return MeshRenderer(file, up, SKY, scale).render(X_WC, K, 32, 24)


HALVES = np.repeat(np.r_[np.zeros(16), np.full(16, 255)][None], 32, axis=0)  # right half opaque


def sides(frame):
    """Color, and depth [m], of the left and the right half."""
    reds, greens = (frame.color[12, [12, 19], channel].astype(int) for channel in (0, 1))
    colors = np.where(reds > 100, "red", np.where(greens > 100, "green", ""))
    assert (np.minimum(reds, greens) < 60).all()
    return list(zip(colors, frame.depth[12, [12, 19]], strict=True))


SURFACE, HOLE = ("green", pytest.approx(QUAD, abs=1e-4)), ("red", pytest.approx(WALL, abs=1e-4))


@pytest.mark.parametrize("mode", ["MASK", "BLEND"])
@pytest.mark.parametrize("binary", [False, True])
def test_holes_show_what_is_behind_in_color_and_depth(opengl, scene, mode, binary):
    frame = view(scene({"alphaMode": mode}, png(HALVES), binary=binary))
    assert sides(frame) == [HOLE, SURFACE]


MASKED = {"alphaMode": "MASK", "alphaCutoff": 0.5}
GLOWING = {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "emissiveFactor": [0, 0.9, 0]}


WHITE = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1]}}


def green(alpha: float) -> dict:
    return {"pbrMetallicRoughness": {"baseColorFactor": [0, 0.8, 0, alpha]}}


@pytest.mark.parametrize(
    ("material", "picture", "back", "expected"),
    [
        ({}, png(np.zeros((4, 4))), False, SURFACE),  # Alpha of opaque materials is ignored.
        ({"doubleSided": False}, png(HALVES), False, SURFACE),
        ({"doubleSided": False}, png(HALVES), True, SURFACE),
        (MASKED, png(np.full((4, 4), 127)), False, HOLE),
        (MASKED, png(np.full((4, 4), 128)), False, SURFACE),
        (MASKED | green(127 / 255), "", False, HOLE),
        (MASKED | green(128 / 255), "", False, SURFACE),
        (GLOWING, "", False, SURFACE),
        (MASKED, "no%20where.png", False, SURFACE),
    ],
)
def test_surfaces_are_visible_or_not(opengl, scene, caplog, material, picture, back, expected):
    assert sides(view(scene(material, picture, back))) == [expected, expected]
    missing = "cannot read the image no where.png" in caplog.text
    assert missing == (picture == "no%20where.png")


def test_panes_are_translucent_and_have_depth(opengl, scene):
    factor = view(scene({"alphaMode": "BLEND"} | green(0.5)))
    texture = view(scene({"alphaMode": "BLEND"}, png(np.full((4, 4), 128))))
    for frame in (factor, texture):
        assert (frame.color[12, [12, 19], :2] > 60).all()
        np.testing.assert_allclose(frame.depth[12, [12, 19]], QUAD, atol=1e-4)


@pytest.mark.parametrize(("mode", "expected"), [("MASK", 0.5), ("OPAQUE", 0.0)])
def test_holes_are_free(scene, mode, expected):
    esdf = mesh_distance(scene({"alphaMode": mode}, png(HALVES)), "y", 0.05)
    left, right = esdf.distance(np.array([[QUAD, 0.5, 0.0], [QUAD, -0.5, 0.0]]))
    assert left == pytest.approx(expected, abs=0.1) and right == pytest.approx(0, abs=0.1)


def test_nothing_is_cut_behind_what_is_opaque(opengl, scene):
    behind = look_along(np.array([6.0, 0, 0]), np.pi, 0.0)
    frame = view(scene({"alphaMode": "MASK"}, png(HALVES)), behind)
    assert [color for color, _ in sides(frame)] == ["red", "red"]
    np.testing.assert_allclose(frame.depth[12, 8:24], 6 - WALL, atol=1e-4)


def test_a_rolling_shutter_of_a_still_camera_changes_nothing(opengl, scene):
    seen = MeshScene(scene({}), "y", (0.5, 0.5, 0.5), 1.0)
    camera = np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]), 64, 48, RigidTransform()
    whole, rows = seen.render(*camera), seen.render(*camera, rows=(10, 30))
    for one, other in zip(rows, whole, strict=True):
        np.testing.assert_allclose(one, other[10:30], atol=1.1 / 255)


def test_holes_turn_with_the_texture(opengl, scene):
    def turn(document):
        info = document["materials"][1]["pbrMetallicRoughness"]["baseColorTexture"]
        transform = {"rotation": np.pi / 2, "offset": [0.0, 1.0], "scale": [1.0, 1.0]}
        info["extensions"] = {"KHR_texture_transform": transform}

    opaque = encoded(Image.fromarray(HALVES.astype(np.uint8)).convert("RGB"))
    shown = view(scene(WHITE, opaque, change=turn)).color[..., 1] > 100
    solid = np.abs(view(scene(MASKED, png(HALVES), change=turn)).depth - QUAD) < 0.01
    inside = (slice(9, 15), slice(13, 19))  # of the quad
    assert 0.2 < shown[inside].mean() < 0.8
    assert (shown[inside] == solid[inside]).mean() > 0.9


@pytest.mark.parametrize("uri", ["grün weiß.png", "gr%C3%BCn%20wei%C3%9F.png"])
def test_names_of_images_and_buffers_may_be_escaped(opengl, scene, tmp_path, uri):
    Image.new("RGB", (4, 4), "white").save(tmp_path / "grün weiß.png")

    def write_out(document):
        for number, buffer in enumerate(document["buffers"]):
            content = b64decode(buffer["uri"].partition(",")[2])
            (tmp_path / f"my café {number}.bin").write_bytes(content)
            buffer["uri"] = f"my%20caf%C3%A9%20{number}.bin"

    assert sides(view(scene({}, uri, change=write_out))) == [SURFACE, SURFACE]


@pytest.mark.parametrize(
    ("kind", "mode"), [("WEBP", "RGB"), ("PNG", "I;16"), ("PNG", "P"), ("JPEG", "RGB")]
)
def test_images_of_many_kinds(opengl, scene, kind, mode):
    image = Image.fromarray(np.full((8, 8), 101, np.uint8)).convert("RGB" if mode == "P" else "L")
    image = Image.fromarray(np.full((8, 8), 26000, np.uint16)) if mode == "I;16" else image
    pictures = png(np.full((4, 4), 255), 101), encoded(image.convert(mode), kind)
    expected, seen = (view(scene(WHITE, p)).color[12, 16].astype(int) for p in pictures)
    np.testing.assert_allclose(seen, expected, atol=2)


def test_white_that_faces_up_is_not_clipped(opengl, scene):
    up = {"mesh": 1, "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]}  # at y = 2 m, up in the file
    file = scene(WHITE, change=lambda document: document["nodes"].__setitem__(1, up))
    color = view(file, look_along(np.array([0, 0, 4.0]), 0.0, -np.pi / 2 + 1e-3)).color[12, 16]
    assert 230 < color.min() <= color.max() < 255


SECOND = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}}}


@pytest.mark.parametrize(
    ("key", "values", "message"),
    [
        ("nodes", {"scale": [1e3] * 3}, "longest side .* scale=0.01 if .* centimeters, or .*=0.00"),
        ("nodes", {"scale": [0.01] * 3}, "longest side must be in .* scale=1000 if .* kilometers"),
        ("extensionsRequired", ["KHR_mesh_quantization"], "without KHR_mesh_q.*form dequantize"),
        ("extensionsRequired", ["EXT_meshopt_compression"], "without EXT_meshopt_c.*; decompress"),
        ("accessors", {"componentType": 5123}, "TEXCOORD_0 must be 5126, .*5123.*form dequantize"),
        ("materials", SECOND, "texCoord of baseColorTexture must be 0, got 1"),
    ],
)
def test_meshes_that_cannot_be_worlds_are_refused(scene, key, values, message):
    def change(document):
        if isinstance(values, list):
            document[key] = values
        else:
            document[key] = [{**each, **values} for each in document[key]]

    file = scene({}, png(HALVES), change=change)
    with pytest.raises(ValueError, match=message):
        check_mesh(file)
        mesh_distance(file, "y", 0.1)


def test_scale_is_the_unit_of_the_file(opengl, scene):
    file = scene({})
    frame = view(file, scale=2.0)
    assert frame.depth[12, 16] == pytest.approx(2 * QUAD, abs=1e-3)
    esdf = mesh_distance(file, "y", 0.1, 2.0)
    assert esdf.distance(np.array([4.5, 0, 0])) == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("name", ["wall.glb", "wall.obj", "wall.GLB"])
def test_vertex_colors_are_rendered(opengl, tmp_path, name):
    p, _, triangles = square(WALL, 4.0)
    red = np.full((4, 4), [255, 0, 0, 255], np.uint8)
    trimesh.Trimesh(p, triangles, process=False, vertex_colors=red).export(tmp_path / name)
    up = "y" if name.lower().endswith("glb") else "z"
    assert sides(view(tmp_path / name, up=up)) == [HOLE, HOLE]


ROOM = np.array([6.0, 4.0, 3.0])  # [m]


@pytest.fixture
def room_mesh(tmp_path) -> Path:
    mesh = trimesh.creation.box(ROOM)
    mesh.invert()
    mesh.export(tmp_path / "room.obj", include_normals=True)
    return tmp_path / "room.obj"


def test_distance_to_a_mesh(room_mesh):
    esdf = mesh_distance(room_mesh, "z", 0.1)
    p_WQ = np.random.default_rng(0).uniform(-0.4, 0.4, (200, 3)) * ROOM
    truth = (ROOM / 2 - np.abs(p_WQ)).min(axis=1)
    assert np.abs(esdf.distance(p_WQ) - truth).max() < 0.03


@pytest.mark.parametrize("name", ["copy.glb", "copy.obj", "copy.ply"])
def test_mesh_digests_do_not_depend_on_the_file(room_mesh, tmp_path, name):
    mesh = trimesh.load(room_mesh, force="mesh")
    mesh.faces = mesh.faces[::-1, [1, 2, 0]]
    mesh.export(tmp_path / name)
    assert mesh_digests(tmp_path / name) == mesh_digests(room_mesh)
    mesh.apply_translation([0.01, 0, 0]).export(tmp_path / name)
    assert mesh_digests(tmp_path / name).isdisjoint(mesh_digests(room_mesh))


@pytest.mark.skipif("SPLATPILOT_DATA" not in os.environ, reason="SPLATPILOT_DATA is not set")
@pytest.mark.parametrize(
    ("file", "source"),
    [("warehouse.gltf", "warehouse"), ("edgar_mine.glb", "edgar_mine"), ("cave.glb", None)],
)
def test_real_meshes_are_those_of_the_table(file, source):
    mesh = Path(os.environ["SPLATPILOT_DATA"]) / "worlds" / file
    assert find_test_source(mesh_digests(mesh)) == source


def test_pixels_on_edges_have_mean_colors_but_depth_of_their_centers(opengl, scene):
    shifted = K.copy()
    shifted[0, 2] += 0.4  # the quad ends in the left half of a pixel
    frame = view(scene({}), K=shifted)
    quad, edge, wall = frame.color[12, 23:26].astype(float)
    assert sides(frame) == [SURFACE, SURFACE]
    assert edge == pytest.approx((quad + wall) / 2, abs=1)
    assert frame.depth[12, 24] == pytest.approx(WALL, abs=1e-4)
