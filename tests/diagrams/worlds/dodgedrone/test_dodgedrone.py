import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.diagrams.flight.flight import sample_initial_state
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.sensors import make_camera
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds.dodgedrone import (
    LEVELS,
    SEED,
    DodgeDroneConfig,
    dodgedrone_world,
    draw_obstacles,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.sensing.onboard_camera import OnboardCamera

EASY = DodgeDroneConfig(level="easy", voxel_size=0.5)


@pytest.fixture(scope="module")
def course() -> World:
    return make_world(EASY, 1)


def ball_depth(rays_W, p_WC, forward, centers, radii) -> np.ndarray:
    """Planar depths (n,) at which rays (n, 3) from p_WC meet balls; infinite where the ground is
    met first, or nothing."""
    rays = rays_W / (rays_W @ forward)[:, None]  # of planar length 1
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(rays[:, 2] < 0, -p_WC[2] / rays[:, 2], np.inf)
        depth = np.full(len(rays), np.inf)
        for center, radius in zip(centers, radii, strict=True):
            to_center = center - p_WC
            a, b = (rays**2).sum(axis=1), rays @ to_center
            root = b**2 - a * (to_center @ to_center - radius**2)
            hit = (b - np.sqrt(root)) / a
            depth = np.where((root > 0) & (hit > 0), np.minimum(depth, hit), depth)
    return np.where(depth < ground, depth, np.inf)


@pytest.mark.parametrize("time", [0.0, 3.3])
def test_balls_are_seen_where_they_are_hit(course, time):
    obstacles = draw_obstacles(LEVELS["easy"], SEED + 1)
    config = OnboardCamera(width=96, height=72)
    camera = make_camera(config, course)
    step = round(time / 0.02)
    centers, radii = [], []
    for obstacle in obstacles:
        last = len(obstacle.path) - 1
        row = step % max(2 * last, 1)
        centers.append(obstacle.path[min(row, 2 * last - row)])
        radii.append(obstacle.radius)
    centers, radii = np.array(centers), np.array(radii)
    present = np.isfinite(centers).all(axis=1)
    centers, radii = centers[present], radii[present]
    moving = np.flatnonzero([len(o.path) > 1 for o in np.array(obstacles)[present]])
    assert len(moving) >= 5
    rng = np.random.default_rng(0)
    p_WQ = rng.uniform(course.distance_field.lower_W, course.distance_field.upper_W, (300, 3))
    to_balls = np.linalg.norm(p_WQ[:, None] - centers, axis=2) - radii
    np.testing.assert_allclose(
        course.field_at(time).distance(p_WQ), np.minimum(to_balls.min(axis=1), p_WQ[:, 2])
    )
    wrong, pixels = 0, 0
    for ball in moving:
        p_WC = centers[ball] - [radii[ball] + 2.0, 0.0, 0.0]
        if p_WC[2] < 0.3 or (np.linalg.norm(centers - p_WC, axis=1) < radii + 0.3).any():
            continue
        X_WC = RigidTransform(p_WC) @ config.X_BC()
        rays_W = config.ray_slopes().reshape(-1, 3) @ X_WC.rotation().matrix().T
        truth = ball_depth(rays_W, X_WC.translation(), np.array([1.0, 0, 0]), centers, radii)
        seen = camera.render(RigidTransform(p_WC), time).depth.ravel()
        near = truth < 8.0
        wrong += (np.abs(seen - truth) > np.maximum(0.1, 0.05 * truth))[near].sum()
        pixels += near.sum()
    assert pixels > 3000 and wrong < 0.005 * pixels, wrong / pixels


def test_a_course_repeats(course):
    again = dodgedrone_world(DodgeDroneConfig("easy", first_seed=SEED + 1, voxel_size=0.5), 0)
    assert again.moving and course.moving
    for time in (0.0, 11.0):
        np.testing.assert_array_equal(
            again.moving.spheres.centers(time), course.moving.spheres.centers(time)
        )
    same = dodgedrone_world(EASY, 1)
    assert same.moving
    np.testing.assert_array_equal(same.gaussians.means, course.gaussians.means)
    np.testing.assert_array_equal(same.gaussians.sh, course.gaussians.sh)
    for one, two in zip(
        same.moving.gaussians.at(2.0), course.moving.gaussians.at(2.0), strict=True
    ):
        np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("level", LEVELS)
def test_scenarios_have_the_rules(level, course):
    scenario = load_config(Scenario(), scenario_file(f"dodgedrone_{level}"))
    scenario.validate()
    assert scenario.world.level == level
    assert (scenario.timeout, scenario.goal_radius) == (40.0, 3.0)
    assert course.p_WG[0] - scenario.goal_radius == 60.0
    np.testing.assert_array_equal(course.distance_field.lower_W, [-5, -10, 0])
    np.testing.assert_array_equal(course.distance_field.upper_W, [65, 10, 10])
    np.testing.assert_allclose(sample_initial_state(scenario, course)[:3], [0, 0, 1], atol=0.1)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"level": "medium!"}, "level must be in {easy, medium, hard}, got medium!"),
        ({"first_seed": -1}, "first_seed must be .* got -1"),
        ({"voxel_size": 0.0}, "voxel_size must be .* got 0.0"),
    ],
)
def test_impossible_courses_are_refused(changes, match):
    with pytest.raises(ValueError, match=match):
        make_world(DodgeDroneConfig(**changes), 0)
