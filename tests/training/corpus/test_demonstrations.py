from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform

from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state
from splatpilot.training.corpus.collect import Demonstration, keep_clear, render_samples
from splatpilot.training.corpus.corpus import CorpusConfig
from splatpilot.training.corpus.expert import ExpertConfig, Label, Labeler
from splatpilot.training.corpus.library import PerturbationConfig

BALL = np.array([5.0, 1.2, 2.6])  # p_W, ahead, to the left and above of the states below
CONFIG = CorpusConfig(
    camera=OnboardCamera(width=160, height=120),
    perturbation=PerturbationConfig(copies=2, distance=0.3, yaw=0.2, tilt=0.1),
    appearance=0.0,
)


@pytest.fixture(scope="module")
def world() -> World:
    """A small white ball in a black hall without walls, 10 x 6 x 4 m."""
    free = np.zeros((50, 30, 20), bool)
    esdf = esdf_from_occupancy(free, free, np.array([0.0, -3.0, 0.0]), 0.2)
    one = np.ones((1, 3))
    return World(
        name="hall",
        gaussians=GaussianScene.from_colors([BALL], [[1, 0, 0, 0]], 0.05 * one, [0.99], one),
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
        forward, left, up = X_WP.inverse().multiply(BALL) - np.array(camera.p_BC)
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


def test_trajectories_that_touch_something_are_no_demonstrations(labeler):
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


def test_a_look_changes_colors_and_not_depth(world, labeler):
    _, plain = see(world, labeler)
    config = replace(CONFIG, appearance=1.0, perturbation=PerturbationConfig(copies=0))
    _, other = see(world, labeler, config=config)
    np.testing.assert_array_equal(plain.depth[::3], other.depth)
    assert np.abs(plain.color[::3].astype(int) - other.color).max() > 10
