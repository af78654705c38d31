import json
import os
from base64 import b64decode
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from splatpilot.diagrams.worlds.mesh import mesh_digests, mesh_distance
from splatpilot.diagrams.worlds.mesh_renderer import MeshRenderer
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


def png(alpha: np.ndarray, color=(255, 255, 255)) -> str:
    pixels = np.dstack([np.full((*alpha.shape, 3), color, np.uint8), alpha.astype(np.uint8)])
    stream = BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return data_uri("image/png", stream.getvalue())


@pytest.fixture
def scene(tmp_path):
    def scene(material: dict, picture: str | None = None, back: bool = False, binary: bool = False):
        document: dict = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0, 1]}]}
        base = {"metallicFactor": 0, "roughnessFactor": 1}
        wall = {"pbrMetallicRoughness": base | {"baseColorFactor": RED}, "doubleSided": True}
        pbr = base | material.pop("pbrMetallicRoughness", {"baseColorFactor": GREEN})
        if picture:
            pbr["baseColorTexture"] = {"index": 0}
            document |= {"images": [{"uri": picture}], "textures": [{"source": 0}]}
        document["materials"] = [wall, material | {"pbrMetallicRoughness": pbr}]
        document["meshes"] = [
            {"primitives": [{**add_primitive(document, *shape), "material": i}]}
            for i, shape in enumerate((square(WALL, 4.0), square(QUAD, 1.0, back)))
        ]
        document["nodes"] = [{"mesh": 0}, {"mesh": 1}]
        file = tmp_path / "scene.gltf"
        file.write_text(json.dumps(document))
        if binary:
            trimesh.load(file, force="scene").export(file.with_suffix(".glb"))
        return file.with_suffix(".glb") if binary else file

    return scene


def view(file):
    return MeshRenderer(file, "y", SKY).render(X_WC, K, 32, 24)


HALVES = np.repeat(np.r_[np.zeros(16), np.full(16, 255)][None], 32, axis=0)  # right half opaque


def sides(frame):
    return [(frame.color[12, column].tolist(), frame.depth[12, column]) for column in (12, 19)]


def is_red(color) -> bool:
    return color[0] > 100 and color[1] < 60


def is_green(color) -> bool:
    return color[1] > 100 and color[0] < 60


@pytest.mark.parametrize("mode", ["MASK", "BLEND"])
@pytest.mark.parametrize("binary", [False, True])
def test_holes_show_what_is_behind_in_color_and_depth(opengl, scene, mode, binary):
    (left, hole), (right, surface) = sides(
        view(scene({"alphaMode": mode}, png(HALVES), binary=binary))
    )
    assert is_red(left) and hole == pytest.approx(WALL, abs=1e-4)
    assert is_green(right) and surface == pytest.approx(QUAD, abs=1e-4)


@pytest.mark.parametrize(("alpha", "visible"), [(127, False), (128, True)])
def test_masks_are_visible_or_not_by_their_cutoff(opengl, scene, alpha, visible):
    masked = {"alphaMode": "MASK", "alphaCutoff": 0.5}
    for material, picture in (
        (masked, png(np.full((4, 4), alpha))),
        (masked | {"pbrMetallicRoughness": {"baseColorFactor": [0, 0.8, 0, alpha / 255]}}, None),
    ):
        frame = view(scene(dict(material), picture))
        for color, depth in sides(frame):
            assert is_green(color) == visible and is_red(color) != visible
            assert depth == pytest.approx(QUAD if visible else WALL, abs=1e-4)


def test_alpha_of_opaque_materials_is_ignored(opengl, scene):
    for color, depth in sides(view(scene({}, png(np.zeros((4, 4)))))):
        assert is_green(color) and depth == pytest.approx(QUAD, abs=1e-4)


def test_panes_are_translucent_and_have_depth(opengl, scene):
    glass = {"baseColorFactor": [0.0, 0.8, 0.0, 0.5]}
    factor = view(scene({"alphaMode": "BLEND", "pbrMetallicRoughness": glass}))
    texture = view(scene({"alphaMode": "BLEND"}, png(np.full((4, 4), 128))))
    for frame in (factor, texture):
        for color, depth in sides(frame):
            assert color[0] > 60 and color[1] > 60
            assert depth == pytest.approx(QUAD, abs=1e-4)


@pytest.mark.parametrize("back", [False, True])
def test_faces_have_two_sides(opengl, scene, back):
    for color, depth in sides(view(scene({"doubleSided": False}, png(HALVES), back=back))):
        assert is_green(color) and depth == pytest.approx(QUAD, abs=1e-4)


def test_cut_out_looks_like_what_is_opaque(opengl, scene):
    opaque = view(scene({}, png(np.full((4, 4), 255))))
    masked = view(
        scene({"alphaMode": "MASK"}, png(np.r_[np.full((63, 64), 255), np.zeros((1, 64))]))
    )
    np.testing.assert_allclose(masked.color[12, 12:20].astype(int), opaque.color[12, 12:20], atol=4)
    np.testing.assert_allclose(masked.depth[12], opaque.depth[12], atol=1e-4)


@pytest.mark.parametrize(("mode", "expected"), [("MASK", 0.5), ("OPAQUE", 0.0)])
def test_holes_are_free(scene, mode, expected):
    esdf = mesh_distance(scene({"alphaMode": mode}, png(HALVES)), "y", 0.05)
    left, right = esdf.distance(np.array([[QUAD, 0.5, 0.0], [QUAD, -0.5, 0.0]]))
    assert left == pytest.approx(expected, abs=0.1) and right == pytest.approx(0, abs=0.1)


def test_nothing_is_cut_behind_what_is_opaque(opengl, scene):
    file = scene({"alphaMode": "MASK"}, png(HALVES))
    behind = look_along(np.array([6.0, 0, 0]), np.pi, 0.0)
    frame = MeshRenderer(file, "y", SKY).render(behind, K, 32, 24)
    assert is_red(frame.color[12, 12]) and is_red(frame.color[12, 19])
    np.testing.assert_allclose(frame.depth[12, 8:24], 6 - WALL, atol=1e-4)


def test_missing_image_is_named_and_drawn_without(opengl, scene, caplog):
    frame = view(scene({"alphaMode": "MASK"}, "no%20where.png"))
    assert "cannot read the image no where.png" in caplog.text
    for color, depth in sides(frame):
        assert is_green(color) and depth == pytest.approx(QUAD, abs=1e-4)


@pytest.mark.parametrize("uri", ["grün weiß.png", "gr%C3%BCn%20wei%C3%9F.png"])
def test_names_of_images_and_buffers_may_be_escaped(opengl, scene, tmp_path, uri):
    file = scene({}, uri)
    Image.new("RGB", (4, 4), "white").save(tmp_path / "grün weiß.png")
    document = json.loads(file.read_text())
    for number, buffer in enumerate(document["buffers"]):
        content = b64decode(buffer["uri"].partition(",")[2])
        (tmp_path / f"my café {number}.bin").write_bytes(content)
        buffer["uri"] = f"my%20caf%C3%A9%20{number}.bin"
    file.write_text(json.dumps(document))
    for color, _ in sides(view(file)):
        assert is_green(color)


def test_emissive_factor_without_texture_glows(opengl, scene):
    black = {"baseColorFactor": [0, 0, 0, 1]}
    material = {"pbrMetallicRoughness": black, "emissiveFactor": [0.0, 0.9, 0.0]}
    for color, _ in sides(view(scene(material))):
        assert is_green(color)


@pytest.mark.parametrize(
    ("kind", "mode"), [("WEBP", "RGB"), ("PNG", "I;16"), ("PNG", "P"), ("JPEG", "RGB")]
)
def test_images_of_many_kinds(opengl, scene, kind, mode):
    level = 26000 if mode == "I;16" else 101
    pixels = np.full((8, 8), level, np.uint16 if mode == "I;16" else np.uint8)
    stream = BytesIO()
    image = Image.fromarray(pixels)
    (image if mode == "I;16" else image.convert(mode)).save(stream, kind)
    uri = data_uri(f"image/{kind.lower()}", stream.getvalue())
    white = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1]}}
    expected = view(scene(dict(white), png(np.full((4, 4), 255), (101, 101, 101))))
    seen = view(scene(dict(white), uri))
    np.testing.assert_allclose(seen.color[12, 16].astype(int), expected.color[12, 16], atol=2)


def test_white_that_faces_up_is_not_clipped(opengl, scene):
    file = scene({"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1]}})
    # Turns the square from x = 2 m to y = 2 m, up in the file.
    document = json.loads(file.read_text())
    document["nodes"][1] = {"mesh": 1, "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]}
    file.write_text(json.dumps(document))
    below = MeshRenderer(file, "y", SKY).render(
        look_along(np.array([0, 0, 4.0]), 0.0, -np.pi / 2 + 1e-3), K, 32, 24
    )
    assert 230 < below.color[12, 16].min() <= below.color[12, 16].max() < 255


@pytest.mark.parametrize(
    ("scale", "remedy"),
    [
        (1000.0, "set scale=0.01 if it is in centimeters, or scale=0.001 if it is in millimeters"),
        (0.01, "set scale=1000 if it is in kilometers"),
    ],
)
def test_extent_of_no_environment_is_refused(scene, scale, remedy):
    file = scene({})
    document = json.loads(file.read_text())
    for node in document["nodes"]:
        node["scale"] = 3 * [scale]
    file.write_text(json.dumps(document))
    with pytest.raises(ValueError, match="the longest side must be in") as error:
        mesh_distance(file, "y", 0.1)
    assert remedy in str(error.value)


def test_scale_is_the_unit_of_the_file(opengl, scene):
    file = scene({})
    assert sides(MeshRenderer(file, "y", SKY, 2.0).render(X_WC, K, 32, 24))[0][1] == pytest.approx(
        2 * QUAD, abs=1e-3
    )
    esdf = mesh_distance(file, "y", 0.1, 2.0)
    assert esdf.distance(np.array([4.5, 0, 0])) == pytest.approx(0.5, abs=0.1)


def test_compressed_mesh_is_refused_with_a_remedy(scene):
    file = scene({})
    document = json.loads(file.read_text())
    document["extensionsRequired"] = ["EXT_meshopt_compression"]
    file.write_text(json.dumps(document))
    with pytest.raises(ValueError, match=r"without EXT_meshopt_compression, got .*; deco"):
        view(file)


@pytest.mark.parametrize("name", ["wall.glb", "wall.obj", "wall.GLB"])
def test_vertex_colors_are_rendered(opengl, tmp_path, name):
    p, _, triangles = square(WALL, 4.0)
    red = np.full((4, 4), [255, 0, 0, 255], np.uint8)
    trimesh.Trimesh(p, triangles, process=False, vertex_colors=red).export(tmp_path / name)
    up = "y" if name.lower().endswith("glb") else "z"
    color = MeshRenderer(tmp_path / name, up, SKY).render(X_WC, K, 32, 24).color[12, 16]
    assert is_red(color)


def test_texture_on_other_coordinates_is_refused(scene):
    file = scene({}, png(HALVES))
    document = json.loads(file.read_text())
    document["materials"][1]["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 1
    file.write_text(json.dumps(document))
    with pytest.raises(ValueError, match="texCoord of baseColorTexture must be 0, got 1"):
        mesh_distance(file, "y", 0.1)


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
    frame = MeshRenderer(scene({}), "y", SKY).render(X_WC, shifted, 32, 24)
    quad, edge, wall = frame.color[12, 23:26].astype(float)
    assert is_green(quad) and is_red(wall)
    assert edge == pytest.approx((quad + wall) / 2, abs=1)
    assert frame.depth[12, 24] == pytest.approx(WALL, abs=1e-4)
