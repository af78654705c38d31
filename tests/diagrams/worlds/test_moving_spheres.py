from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.flight.sensors import make_onboard_camera
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds import moving_spheres as dodgedrone
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.moving_bodies import Bodies

EASY = dodgedrone.DodgeDroneConfig(level="easy", voxel_size=1.0)


@pytest.fixture(scope="module")
def course() -> World:
    return make_world(EASY, 1)


def sphere_depth(rays_W, p_WC, forward, centers, radii) -> np.ndarray:
    """Planar depths (n,) at which rays (n, 3) from p_WC meet spheres before the ground."""
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
def test_spheres_are_seen_where_they_are_hit(course, time):
    config = OnboardCamera(width=96, height=72)
    camera = make_onboard_camera(config, course)
    seen = []
    for obstacle in dodgedrone.draw_obstacles(dodgedrone.LEVELS["easy"], dodgedrone.SEED + 1):
        last = len(obstacle.path) - 1
        row = round(time / 0.02) % max(2 * last, 1)
        center = obstacle.path[min(row, 2 * last - row)]
        if np.isfinite(center).all():
            seen.append((center, obstacle.radius, last > 0))
    centers, radii, moves = map(np.array, zip(*seen, strict=True))
    assert sum(moves) >= 5
    wrong, pixels = 0, 0
    for sphere in np.flatnonzero(moves):
        p_WC = centers[sphere] - [radii[sphere] + 2.0, 0.0, 0.0]
        if p_WC[2] < 0.3 or (np.linalg.norm(centers - p_WC, axis=1) < radii + 0.3).any():
            continue
        X_WC = RigidTransform(p_WC) @ config.mount()
        rays_W = config.ray_slopes().reshape(-1, 3) @ X_WC.rotation().matrix().T
        truth = sphere_depth(rays_W, X_WC.translation(), np.array([1.0, 0, 0]), centers, radii)
        seen = camera.render(RigidTransform(p_WC), Bodies(time, course.moving)).depth.ravel()
        near = truth < 8.0
        wrong += (np.abs(seen - truth) > np.maximum(0.1, 0.05 * truth))[near].sum()
        pixels += near.sum()
    assert pixels > 3000 and wrong < 0.005 * pixels, wrong / pixels


def test_a_course_repeats(course):
    config = replace(EASY, first_seed=dodgedrone.SEED + 1)
    again, same = dodgedrone.dodgedrone_world(config, 0), dodgedrone.dodgedrone_world(EASY, 1)
    for time in (0.0, 11.0):
        np.testing.assert_array_equal(
            again.moving.spheres.centers(time), course.moving.spheres.centers(time)
        )
    np.testing.assert_array_equal(same.gaussians.sh, course.gaussians.sh)


@pytest.mark.parametrize("level", dodgedrone.LEVELS)
def test_scenarios_have_the_rules(level, course):
    scenario = load_config(Scenario(), scenario_file(f"dodgedrone_{level}"))
    assert scenario.world.level == level
    assert (scenario.timeout, scenario.goal_radius) == (40.0, 3.0)
    assert course.p_WG[0] - scenario.goal_radius == 60.0
    field = course.distance_field
    np.testing.assert_array_equal([field.lower_W, field.upper_W], [[-5, -10, 0], [65, 10, 10]])
    np.testing.assert_allclose(sample_initial_state(scenario, course)[:3], [0, 0, 1], atol=0.1)


# Rows of obstacle lists that are stored with the challenge's simulator (uzh-rpg/flightmare) and
# forks of it: number of the obstacle, diameter [m], first center [m] (1000: it is kept away).
STORED = {
    ("easy", 22529): [
        (0, 1.7092899476763004, (4.63952056641906, -5.669700374657429, 4.333575990782115)),
        (60, 1.0074286771858323, (1000.0, 1000.0, 1000.0)),
        (84, 1.1274644423671938, (44.98057081303121, 4.810357990896751, 2.181186728448353)),
    ],
    ("medium", 27469): [
        (384, 0.5150307511451736, (43.147159260328216, 3.8491098675457973, 6.525908735571837)),
        (599, 1.4018272441167043, (53.69509398342851, 5.8699792077346675, 4.516849228330558)),
    ],
    ("hard", 8623): [
        (0, 1.4466261137353964, (9.334681554236099, -5.576885046307531, 4.360361731106545)),
        (246, 1.0116368357684637, (17.772277793823278, 3.3030033374579926, 5.832188507731959)),
        (755, 1.050068975131838, (53.55140593558972, -2.0286958992173734, 3.615433142021099)),
    ],
}


@pytest.mark.parametrize(("level", "seed"), STORED)
def test_agrees_with_the_stored_lists(level, seed):
    obstacles = dodgedrone.draw_obstacles(dodgedrone.LEVELS[level], seed)
    for number, diameter, place in STORED[level, seed]:
        obstacle = obstacles[number]
        assert 2 * obstacle.radius == pytest.approx(diameter, rel=1e-14)
        first = np.where(np.isinf(obstacle.path[0]), 1000.0, obstacle.path[0])
        np.testing.assert_allclose(first, place, rtol=1e-13)


def test_an_accelerated_path_agrees_with_the_stored_one():
    upper = 60.0, 10.0, 10.0
    groups = (
        dodgedrone.Group(744, (0.0, -10.0, 0.0), upper, (0.1, 3.0)),
        dodgedrone.Group(88, (20.0, -10.0, 0.0), upper, (0.5, 2.0), (5.0, 5.0, 2.0)),
        dodgedrone.Group(244, (40.0, -10.0, 0.0), upper, (0.1, 3.0)),
        dodgedrone.Group(44, (40.0, -10.0, 0.0), upper, (0.5, 1.5), (1.0, 1.0, 1.0), 30.0),
    )
    obstacle = dodgedrone.draw_obstacles(groups, dodgedrone.SEED)[744 + 88 + 244 + 40]
    assert 2 * obstacle.radius == pytest.approx(1.3379624605997786, rel=1e-14)
    assert len(obstacle.path) == 71
    stored = {
        0: (4.557431555988881655e01, -3.916509373218442391, 9.087675706341988402),
        1: (4.555421826652278128e01, -3.931329038348782667, 9.089614485060415916),
        35: (4.340031645496776491e01, -5.966700456254084628, 8.873795197671718427),
        70: (4.155339438602842250e01, -9.957823933506649183, 8.570482101580431333),
    }
    for row, place in stored.items():
        np.testing.assert_allclose(obstacle.path[row], place, rtol=1e-12)


@pytest.mark.parametrize("level", dodgedrone.LEVELS)
def test_nothing_is_near_start_and_target(level):
    for obstacle in dodgedrone.draw_obstacles(dodgedrone.LEVELS[level], 3):
        x, y, z = obstacle.path.T
        near = (abs(y) < 3) & (z > 0) & (z < 5)
        assert not (near & ((abs(x) < 3) | (abs(x - 59) < 2))).any()
        there = obstacle.path[1:][np.isfinite(obstacle.path[1:]).all(axis=1)]
        assert (there >= [0, -10, 0]).all() and (there <= [60, 10, 10]).all()
