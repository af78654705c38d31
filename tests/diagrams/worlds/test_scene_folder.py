from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.monitor import Outcome, flight_outcome
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds import scene_folder
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.depth_fusion import esdf_from_depth_images
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.splats.background import EnvironmentMap, mean_color
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import ranged_depth
from splatpilot.systems.splats.splat_files import read_ply, write_ply
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.training.captures.coverage import look_along


@pytest.fixture
def world(box_room) -> World:
    occupied = np.zeros((20, 10, 10), bool)
    occupied[0] = True
    unknown = np.zeros_like(occupied)
    unknown[15:] = True
    esdf = esdf_from_occupancy(occupied, unknown, np.array([1.0, 2.0, 3.0]), 0.2)
    gaussians, ends = box_room(6, 3, 3).gaussians(0.5), np.array([[2.0, 3, 4], [3.0, 3, 4]])
    return World("box", gaussians, esdf, esdf, (0.1, 0.2, 0.3), *ends)


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "scene"


def test_round_trip(folder, world):
    written = scene_folder.write_scene_folder(
        folder, world, gains=np.array([1.0, 1.25]), representation="2dgs", image_width=320
    )
    assert {file.name for file in folder.iterdir()} == {"gaussians.ply", "esdf.npz", "scene.yaml"}
    back = scene_folder.read_scene(folder)
    assert (back.name, back.background) == ("box", (0.1, 0.2, 0.3))
    np.testing.assert_array_equal([back.p_WS, back.p_WG], [world.p_WS, world.p_WG])
    np.testing.assert_array_equal(back.gaussians.means, world.gaussians.means)
    np.testing.assert_array_equal(back.esdf.distances, world.esdf.distances)
    np.testing.assert_array_equal(back.esdf.states, world.esdf.states)
    assert back.distance_field is back.esdf
    metadata = scene_folder.read_scene_metadata(folder)
    assert metadata == written
    assert (metadata.gains, metadata.representation) == ([1.0, 1.25], "2dgs")
    np.testing.assert_allclose([metadata.lower_W, metadata.upper_W], [[1, 2, 3], [5, 4, 5]])
    assert metadata.observed_free_volume == pytest.approx(14 * 10 * 10 * 0.2**3)
    measured = replace(written, perturbation_bound=0.4, pose_perturbation_bounds=[0.3, 0.5])
    scene_folder.write_scene_metadata(folder, measured)
    assert scene_folder.read_scene_metadata(folder) == measured
    text = (folder / "scene.yaml").read_text()
    (folder / "scene.yaml").write_text(text.replace("image_width: 320\n", ""))
    assert scene_folder.read_scene_metadata(folder).image_width == 0


@pytest.fixture
def painted(folder, world, box_room):
    """Writes a scene folder with a frontier and a sky; returns metadata, world and frontier."""
    texels = np.random.default_rng(0).random((8, 16, 3), np.float32)
    world = replace(world, background=EnvironmentMap(texels))
    frontier = box_room(6, 3, 3).gaussians(1.0)
    metadata = scene_folder.write_scene_folder(folder, world, frontier, provenance="first")
    return metadata, world, frontier


def test_frontier_and_environment_are_seen_in_flight_and_kept_apart(folder, painted):
    metadata, world, frontier = painted
    assert metadata.frontier and len(read_ply(folder / "gaussians.ply")) == len(world.gaussians)
    back = scene_folder.read_scene(folder)
    means = np.concatenate([world.gaussians.means, frontier.means])
    np.testing.assert_array_equal(back.gaussians.means, means)
    texels = world.background.texels
    np.testing.assert_allclose(back.background.texels, texels, atol=0.5 / 255 + 1e-6)
    assert metadata.background == pytest.approx(mean_color(world.background))


def test_a_scene_is_replaced_whole(folder, painted, tmp_path, world):
    (folder / "metrics.json").write_text("{}")
    scene_folder.write_scene_folder(folder, world, provenance="second")
    assert scene_folder.read_scene_metadata(folder).provenance == "second"
    assert not (folder / "metrics.json").exists()
    assert list(tmp_path.iterdir()) == [folder]
    assert scene_folder.read_scene(folder).background == world.background


def test_other_folders_are_not_overwritten(folder, world):
    folder.mkdir()
    scene_folder.check_scene_target(folder)
    (folder / "photo.jpg").write_bytes(b"x")
    for target in (folder, folder / "photo.jpg"):
        with pytest.raises(ValueError, match="scene folder must be new, empty or a scene"):
            scene_folder.write_scene_folder(target, world, provenance="")
    assert (folder / "photo.jpg").read_bytes() == b"x"
    with pytest.raises(NotADirectoryError, match=r"photo.jpg: is a file"):
        scene_folder.check_scene_target(folder / "photo.jpg" / "scene")
    with pytest.raises(OSError, match="cannot write to the output folder /proc"):
        scene_folder.check_scene_target("/proc/scene")


@pytest.mark.parametrize(
    "missing", ["gaussians.ply", "esdf.npz", "scene.yaml", "frontier.ply", "environment.png"]
)
def test_missing_file_is_named(folder, painted, missing):
    (folder / missing).unlink()
    with pytest.raises(FileNotFoundError, match=rf"{missing}"):
        scene_folder.read_scene(folder)
    for read in (scene_folder.read_scene, scene_folder.read_scene_folder):
        with pytest.raises(FileNotFoundError, match=r"nowhere"):
            read(folder / "nowhere")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("metric: true", "metric: false", "metric must be true to fly, got false"),
        ("lower_W: [", "lower_W: [-99.0, -99.0, -99.0] #", "files are of different scenes"),
        ("format_version: 2", "format_version: 3", "format_version must be 2, got 3"),
        ("format_version: 2", "format_version: 1", "format_version must be 2, got 1; reconstruct"),
        ("p_WS: [2.0, 3.0, 4.0]", "p_WS: [2.0, 3.0]", "p_WS must be three finite numbers, got"),
        ("p_WG: [3.0, 3.0, 4.0]", "p_WG: [3.0, .nan, 4.0]", "p_WG must be in .* got .*nan"),
        ("metric: true", "metric: [", r"line 9: expected"),
    ],
)
def test_bad_metadata(folder, world, old, new, message):
    scene_folder.write_scene_folder(folder, world, provenance="")
    text = (folder / "scene.yaml").read_text()
    assert old in text
    (folder / "scene.yaml").write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=rf"(?s)scene\.yaml: .*{message}"):
        scene_folder.read_scene(folder)


@pytest.mark.parametrize("with_stray", [False, True])
def test_bare_ply(tmp_path, box_room, with_stray):
    path, scene = tmp_path / "hall.ply", box_room(6, 3, 3).gaussians(0.1)
    stray = GaussianScene.from_colors([[1000, 0, 0]], [[1, 0, 0, 0]], [[1] * 3], [0.9], [[1] * 3])
    write_ply(scene.merged_with(stray) if with_stray else scene, path)
    world = scene_folder.read_scene(path)
    assert world.name == "hall" and len(world.gaussians) > 1000
    assert world.distance_field is world.esdf and (world.esdf.upper_W < 10).all()
    # In the middle the walls are 1.5 m away, less their thickness.
    assert world.esdf.distance(np.array([3.0, 1.5, 1.5])) == pytest.approx(1.3, abs=0.2)
    assert world.esdf.distance(np.array([0.0, 1.5, 1.5])) < 0
    ends = np.array([world.p_WS, world.p_WG])
    assert (ends > 0.354).all() and (ends < np.array([6.0, 3.0, 3.0]) - 0.354).all()
    assert np.linalg.norm(world.p_WS - world.p_WG) > 4


VOXEL = 0.1  # [m]


@pytest.fixture(scope="module")
def room(box_room):
    return box_room(6.0, 4.0, 3.0)


@pytest.fixture(scope="module")
def captured(room):
    """Depths and poses in the room near its end that look along it, one askew; makes a field."""
    X_WCs = [look_along(np.array([0.3, y, 1.5]), yaw, 0.0) for y, yaw in ((2.0, 0.0), (1.0, 0.5))]
    depths = [room.depth(X_WC) for X_WC in X_WCs]
    box = np.full(3, -0.4), room.size + 0.4
    return depths, X_WCs, partial(esdf_from_depth_images, depths, room.K, X_WCs, *box, VOXEL)


@pytest.fixture(scope="module", params=[None, 3.0])
def closed(request, room, captured):
    """The field of the captured room up to a range, the same with its frontier closed, and what a
    depth camera at a pose sees of the frontier."""
    depths, X_WCs, fuse = captured
    field = fuse(**({"max_range": request.param} if request.param else {}))
    distances, frontier = scene_folder.close_frontier(field, depths, room.K, X_WCs)
    scene = BakedScene(frontier)

    def seen(X_WC: RigidTransform) -> np.ndarray:
        return ranged_depth(scene.render(room.K, 160, 120, X_WC).depth, 0.0, 50.0)

    return field, distances, frontier, seen


def test_frontier_hides_nothing_that_was_captured(captured, closed):
    depths, X_WCs, _ = captured
    *_, seen = closed
    for depth, X_WC in zip(depths, X_WCs, strict=True):
        assert np.mean(seen(X_WC) < depth - 0.1) < 0.005
    aside = look_along(np.array([2.8, 2.0, 1.5]), np.pi, 0.0)
    assert np.mean(np.isfinite(seen(aside))) > 0.5  # in the corners beside the cameras


@pytest.mark.parametrize("closed", [None], indirect=True)
def test_frontier_is_seen_where_it_is_hit(room, closed):
    field, distances, frontier, seen = closed
    missed, ends = 0, 0
    for yaw in np.arange(4) * np.pi / 2:
        X_WC = look_along(np.array([2.8, 2.0, 1.5]), yaw, 0.0)
        rays, depth = room.rays(X_WC), np.zeros((120, 160))
        p_WQ = np.tile(X_WC.translation(), (120, 160, 1))
        for _ in range(60):
            depth += 0.7 * np.clip(np.nan_to_num(distances.distance(p_WQ)), 0.0, None)
            p_WQ = X_WC.translation() + depth[..., None] * rays
        at_frontier = (np.abs(distances.distance(p_WQ)) < 0.02) & (field.distance(p_WQ) > 0.1)
        ends += at_frontier.sum()
        missed += (at_frontier & (seen(X_WC) > depth + 2 * VOXEL)).sum()
    assert ends > 5000 and missed < 0.01 * ends
    assert len(frontier) < 1000


@pytest.mark.parametrize("closed", [None], indirect=True)
def test_touching_the_frontier_is_a_collision(closed):
    scenario = Scenario(policy=policy_named("straight"))
    p_WS, p_WG = np.array([2.8, 2.0, 1.5]), np.array([4.0, 2.0, 1.5])
    hidden_W = [0.7, 2.0, 0.3]  # beside the near camera, below all it saw
    ended = []
    for field in closed[:2]:
        world = World("room", closed[2], field, field, (0.0, 0.0, 0.0), p_WS, p_WG)
        diagram = BuildFlightDiagram(scenario, world, camera=False)
        context = diagram.CreateDefaultContext()
        plant = diagram.GetSubsystemByName("plant")
        for p_WB in (hidden_W, p_WS):
            plant.GetMyMutableContextFromRoot(context).SetContinuousState(hover_state(p_WB))
            ended.append(flight_outcome(diagram, context, p_WG, 0.3))
    assert ended == [Outcome.LEFT_VOLUME, None, Outcome.COLLISION, None]


def test_a_room_without_frontier_is_left_as_it_is(captured, room):
    field = captured[2]()
    known = Esdf(np.abs(field.distances) + 0.4, 0 * field.states, field.lower_W, VOXEL)
    assert scene_folder.close_frontier(known, [], room.K, []) == (known, None)
