import csv
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field, esdf_from_occupancy
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Cylinder, HalfSpace
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.provenance import TRAINING_SEEDS, InfeasibleFlightError
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state
from splatpilot.training.corpus import collect
from splatpilot.training.corpus.collect import (
    Demonstration,
    draw_off_path,
    keep_clear,
    render_samples,
)
from splatpilot.training.corpus.corpus import EXPERT, OFF_PATH, CorpusConfig
from splatpilot.training.corpus.expert import ExpertConfig, Label, Labeler
from splatpilot.training.corpus.library import PerturbationConfig


def all_bytes(folder: Path) -> dict[str, bytes]:
    """Every file of a folder by its path in it."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture
def copy(collected, tmp_path) -> Path:
    """A copy of the corpus, to be damaged."""
    return shutil.copytree(collected.folder, tmp_path / "copy")


def test_interrupted_run_ends_with_identical_files(small, collected, tmp_path, monkeypatch):
    def killed(path, *args, **kwargs):
        (path.parent / f".{path.name}.1.partial").mkdir()
        raise KeyboardInterrupt

    collect.run(config=small, out=tmp_path, worlds=1, jobs=1)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(collect, "write_shard", killed)
        collect.run(config=small, out=tmp_path, worlds=2, jobs=1)
    collect.run(config=small, out=tmp_path, worlds=2, jobs=1)
    assert all_bytes(tmp_path) == all_bytes(collected.folder)
    rows = list(csv.DictReader((tmp_path / "ledger.csv").open()))
    assert len(rows) == 4
    assert 2 * sum(int(row["states"]) for row in rows) == len(collected) > 0
    assert {int(row["seed"]) for row in rows} == {TRAINING_SEEDS, TRAINING_SEEDS + 1}
    assert all(row["outcome"] == "goal" and float(row["least_clearance_m"]) > 0 for row in rows)


def test_damaged_and_half_worlds_are_collected_again(small, copy, collected, monkeypatch, capsys):
    calls = []

    def collect_world(folder, config, index, revision):
        calls.append(index)
        for part in ("shards", "worlds"):
            whole = sorted((collected.folder / part).iterdir())[index]
            shutil.copytree(whole, folder / part / whole.name, dirs_exist_ok=True)

    monkeypatch.setattr(collect, "collect_world", collect_world)
    collect.run(config=small, out=copy, worlds=2, jobs=1)
    assert calls == []
    first, second = (copy / "worlds" / record.path.name / "esdf.npz" for record in collected.worlds)
    content = bytearray(first.read_bytes())
    content[len(content) // 2] ^= 1
    first.write_bytes(content)
    depth = copy / "shards" / collected.shards[1].path.name / "depth.npy"
    depth.write_bytes(depth.read_bytes()[:-1])
    collect.run(config=small, out=copy, worlds=2, jobs=1)
    assert calls == [0, 1]
    assert all_bytes(copy) == all_bytes(collected.folder)
    shutil.rmtree(depth.parent)  # as an interrupted run leaves a world
    shutil.copy(first, second)
    collect.run(config=small, out=copy, worlds=2, jobs=1)
    assert calls == [0, 1, 1]
    assert all_bytes(copy) == all_bytes(collected.folder)


def test_worlds_that_cannot_be_flown_are_left_out(small, copy, collected, monkeypatch, capsys):
    def collect_world(folder, config, index, revision):
        raise InfeasibleFlightError("no path")

    monkeypatch.setattr(collect, "collect_world", collect_world)
    shutil.rmtree(copy / "shards" / collected.shards[0].path.name)
    collect.run(config=small, out=copy, worlds=2, jobs=1)
    assert "world 0 is left out: no path" in "".join(capsys.readouterr())


def test_states_off_the_path_have_their_own_shards(small, collected, tmp_path, monkeypatch):
    config = replace(small, off_path=70)
    shard, off_path = collect.run(config=config, out=tmp_path, worlds=1, jobs=1).shards
    assert (shard.source, off_path.source) == (EXPERT, OFF_PATH)
    np.testing.assert_array_equal(shard.arrays["depth"], collected.shards[0].arrays["depth"])
    assert 35 <= len(off_path) <= 70 and not np.isnan(off_path.arrays["trajectories_B"][:, 0]).any()
    *_, row = csv.DictReader((tmp_path / "ledger.csv").open())
    assert (row["source"], row["states"]) == ("off_path", str(len(off_path)))
    with (off_path.path / "color.npy").open("r+b") as file:
        file.seek(5000)
        file.write(b"damage")
    monkeypatch.setattr(collect, "collect_world", None)
    with pytest.raises(TypeError):  # as it is collected again
        collect.run(config=config, out=tmp_path, worlds=1, jobs=1)


@pytest.mark.parametrize(
    ("override", "numbers", "message"),
    [
        ("appearance=1.5", {}, r"appearance must be in \[0, 1\], got 1.5"),
        ("expert.policy=unknown", {}, "no policy 'unknown'"),
        ("worlds.kinds=[R13]", {}, "worlds.kinds must be of generated worlds, got R13"),
        ("seed=0", {"worlds": 0}, "--worlds must be at least 1, got 0"),
        ("seed=0", {"jobs": 0}, "--jobs must be at least 1, got 0"),
    ],
)
def test_values_out_of_range_are_named(small, tmp_path, override, numbers, message):
    config = load_config(small, overrides=[override])
    with pytest.raises(ValueError, match=message):
        collect.run(config=config, out=tmp_path / "c", **{"worlds": 1, "jobs": 1} | numbers)
    assert not (tmp_path / "c").exists()


def test_another_program_version_or_configuration_adds_no_worlds(small, copy, monkeypatch):
    def refused(message, config=small, worlds=2):
        with pytest.raises(ValueError, match=message):
            collect.run(config=config, out=copy, worlds=worlds, jobs=1)
        assert all_bytes(copy) == before

    before = all_bytes(copy)
    refused("another configuration", load_config(small, overrides=["flights=3"]))
    grove = Path(small.worlds.kinds[0])
    text = grove.read_text()
    grove.write_text(text.replace("10", "11"))
    refused("grove-1000000 is a world of another definition", worlds=3)
    grove.write_text(text)
    with monkeypatch.context() as patch:
        patch.setattr(collect, "revision", lambda: "another")
        collect.run(config=small, out=copy, worlds=2, jobs=1)
        refused("must be that of the program, another, got", worlds=3)
        [depth, *_] = sorted((copy / "shards").glob("*/depth.npy"))
        depth.write_bytes(depth.read_bytes()[:-1])
        before = all_bytes(copy)
        refused("must be that of the program, another, got")
    about = depth.parent / "shard.json"
    about.write_text(about.read_text().replace('"format_version": 2', '"format_version": 3'))
    before = all_bytes(copy)
    refused("must be 2, got 3; use the version")


P_WG = np.array([11.0, 4.0, 1.5])


def test_half_of_the_states_are_before_a_pillar_and_none_in_one():
    shapes = [HalfSpace(np.array([0.0, 0.0, 1.0]), 0.0)]
    shapes += [Cylinder([x, y, -1], [x, y, 4], 0.4) for x, y in ((4.0, 2.5), (7.0, 5.5))]
    exact = AnalyticDistanceField(shapes, np.zeros(3), np.array([12.0, 8.0, 3.0]))
    labeler, count = Labeler(esdf_from_distance_field(exact, 0.2), P_WG, ExpertConfig()), 400
    states = draw_off_path(labeler, count, 2.5, np.random.default_rng(0))
    assert states.shape == (count, 13)
    p_WB, v_WB = states[:, :3], states[:, 3:6]
    room = labeler.field.distance(p_WB) - VEHICLE_RADIUS
    assert room.min() > 0.0 and (p_WB >= 0.0).all()
    ahead = np.hypot(v_WB[:, 0], v_WB[:, 1])
    assert 1.5 < ahead.max() < 4.0
    assert (ahead - np.sqrt(6.0 * room) < 1.5).all()  # but for what goes sideways
    rotations = [RotationMatrix(Quaternion(wxyz)) for wxyz in states[:, 6:10]]
    roll, pitch, yaws = np.array([RollPitchYaw(R_WB).vector() for R_WB in rotations]).T
    assert 0.08 < np.std([roll, pitch]) < 0.16
    looking = np.stack([np.cos(yaws), np.sin(yaws)], 1)

    before, others = slice(0, count // 2), slice(count // 2, count)
    surfaces = labeler.field.query(p_WB[before]).gradient[:, :2]
    into = -(surfaces * looking[before]).sum(1) / np.linalg.norm(surfaces, axis=1)
    assert room[before].max() < 1.0 and np.median(into) > 0.7
    arriving, anywhere = slice(count // 2, 3 * count // 4), slice(3 * count // 4, count)
    to_goal = np.linalg.norm(p_WB[arriving] - P_WG, axis=1)
    assert to_goal.max() < 4.0 and (to_goal < 1.0).mean() > 0.15
    assert np.abs(looking[arriving].mean(0)).max() < 0.25
    to_goal = P_WG[:2] - p_WB[anywhere, :2]
    to_goal /= np.linalg.norm(to_goal, axis=1, keepdims=True)
    assert np.median((to_goal * looking[anywhere]).sum(1)) > 0.6
    assert np.ptp(p_WB[others], axis=0) == pytest.approx([11.0, 7.0, 2.2], abs=1.2)
    labeler.toa = replace(labeler.toa, reachable=np.zeros_like(labeler.toa.reachable))
    with pytest.raises(InfeasibleFlightError, match="no free position with a path"):
        draw_off_path(labeler, 5, 2.0, np.random.default_rng(0))


SPHERE = np.array([5.0, 1.2, 2.6])  # p_W, ahead, to the left and above of the states below
CONFIG = CorpusConfig(
    camera=OnboardCamera(width=160, height=120),
    perturbation=PerturbationConfig(copies=2, distance=0.3, yaw=0.2, tilt=0.1),
    appearance=0.0,
)


@pytest.fixture(scope="module")
def world() -> World:
    """A small white sphere in a black hall without walls, 10 x 6 x 4 m."""
    free = np.zeros((50, 30, 20), bool)
    esdf = esdf_from_occupancy(free, free, np.array([0.0, -3.0, 0.0]), 0.2)
    one = np.ones((1, 3))
    return World(
        name="hall",
        gaussians=GaussianScene.from_colors([SPHERE], [[1, 0, 0, 0]], 0.05 * one, [0.99], one),
        distance_field=esdf,
        esdf=esdf,
        background=(0.0, 0.0, 0.0),
        p_WS=np.array([1.0, 0.0, 2.0]),
        p_WG=np.array([9.0, 0.0, 2.0]),
    )


@pytest.fixture(scope="module")
def labeler(world) -> Labeler:
    return Labeler(world.esdf, world.p_WG, ExpertConfig())


def tilted_state(p_WB) -> np.ndarray:
    q_WB = np.array([1.0, 0.05, -0.08, 0.15])
    q_WB /= np.linalg.norm(q_WB)
    return QuadrotorState(p_WB, [1.5, 0.4, -0.2], q_WB, np.zeros(3)).to_vector()


STATES = [tilted_state(p) for p in ([1.5, 0.2, 2.0], [2.0, -0.5, 1.5])]


def see(world, labeler, bound=np.inf, config=CONFIG):
    """The demonstrations of `STATES`, their samples, and the poses of these."""
    demonstrations = keep_clear(labeler.labels(STATES), labeler.field)
    rng = np.random.default_rng(3)
    samples = render_samples(demonstrations, world, labeler, config, bound, rng)
    rows = samples.X_WB
    return demonstrations, samples, [RigidTransform(Quaternion(X[:4]), X[4:]) for X in rows]


def test_labels_and_images_are_those_of_the_recorded_pose(world, labeler):
    demonstrations, samples, poses = see(world, labeler)
    assert len(samples) == 6
    camera = CONFIG.camera
    for k, X_WP in enumerate(poses):
        state, waypoints_W = demonstrations[k // 3]
        R_WP = X_WP.rotation().matrix()
        found = samples.trajectories_B[k] @ R_WP.T + X_WP.translation()
        np.testing.assert_allclose(found, waypoints_W, atol=1e-5)
        np.testing.assert_allclose(R_WP @ samples.v_B[k], state[3:6], atol=1e-6)
        to_goal = world.p_WG - X_WP.translation()
        np.testing.assert_allclose(R_WP @ samples.goal_B[k], to_goal, atol=1e-5)
        forward, left, up = X_WP.inverse().multiply(SPHERE) - camera.mount().translation()
        column = camera.width / 2 - camera.focal_x * left / forward
        row = camera.height / 2 - camera.focal_y * up / forward
        light = samples.color[k].sum(axis=2)
        rows, columns = np.nonzero(light > light.max() / 2)
        assert light.max() > 300
        assert rows.mean() + 0.5 == pytest.approx(row, abs=0.6)
        assert columns.mean() + 0.5 == pytest.approx(column, abs=0.6)
        depth = samples.depth[k][int(row), int(column)]
        assert depth == pytest.approx(forward, abs=0.06)
        assert np.isinf(samples.depth[k]).mean() > 0.9
    for k in (0, 3):
        assert poses[k].IsNearlyEqualTo(pose_from_state(STATES[k // 3]), 1e-9)


@pytest.mark.parametrize(
    ("height", "bound", "radius"),
    [
        (0.5, np.inf, 0.5 - 0.354),  # the clearance above the floor of the hall
        (2.0, np.inf, 1.0),
        (2.0, 0.1, 0.1),
        (2.0, 0.0, 0.0),
    ],
)
def test_perturbations_keep_their_bounds_and_clear_of_obstacles(
    world, labeler, height, bound, radius
):
    config = replace(CONFIG, perturbation=PerturbationConfig(copies=30, distance=1.0))
    state = tilted_state([5.0, 0.0, height])
    demonstration = Demonstration(state, np.zeros((3, 10, 3)))
    rng = np.random.default_rng(0)
    samples = render_samples([demonstration], world, labeler, config, bound, rng)
    moved = np.linalg.norm(samples.X_WB[:, 4:] - state[:3], axis=1)
    assert 0.3 * radius <= moved.max() <= radius + 1e-9


def test_trajectories_in_contact_are_no_demonstrations(labeler):
    X_WB = RigidTransform([5.0, 0.0, 2.0])
    ahead = np.linspace(0.1, 1.0, 10)[:, None] * [1.0, 0.0, 0.0]
    out = 3.0 * ahead[:, [1, 0, 2]]  # 3 m to the left, to the hall's edge
    plan = Hypotheses(0.0, X_WB, np.stack([out, ahead, 0.5 * ahead]), np.arange(3.0))
    hopeless = Hypotheses(0.0, X_WB, np.stack([out, out, out]), np.arange(3.0))
    kept = keep_clear([Label(STATES[0], plan), Label(STATES[1], hopeless)], labeler.field)
    assert len(kept) == 1
    np.testing.assert_array_equal(kept[0].state, STATES[0])
    np.testing.assert_allclose(kept[0].waypoints_W[:2], plan.waypoints_W[1:])
    assert np.isnan(kept[0].waypoints_W[2]).all()


def test_appearance_changes_colors_but_not_depth(world, labeler):
    _, plain, _ = see(world, labeler)
    config = replace(CONFIG, appearance=1.0, perturbation=PerturbationConfig(copies=0))
    _, other, _ = see(world, labeler, config=config)
    np.testing.assert_array_equal(plain.depth[::3], other.depth)
    assert np.abs(plain.color[::3].astype(int) - other.color).max() > 10
