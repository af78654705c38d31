from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

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


def box_of_gaussians(size=(6.0, 3.0, 3.0), step=0.1) -> GaussianScene:
    """The walls of a box with its lower corner in the origin, as round Gaussians."""
    axes = [np.arange(step / 2, length, step) for length in size]
    sides = []
    for axis, length in enumerate(size):
        for at in (0, length):
            grids = [np.array([at]) if a == axis else axes[a] for a in range(3)]
            sides.append(np.stack(np.meshgrid(*grids, indexing="ij"), -1).reshape(-1, 3))
    means = np.concatenate(sides)
    N = len(means)
    return GaussianScene.from_colors(
        means,
        np.tile([1, 0, 0, 0], (N, 1)),
        np.full((N, 3), step),
        np.full(N, 0.99),
        np.full((N, 3), 0.3),
    )


@pytest.fixture
def world() -> World:
    occupied = np.zeros((20, 10, 10), bool)
    occupied[0] = True
    unknown = np.zeros_like(occupied)
    unknown[15:] = True
    esdf = esdf_from_occupancy(occupied, unknown, np.array([1.0, 2.0, 3.0]), 0.2)
    return World(
        name="box",
        gaussians=box_of_gaussians(step=0.5),
        distance_field=esdf,
        esdf=esdf,
        background=(0.1, 0.2, 0.3),
        p_WS=np.array([2.0, 3.0, 4.0]),
        p_WG=np.array([3.0, 3.0, 4.0]),
    )


def test_round_trip(tmp_path, world):
    folder = tmp_path / "scene"
    written = scene_folder.write_scene_folder(
        folder, world, gains=np.array([1.0, 1.25]), representation="2dgs"
    )
    assert {file.name for file in folder.iterdir()} == {"gaussians.ply", "esdf.npz", "scene.yaml"}
    back = scene_folder.read_scene(folder)
    assert (back.name, back.background) == ("box", (0.1, 0.2, 0.3))
    np.testing.assert_array_equal(back.p_WS, world.p_WS)
    np.testing.assert_array_equal(back.p_WG, world.p_WG)
    np.testing.assert_array_equal(back.gaussians.means, world.gaussians.means)
    np.testing.assert_array_equal(back.esdf.distances, world.esdf.distances)
    np.testing.assert_array_equal(back.esdf.states, world.esdf.states)
    assert back.distance_field is back.esdf
    metadata = scene_folder.read_scene_metadata(folder)
    assert metadata == written
    assert (metadata.gains, metadata.representation) == ([1.0, 1.25], "2dgs")
    np.testing.assert_allclose(metadata.lower_W, [1, 2, 3])
    np.testing.assert_allclose(metadata.upper_W, [5, 4, 5])
    assert metadata.observed_free_volume == pytest.approx(14 * 10 * 10 * 0.2**3)
    measured = replace(written, perturbation_bound=0.4, pose_perturbation_bounds=[0.3, 0.5])
    scene_folder.write_scene_metadata(folder, measured)
    assert scene_folder.read_scene_metadata(folder) == measured


def test_missing_fields_have_defaults(tmp_path, world):
    scene_folder.write_scene_folder(tmp_path / "scene", world, image_width=320)
    file = tmp_path / "scene" / "scene.yaml"
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join(line for line in lines if not line.startswith("image_width")))
    assert scene_folder.read_scene_metadata(tmp_path / "scene").image_width == 0


def test_frontier_is_seen_in_flight_and_kept_apart(tmp_path, world):
    folder, frontier = tmp_path / "scene", box_of_gaussians(step=1.0)
    written = scene_folder.write_scene_folder(folder, world, frontier, provenance="")
    assert written.frontier and len(read_ply(folder / "gaussians.ply")) == len(world.gaussians)
    means = np.concatenate([world.gaussians.means, frontier.means])
    np.testing.assert_array_equal(scene_folder.read_scene(folder).gaussians.means, means)
    (folder / "frontier.ply").unlink()
    with pytest.raises(FileNotFoundError, match=r"frontier\.ply"):
        scene_folder.read_scene(folder)


def test_an_environment_is_kept(tmp_path, world):
    folder = tmp_path / "scene"
    texels = np.random.default_rng(0).random((8, 16, 3), np.float32)
    sky = replace(world, background=EnvironmentMap(texels))
    metadata = scene_folder.write_scene_folder(folder, sky, provenance="")
    back = scene_folder.read_scene(folder).background
    assert isinstance(back, EnvironmentMap)
    np.testing.assert_allclose(back.texels, texels, atol=0.5 / 255 + 1e-6)
    assert metadata.background == pytest.approx(mean_color(sky.background))
    (folder / "environment.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"No such file: .*environment\.png"):
        scene_folder.read_scene(folder)
    scene_folder.write_scene_folder(folder, world, provenance="")
    assert scene_folder.read_scene(folder).background == world.background


def test_a_scene_is_replaced_whole(tmp_path, world):
    folder = tmp_path / "scene"
    scene_folder.write_scene_folder(folder, world, provenance="first")
    (folder / "metrics.json").write_text("{}")
    scene_folder.write_scene_folder(folder, world, provenance="second")
    assert scene_folder.read_scene_metadata(folder).provenance == "second"
    assert not (folder / "metrics.json").exists()
    assert list(tmp_path.iterdir()) == [folder]


def test_other_folders_are_not_overwritten(tmp_path, world):
    folder = tmp_path / "holiday"
    folder.mkdir()
    (folder / "photo.jpg").write_bytes(b"x")
    for target in (folder, folder / "photo.jpg"):
        with pytest.raises(ValueError, match="scene folder must be new, empty or a scene"):
            scene_folder.write_scene_folder(target, world, provenance="")
    assert (folder / "photo.jpg").read_bytes() == b"x"
    empty = tmp_path / "empty"
    empty.mkdir()
    scene_folder.check_scene_target(empty)


def test_unwritable_place(tmp_path, world):
    scene_folder.write_scene_folder(tmp_path / "new" / "folder" / "scene", world, provenance="")
    assert scene_folder.read_scene(tmp_path / "new" / "folder" / "scene").name == world.name
    (tmp_path / "file").write_text("")
    with pytest.raises(NotADirectoryError, match="file: is a file"):
        scene_folder.check_scene_target(tmp_path / "file" / "scene")
    with pytest.raises(OSError, match="cannot write to the output folder /proc"):
        scene_folder.check_scene_target("/proc/scene")


@pytest.mark.parametrize("missing", ["gaussians.ply", "esdf.npz", "scene.yaml"])
def test_missing_file(tmp_path, world, missing):
    folder = tmp_path / "scene"
    scene_folder.write_scene_folder(folder, world, provenance="")
    (folder / missing).unlink()
    with pytest.raises(FileNotFoundError, match=rf"No such file: .*{missing}"):
        scene_folder.read_scene(folder)
    for read in (scene_folder.read_scene, scene_folder.read_scene_folder):
        with pytest.raises(FileNotFoundError, match=r"nowhere"):
            read(tmp_path / "nowhere")


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
def test_bad_metadata(tmp_path, world, old, new, message):
    folder = tmp_path / "scene"
    scene_folder.write_scene_folder(folder, world, provenance="")
    text = (folder / "scene.yaml").read_text()
    assert old in text
    (folder / "scene.yaml").write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=rf"(?s)scene\.yaml: .*{message}"):
        scene_folder.read_scene(folder)


def test_bare_ply(tmp_path):
    path = tmp_path / "hall.ply"
    write_ply(box_of_gaussians(), path)
    world = scene_folder.read_scene(path)
    assert world.name == "hall"
    assert len(world.gaussians) > 1000
    assert world.distance_field is world.esdf
    # In the middle the walls are 1.5 m away, less their thickness.
    assert world.esdf.distance(np.array([3.0, 1.5, 1.5])) == pytest.approx(1.3, abs=0.2)
    assert world.esdf.distance(np.array([0.0, 1.5, 1.5])) < 0
    for p in (world.p_WS, world.p_WG):
        assert (p > 0.354).all() and (p < np.array([6.0, 3.0, 3.0]) - 0.354).all()
    assert np.linalg.norm(world.p_WS - world.p_WG) > 4


def test_stray_gaussians_do_not_stretch_a_bare_ply(tmp_path):
    scene = box_of_gaussians()
    stray = GaussianScene.from_colors(
        [[1000, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.9], [[1, 1, 1]]
    )
    write_ply(scene.merged_with(stray), tmp_path / "hall.ply")
    assert (scene_folder.read_scene(tmp_path / "hall.ply").esdf.upper_W < 10).all()


SIZE = np.array([6.0, 4.0, 3.0])  # [m]
K = np.array([[80.0, 0.0, 80.0], [0.0, 80.0, 60.0], [0.0, 0.0, 1.0]])
VOXEL = 0.1  # [m]


def looking(yaw: float, p_WC: list[float]) -> RigidTransform:
    """A level camera (x right, y down, z forward) that looks along `yaw` from p_WC."""
    R_BC = RollPitchYaw(-np.pi / 2, 0.0, -np.pi / 2).ToRotationMatrix()
    return RigidTransform(RollPitchYaw(0.0, 0.0, yaw).ToRotationMatrix() @ R_BC, p_WC)


def rays(X_WC: RigidTransform) -> np.ndarray:
    """(120, 160, 3) of depth 1, in W."""
    x, y = np.meshgrid((np.arange(160) - 79.5) / 80.0, (np.arange(120) - 59.5) / 80.0)
    return np.stack([x, y, np.ones_like(x)], -1) @ X_WC.rotation().matrix().T


def room_depth(X_WC: RigidTransform) -> np.ndarray:
    """(120, 160) [m] to the walls of an empty room between the origin and SIZE."""
    with np.errstate(divide="ignore"):
        ways = np.stack([(end - X_WC.translation()) / rays(X_WC) for end in (np.zeros(3), SIZE)])
    return ways.max(axis=0).min(axis=-1).astype(np.float32)


@pytest.fixture(scope="module")
def captured() -> tuple[Esdf, list[np.ndarray], list[RigidTransform]]:
    """The room from two poses at its near end that look along it, one of them askew."""
    X_WCs = [looking(0.0, [0.3, 2.0, 1.5]), looking(0.5, [0.3, 1.0, 1.5])]
    depths = [room_depth(X_WC) for X_WC in X_WCs]
    field = esdf_from_depth_images(depths, K, X_WCs, np.full(3, -0.4), SIZE + 0.4, VOXEL)
    return field, depths, X_WCs


@pytest.fixture(scope="module")
def closed(captured) -> tuple[Esdf, GaussianScene]:
    field, depths, X_WCs = captured
    closed, frontier = scene_folder.close_frontier(field, depths, K, X_WCs)
    assert frontier is not None
    return closed, frontier


def seen_depth(frontier: GaussianScene, X_WC: RigidTransform) -> np.ndarray:
    """(120, 160) [m], what a depth camera sees of the frontier."""
    return ranged_depth(BakedScene(frontier).render(K, 160, 120, X_WC).depth, 0.0, 50.0)


def test_frontier_hides_nothing_that_was_captured(captured, closed):
    _, depths, X_WCs = captured
    for depth, X_WC in zip(depths, X_WCs, strict=True):
        assert np.mean(seen_depth(closed[1], X_WC) < depth - 0.1) < 0.005


def test_surfaces_beyond_the_range_of_the_field_are_not_hidden(captured):
    _, depths, X_WCs = captured
    box = np.full(3, -0.4), SIZE + 0.4
    field = esdf_from_depth_images(depths, K, X_WCs, *box, VOXEL, max_range=3.0)
    _, frontier = scene_folder.close_frontier(field, depths, K, X_WCs)
    assert frontier is not None
    for depth, X_WC in zip(depths, X_WCs, strict=True):
        assert np.mean(seen_depth(frontier, X_WC) < depth - 0.1) < 0.005
    aside = looking(np.pi, [2.8, 2.0, 1.5])  # back into the corners beside the cameras
    assert np.mean(np.isfinite(seen_depth(frontier, aside))) > 0.5


def test_frontier_is_seen_where_it_is_hit(captured, closed):
    field, (distances, frontier) = captured[0], closed
    missed, ends = 0, 0
    for yaw in np.arange(4) * np.pi / 2:
        X_WC = looking(yaw, [2.8, 2.0, 1.5])
        way, depth = rays(X_WC), np.zeros((120, 160))
        p_WQ = np.tile(X_WC.translation(), (120, 160, 1))
        for _ in range(60):
            depth += 0.7 * np.clip(np.nan_to_num(distances.distance(p_WQ)), 0.0, None)
            p_WQ = X_WC.translation() + depth[..., None] * way
        at_frontier = (np.abs(distances.distance(p_WQ)) < 0.02) & (field.distance(p_WQ) > 0.1)
        ends += at_frontier.sum()
        missed += (at_frontier & (seen_depth(frontier, X_WC) > depth + 2 * VOXEL)).sum()
    assert ends > 5000
    assert missed < 0.01 * ends
    assert len(frontier) < 1000


def test_touching_the_frontier_is_a_collision(captured, closed):
    scenario = Scenario(policy=policy_named("straight"))
    p_WS, p_WG = np.array([2.8, 2.0, 1.5]), np.array([4.0, 2.0, 1.5])
    hidden_W = [0.7, 2.0, 0.3]  # beside the near camera, below all it saw
    ended = []
    for field in (captured[0], closed[0]):
        world = World("room", closed[1], field, field, (0.0, 0.0, 0.0), p_WS, p_WG)
        diagram = BuildFlightDiagram(scenario, world, camera=False)
        context = diagram.CreateDefaultContext()
        plant = diagram.GetSubsystemByName("plant")
        for p_WB in (hidden_W, p_WS):
            plant.GetMyMutableContextFromRoot(context).SetContinuousState(hover_state(p_WB))
            ended.append(flight_outcome(diagram, context, p_WG, 0.3))
    assert ended == [Outcome.LEFT_VOLUME, None, Outcome.COLLISION, None]


def test_closed_place_is_left_as_it_is(captured):
    field = captured[0]
    known = Esdf(np.abs(field.distances) + 0.4, 0 * field.states, field.lower_W, VOXEL)
    assert scene_folder.close_frontier(known, [], K, []) == (known, None)
