import pickle

import numpy as np
import pytest
import trimesh
from PIL import Image
from pydrake.math import RigidTransform
from trimesh.visual.material import PBRMaterial

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.monitor import Outcome
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.simulation import fly
from splatpilot.diagrams.worlds.file_worlds import MeshWorld
from splatpilot.diagrams.worlds.mesh import sample_colors
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.splats.lens import Distortion
from splatpilot.training.captures.coverage import look_along

SIZE = np.array([14.0, 8.0, 4.0])  # [m] of a room on the ground, with a pillar in its middle
K = np.array([[32.0, 0, 32], [0, 32, 24], [0, 0, 1]])


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    walls = trimesh.creation.box(SIZE, RigidTransform([0, 0, SIZE[2] / 2]).GetAsMatrix4())
    walls.invert()
    pillar = trimesh.creation.box([0.6, 0.6, SIZE[2]], walls.bounding_box.primitive.transform)
    for mesh, color in ((walls, [200, 200, 190, 255]), (pillar, [190, 60, 40, 255])):
        colors = np.tile(np.uint8(color), (len(mesh.vertices), 1))
        mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=colors)
    path = tmp_path_factory.mktemp("room") / "room.glb"
    trimesh.Scene([walls, pillar]).export(path)
    return path


@pytest.fixture(scope="module")
def world(room):
    return make_world(MeshWorld(path=str(room), up="z"), 0)


def test_viewers_show_the_colors_of_textures(tmp_path):
    image = Image.fromarray(np.array([[[200, 0, 0], [0, 0, 200]]], np.uint8).repeat(4, axis=1))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    floor = trimesh.Trimesh([[0, 0, 0], [8, 0, 0], [8, 6, 0], [0, 6, 0]], [[0, 1, 2], [0, 2, 3]])
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    floor.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    trimesh.Scene([floor]).export(tmp_path / "floor.glb")
    points, _, colors, area = sample_colors(tmp_path / "floor.glb", "z", 1.0, 500)
    assert area == pytest.approx(48.0)
    red, blue = points[:, 0] < 3.0, points[:, 0] > 5.0
    assert (colors[red, 0] > 0.4).all() and (colors[red, 2] < 0.01).all()
    assert (colors[blue, 2] > 0.4).all() and (colors[blue, 0] < 0.01).all()


def test_factors_of_materials_are_linear_and_textures_are_not(tmp_path):
    box = trimesh.creation.box([1.0, 1.0, 1.0])
    picture = Image.new("RGB", (2, 2), (128, 128, 128))
    for texture, expected in ((None, 0.5), (picture, 0.5 * (128 / 255) ** 2.2)):
        material = PBRMaterial(baseColorFactor=[0.5, 0.5, 0.5, 1.0], baseColorTexture=texture)
        box.visual = trimesh.visual.TextureVisuals(np.zeros((8, 2)), material=material)
        path = tmp_path / "box.glb"
        trimesh.Scene([box]).export(path)
        _, _, colors, _ = sample_colors(path, "z", 1.0, 100)
        np.testing.assert_allclose(colors, expected, atol=0.01)


def test_camera_shows_the_mesh_also_through_a_lens(opengl, world):
    X_WC = look_along(np.array([-4.0, 0, 2.0]), 0.0, 0.0)
    view = world.baked.render(K, 64, 48, X_WC)
    assert view.depth[24, 32] == pytest.approx(3.7, abs=1e-3)
    assert view.depth[24, 2] == pytest.approx(4.0 / (29.5 / 32), rel=1e-3)
    assert view.color[24, 32, 0] > 2 * view.color[24, 32, 2]
    depth = world.baked.render_depth(K, 64, 48, X_WC, max_depth=5.0)
    np.testing.assert_array_equal(depth, np.where(view.depth <= 5, view.depth, 0))
    bent = world.baked.render(K, 64, 48, X_WC, distortion=Distortion(radial=[-0.1, 0.0]))
    assert bent.depth.shape == (48, 64)
    assert bent.depth[24, 32] == pytest.approx(view.depth[24, 32], abs=1e-3)
    # Barrel distortion shows more of the side walls: they are nearer at the border.
    assert bent.depth[24, 0] < view.depth[24, 0] - 0.1


def test_world_pickles_by_its_configuration(world):
    assert pickle.loads(pickle.dumps(world)) == world


@pytest.mark.parametrize("policy", ["planner", "diffaero"])
def test_policies_fly_in_a_mesh(opengl, world, policy):
    ends = {"start": [-3.0, -1.0, 2.0], "goal": [3.0, 1.0, 2.0]}
    scenario = Scenario(policy=policy_named(policy), **ends)
    flight = fly(BuildFlightDiagram(scenario, world, camera=False))
    assert flight.outcome is Outcome.GOAL
    assert flight.clearances.min() > 0


def test_textures_are_not_randomized(world):
    with pytest.raises(ValueError, match="appearance must be 0 in a mesh"):
        world.recolored(world.gaussians, world.background)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"path": ""}, "path must be a mesh"),
        ({"path": "no.glb"}, "No such file or folder: no.glb; expected a mesh"),
        ({"up": "x"}, r"up must be in \{y, z\}, got x"),
    ],
)
def test_bad_input_is_named(room, fields, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        make_world(MeshWorld(**{"path": str(room), "up": "z"} | fields), 0)


def test_ends_lie_above_open_terrain(opengl, tmp_path):
    x, y = (each.ravel() for each in np.meshgrid(*[np.linspace(-10.0, 10.0, 21)] * 2))
    corners = np.column_stack([x, y, 4.0 * (1.0 - np.abs(y) / 10.0)])
    first = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel()
    faces = np.concatenate([first[:, None] + [0, 1, 22], first[:, None] + [0, 22, 21]])
    trimesh.Scene([trimesh.Trimesh(corners, faces)]).export(tmp_path / "ridge.glb")
    fields = {"path": str(tmp_path / "ridge.glb"), "up": "z", "voxel_size": 0.25}
    for seed in range(3):
        world = make_world(MeshWorld(**fields, draw_ends=seed > 0), seed)
        for end in (world.p_WS, world.p_WG):
            assert end[2] > 4.0 * (1.0 - abs(end[1]) / 10.0)
