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
from splatpilot.training.corpus.corpus import CorpusConfig
from splatpilot.training.corpus.expert import ExpertConfig, Label, Labeler
from splatpilot.training.corpus.library import PerturbationConfig
from splatpilot.training.corpus.samples import EXPERT, OFF_PATH


def all_bytes(folder: Path) -> dict[str, bytes]:
    """Every file of a folder by its path in it."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_interrupted_run_ends_with_identical_files(small, collected, tmp_path, monkeypatch):
    whole = all_bytes(collected.shards[0].path.parents[1])

    def killed(path, *args, **kwargs):
        (path.parent / f".{path.name}.1.partial").mkdir()
        raise KeyboardInterrupt

    collect.run(config=small, out=tmp_path, worlds=1, jobs=1)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(collect, "write_shard", killed)
        collect.run(config=small, out=tmp_path, worlds=2, jobs=1)
    collect.run(config=small, out=tmp_path, worlds=2, jobs=1)
    assert all_bytes(tmp_path) == whole


def test_damaged_worlds_are_collected_again(small, collected, tmp_path, monkeypatch):
    folder = collected.shards[0].path.parents[1]
    out = shutil.copytree(folder, tmp_path / "corpus")
    again = []
    collect_world = collect.collect_world
    monkeypatch.setattr(
        collect, "collect_world", lambda *a: (again.append(a[2]), collect_world(*a))
    )
    collect.run(config=small, out=out, worlds=2, jobs=1)
    assert again == []
    depth = out / "shards" / collected.shards[1].path.name / "depth.npy"
    depth.write_bytes(depth.read_bytes()[:-1])
    esdf = out / "worlds" / collected.worlds[0].name / "esdf.npz"
    content = bytearray(esdf.read_bytes())
    content[len(content) // 2] ^= 1
    esdf.write_bytes(content)
    collect.run(config=small, out=out, worlds=2, jobs=1)
    assert again == [0, 1]
    assert all_bytes(out) == all_bytes(folder)


def test_samples_of_another_version_stay(small, collected, tmp_path):
    out = shutil.copytree(collected.shards[0].path.parents[1], tmp_path / "corpus")
    about = out / "shards" / collected.shards[0].path.name / "shard.json"
    about.write_text(about.read_text().replace('"format_version": 2', '"format_version": 3'))
    before = all_bytes(out)
    with pytest.raises(ValueError, match="must be 2, got 3; use the version"):
        collect.run(config=small, out=out, worlds=2, jobs=1)
    assert all_bytes(out) == before


def test_states_off_the_path_have_their_own_shards(small, collected, tmp_path):
    config = replace(small, off_path=70)
    corpus = collect.run(config=config, out=tmp_path, worlds=1, jobs=1)
    shard, off_path = corpus.shards
    assert (shard.source, off_path.source) == (EXPERT, OFF_PATH)
    np.testing.assert_array_equal(shard.arrays["depth"], collected.shards[0].arrays["depth"])
    assert 35 <= len(off_path) <= 70 and not np.isnan(off_path.arrays["trajectories_B"][:, 0]).any()
    before = all_bytes(tmp_path)
    with (off_path.path / "color.npy").open("r+b") as file:
        file.seek(5000)
        file.write(b"damage")
    collect.run(config=config, out=tmp_path, worlds=1, jobs=1)
    assert all_bytes(tmp_path) == before
    rows = list(csv.DictReader((tmp_path / "ledger.csv").open()))
    assert [(row["source"], row["states"]) for row in rows][-1] == ("off_path", str(len(off_path)))


def test_the_ledger_accounts_for_every_sample(collected):
    folder = collected.shards[0].path.parents[1]
    rows = list(csv.DictReader((folder / "ledger.csv").open()))
    assert len(rows) == 4
    assert 2 * sum(int(row["states"]) for row in rows) == len(collected) > 0
    assert {int(row["seed"]) for row in rows} == {TRAINING_SEEDS, TRAINING_SEEDS + 1}
    assert all(row["outcome"] == "goal" and float(row["least_clearance_m"]) > 0 for row in rows)


def test_worlds_that_cannot_be_flown_are_left_out(small, collected, tmp_path, monkeypatch, capsys):
    def collect_world(folder, config, index, revision):
        if index == 0:
            raise InfeasibleFlightError("no path")
        shutil.copytree(collected.shards[0].path.parents[1], folder, dirs_exist_ok=True)

    monkeypatch.setattr(collect, "collect_world", collect_world)
    collect.run(config=small, out=tmp_path, worlds=2, jobs=1)
    assert "world 0 is left out: no path" in "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("appearance=1.5", r"appearance must be in \[0, 1\], got 1.5"),
        ("expert.policy=unknown", "no policy 'unknown'"),
        ("worlds.kinds=[R13]", "worlds.kinds must be of generated worlds, got R13"),
    ],
)
def test_values_out_of_range_are_named(small, tmp_path, override, message):
    config = load_config(small, overrides=[override])
    with pytest.raises(ValueError, match=message):
        collect.run(config=config, out=tmp_path / "c", worlds=1)
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize("number", ["worlds", "jobs"])
def test_numbers_below_one_are_refused(small, tmp_path, number):
    with pytest.raises(ValueError, match=f"--{number} must be at least 1, got 0"):
        collect.run(config=small, out=tmp_path, **{"worlds": 1, "jobs": 1} | {number: 0})


def test_another_program_adds_no_worlds(small, collected, tmp_path, monkeypatch):
    out = shutil.copytree(collected.folder, tmp_path / "corpus")
    before = all_bytes(out)
    monkeypatch.setattr(collect, "revision", lambda: "another")
    assert len(collect.run(config=small, out=out, worlds=2, jobs=1)) == len(collected)
    depth = out / "shards" / collected.shards[1].path.name / "depth.npy"
    content = depth.read_bytes()
    for wrong in (content, content[:-1]):
        depth.write_bytes(wrong)
        with pytest.raises(ValueError, match="must be that of the program, another, got"):
            collect.run(config=small, out=out, worlds=2 + (wrong == content), jobs=1)
    depth.write_bytes(content)
    assert all_bytes(out) == before


def test_corpus_of_a_changed_kind_is_not_extended(small, collected, tmp_path):
    grove = tmp_path / "grove.yaml"
    grove.write_text(Path(small.worlds.kinds[0]).read_text())
    config = replace(small, worlds=replace(small.worlds, kinds=[str(grove)]))
    collect.run(config=config, out=tmp_path / "corpus", worlds=1, jobs=1)
    grove.write_text("world: !ForestConfig {length: 11, width: 8, height: 4}\n")
    with pytest.raises(ValueError, match="grove-1000000 is a world of another definition"):
        collect.run(config=config, out=tmp_path / "corpus", worlds=2, jobs=1)


def test_half_a_world_of_an_interrupted_run_is_not_used(small, collected, tmp_path):
    out = shutil.copytree(collected.folder, tmp_path / "corpus")
    other, world = (record.path.name for record in collected.worlds)
    shutil.rmtree(out / "shards" / collected.shards[1].path.name)
    shutil.copy(out / "worlds" / other / "esdf.npz", out / "worlds" / world / "esdf.npz")
    collect.run(config=small, out=out, worlds=2, jobs=1)
    assert all_bytes(out) == all_bytes(collected.folder)


def test_corpus_of_another_configuration_is_not_extended(small, collected):
    folder = collected.shards[0].path.parents[1]
    other = load_config(small, overrides=["flights=3"])
    with pytest.raises(ValueError, match="another configuration"):
        collect.run(config=other, out=folder, worlds=1)


P_WG = np.array([11.0, 4.0, 1.5])
AXES = np.array([[4.0, 2.5], [7.0, 5.5]])
RADIUS = 0.4


def labeler_of(radius: float = RADIUS) -> Labeler:
    """12 x 8 x 3 m of ground with two pillars."""
    shapes = [HalfSpace(np.array([0.0, 0.0, 1.0]), 0.0)]
    shapes += [Cylinder([x, y, -1], [x, y, 4], radius) for x, y in AXES]
    exact = AnalyticDistanceField(shapes, np.zeros(3), np.array([12.0, 8.0, 3.0]))
    return Labeler(esdf_from_distance_field(exact, 0.2), P_WG, ExpertConfig())


def test_half_of_the_states_are_before_a_pillar_and_none_in_one():
    labeler, count = labeler_of(), 400
    states = draw_off_path(labeler, count, 2.5, np.random.default_rng(0))
    assert states.shape == (count, 13)
    p_WB, v_WB = states[:, :3], states[:, 3:6]
    room = labeler.field.distance(p_WB) - VEHICLE_RADIUS
    assert room.min() > 0.0 and (p_WB >= 0.0).all()
    ahead = np.hypot(v_WB[:, 0], v_WB[:, 1])
    assert 1.5 < ahead.max() < 4.0
    assert (ahead - np.sqrt(6.0 * room) < 1.5).all()  # but for what goes sideways
    yaws, leans = [], []
    for state in states:
        R_WB = RotationMatrix(Quaternion(QuadrotorState.of(state).q_WB))
        roll, pitch, yaw = RollPitchYaw(R_WB).vector()
        yaws.append(yaw)
        leans += [roll, pitch]
    assert 0.08 < np.std(leans) < 0.16
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


def test_world_without_free_space_is_refused():
    labeler = labeler_of()
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
    return QuadrotorState(
        p_WB, [1.5, 0.4, -0.2], q_WB / np.linalg.norm(q_WB), np.zeros(3)
    ).to_vector()


STATES = [tilted_state(p) for p in ([1.5, 0.2, 2.0], [2.0, -0.5, 1.5])]


def see(world, labeler, bound=np.inf, config=CONFIG):
    demonstrations = keep_clear(labeler.labels(STATES), labeler.field)
    rng = np.random.default_rng(3)
    return demonstrations, render_samples(demonstrations, world, labeler, config, bound, rng)


def poses(samples) -> list[RigidTransform]:
    return [RigidTransform(Quaternion(wxyz=row[:4]), row[4:]) for row in samples.X_WB]


def test_labels_are_the_same_in_the_world_from_every_pose(world, labeler):
    demonstrations, samples = see(world, labeler)
    assert len(samples) == 6
    for k, X_WP in enumerate(poses(samples)):
        state, waypoints_W = demonstrations[k // 3]
        R_WP = X_WP.rotation().matrix()
        found = samples.trajectories_B[k] @ R_WP.T + X_WP.translation()
        np.testing.assert_allclose(found, waypoints_W, atol=1e-5)
        np.testing.assert_allclose(R_WP @ samples.v_B[k], state[3:6], atol=1e-6)
        to_goal = world.p_WG - X_WP.translation()
        np.testing.assert_allclose(R_WP @ samples.goal_B[k], to_goal, atol=1e-5)
    for k in (0, 3):
        assert poses(samples)[k].IsNearlyEqualTo(pose_from_state(STATES[k // 3]), 1e-9)


def test_images_are_taken_from_the_pose_that_is_recorded(world, labeler):
    _, samples = see(world, labeler)
    camera = CONFIG.camera
    for k, X_WP in enumerate(poses(samples)):
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


@pytest.mark.parametrize(("bound", "farthest"), [(np.inf, 0.3), (0.1, 0.1), (0.0, 0.0)])
def test_perturbations_keep_the_bound_of_the_world(world, labeler, bound, farthest):
    _, samples = see(world, labeler, bound)
    moved = [
        np.linalg.norm(X.translation() - STATES[k // 3][:3]) for k, X in enumerate(poses(samples))
    ]
    assert max(moved) <= farthest + 1e-9
    assert max(moved) > 0.4 * farthest or farthest == 0.0


def test_perturbations_keep_clear_of_obstacles(world, labeler):
    config = replace(CONFIG, perturbation=PerturbationConfig(copies=50, distance=1.0))
    state = tilted_state([5.0, 0.0, 0.5])  # 0.15 m of clearance above the floor of the hall
    demonstration = Demonstration(state, np.zeros((3, 10, 3)))
    rng = np.random.default_rng(0)
    samples = render_samples([demonstration], world, labeler, config, np.inf, rng)
    moved = np.linalg.norm(samples.X_WB[:, 4:] - state[:3], axis=1)
    assert 0.05 < moved.max() <= 0.5 - 0.354 + 1e-9


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
    _, plain = see(world, labeler)
    config = replace(CONFIG, appearance=1.0, perturbation=PerturbationConfig(copies=0))
    _, other = see(world, labeler, config=config)
    np.testing.assert_array_equal(plain.depth[::3], other.depth)
    assert np.abs(plain.color[::3].astype(int) - other.color).max() > 10
