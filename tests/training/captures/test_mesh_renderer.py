import json
import os
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from splatpilot.diagrams.worlds.splits import find_test_source
from splatpilot.systems.collision.field_mesh import add_primitive, data_uri
from splatpilot.training.captures.camera_path import look_along
from splatpilot.training.captures.mesh_renderer import MeshRenderer, mesh_digests, mesh_distance

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
    return MeshRenderer(file, "y", SKY).frame(X_WC, K, 32, 24)


HALVES = np.repeat(np.r_[np.zeros(16), np.full(16, 255)][None], 32, axis=0)  # right half opaque


def sides(frame):
    return [(frame.image[12, column].tolist(), frame.depth[12, column]) for column in (12, 19)]


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
    np.testing.assert_allclose(masked.image[12, 12:20].astype(int), opaque.image[12, 12:20], atol=4)
    np.testing.assert_allclose(masked.depth[12], opaque.depth[12], atol=1e-4)


@pytest.mark.parametrize(("mode", "expected"), [("MASK", 0.5), ("OPAQUE", 0.0)])
def test_holes_are_free(scene, mode, expected):
    esdf = mesh_distance(scene({"alphaMode": mode}, png(HALVES)), "y", 0.05)
    left, right = esdf.distance(np.array([[QUAD, 0.5, 0.0], [QUAD, -0.5, 0.0]]))
    assert left == pytest.approx(expected, abs=0.1) and right == pytest.approx(0, abs=0.1)


def test_nothing_is_cut_behind_what_is_opaque(opengl, scene):
    file = scene({"alphaMode": "MASK"}, png(HALVES))
    behind = look_along(np.array([6.0, 0, 0]), np.pi, 0.0)
    frame = MeshRenderer(file, "y", SKY).frame(behind, K, 32, 24)
    assert is_red(frame.image[12, 12]) and is_red(frame.image[12, 19])
    np.testing.assert_allclose(frame.depth[12, 8:24], 6 - WALL, atol=1e-4)


def test_missing_texture_is_named(scene):
    with pytest.raises(ValueError, match=r"scene\.gltf: not a readable mesh \(.*nowhere\.png"):
        mesh_distance(scene({"alphaMode": "MASK"}, "nowhere.png"), "y", 0.1)


@pytest.mark.parametrize("name", ["wall.glb", "wall.obj"])
def test_vertex_colors_are_rendered(opengl, tmp_path, name):
    p, _, triangles = square(WALL, 4.0)
    red = np.full((4, 4), [255, 0, 0, 255], np.uint8)
    trimesh.Trimesh(p, triangles, process=False, vertex_colors=red).export(tmp_path / name)
    up = "y" if name.endswith("glb") else "z"
    color = MeshRenderer(tmp_path / name, up, SKY).frame(X_WC, K, 32, 24).image[12, 16]
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
    assert np.abs(esdf.distance(p_WQ) - truth).max() < 0.15


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
