from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.simulation import unobserved_fraction
from splatpilot.diagrams.worlds.observed_routes import (
    ObservedViews,
    choose_default_route,
    choose_observed_route,
    with_views,
)
from splatpilot.diagrams.worlds.scene_folder import (
    SceneConfig,
    read_scene,
    read_scene_world,
    write_scene_folder,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.collision.observations import Observations
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor import hover_state

SIZE = np.array([12.0, 3.0, 3.0])  # [m] of a hall with its corner in the origin
K = np.array([[80.0, 0.0, 80.0], [0.0, 80.0, 60.0], [0.0, 0.0, 1.0]])
X_BC = RigidTransform(RollPitchYaw(-np.pi / 2, 0.0, -np.pi / 2), np.zeros(3))
STEP = 0.1


def hall_depth(X_WC: RigidTransform) -> np.ndarray:
    """(120, 160) [m] to the walls of the hall."""
    x, y = np.meshgrid((np.arange(160) - 79.5) / 80.0, (np.arange(120) - 59.5) / 80.0)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ X_WC.rotation().matrix().T
    with np.errstate(divide="ignore"):
        ends = np.stack([(end - X_WC.translation()) / rays for end in (np.zeros(3), SIZE)])
    return ends.max(axis=0).min(axis=-1).astype(np.float32)


def hall_walls() -> GaussianScene:
    axes, sides = [np.arange(STEP / 2, length, STEP) for length in SIZE], []
    for axis, length in enumerate(SIZE):
        for at in (0.0, length):
            grids = [np.array([at]) if a == axis else axes[a] for a in range(3)]
            sides.append(np.stack(np.meshgrid(*grids, indexing="ij"), -1).reshape(-1, 3))
    means = np.concatenate(sides)
    count = len(means)
    quats, scales = np.tile([1, 0, 0, 0], (count, 1)), np.full((count, 3), 0.6 * STEP)
    return GaussianScene.from_colors(
        means, quats, scales, np.full(count, 0.99), np.full((count, 3), 0.3)
    )


def captured_hall(positions: list[float]) -> World:
    """The hall, captured by cameras at some x [m] that look along +x."""
    poses = [RigidTransform([x, 1.5, 1.5]) @ X_BC for x in positions]
    depths = [hall_depth(X_WC) for X_WC in poses]
    observations = Observations.from_depth_images(depths, K, poses, STEP)
    occupied = np.zeros((124, 34, 34), bool)
    for axis in range(3):
        occupied.swapaxes(0, axis)[[0, 1, -2, -1]] = True
    esdf = esdf_from_occupancy(occupied, np.zeros_like(occupied), np.full(3, -2 * STEP), STEP)
    ends = np.array([2.0, 1.5, 1.5]), np.array([9.0, 1.5, 1.5])
    gaussians = hall_walls()
    black = (0.0, 0.0, 0.0)
    return World("hall", gaussians, esdf, esdf, black, *ends, observations=observations)


@pytest.fixture(scope="module")
def hall() -> World:
    return with_views(captured_hall([0.3, 1.5, 3.0, 4.5, 6.0, 7.5, 9.0]))


def test_views_as_captured_are_observed_and_views_back_are_not(hall):
    views = ObservedViews(hall)
    assert views.ahead(np.array([3.0, 1.5, 1.5]), 0.0) < 0.02
    assert views.ahead(np.array([9.0, 1.5, 1.5]), np.pi) > 0.3


@pytest.mark.parametrize("seed", [None, 0, 1, 2])
def test_routes_lead_where_the_capture_looked(hall, seed):
    route = choose_observed_route(hall, limit=0.05, seed=seed)
    assert route.p_WG[0] - route.p_WS[0] > 4.0
    assert route.unobserved <= 0.05


def test_frontier_is_unobserved(hall):
    wall = hall.gaussians.means[:, 0] > SIZE[0] - 0.01
    order = np.argsort(wall, kind="stable")
    names = ("means", "quats", "scales", "opacities", "sh")
    gaussians = replace(
        hall.gaussians, **{name: getattr(hall.gaussians, name)[order] for name in names}
    )
    closed = replace(hall, gaussians=gaussians, num_frontier=int(wall.sum()))
    p_WB = np.array([8.0, 1.5, 1.5])
    # The wall of 3 m x 3 m is 3.9 m ahead of the camera; its edges blend with the walls beside it.
    inner, outer = ((side / 3.9) ** 2 / (2.0 * 1.5) for side in (2.2, 3.0))
    assert ObservedViews(hall).ahead(p_WB, 0.0) < 0.02
    assert inner < ObservedViews(closed).ahead(p_WB, 0.0) < outer + 0.02


def test_a_capture_that_covers_too_little_is_infeasible():
    hall = with_views(captured_hall([11.0]))
    with pytest.raises(InfeasibleFlightError, match=r"at most 2%.*capture more"):
        choose_observed_route(hall, seed=0)
    assert choose_default_route(hall).unobserved > 0.1


def test_ends_are_drawn_by_the_scene_file(hall, tmp_path):
    write_scene_folder(tmp_path / "hall", hall, provenance="")
    config = SceneConfig(path=str(tmp_path / "hall"), draw_ends=True, max_unobserved=0.05)
    drawn = read_scene_world(config, 0)
    assert drawn.p_WG[0] - drawn.p_WS[0] > 4.0
    (tmp_path / "hall" / "observations.npz").unlink()
    assert read_scene(tmp_path / "hall").observations is None


def test_fraction_of_a_flight(hall):
    states = np.array([hover_state(np.array([x, 1.5, 1.5]), yaw=0.0) for x in (3.0, 4.0)])
    assert unobserved_fraction(Scenario(), hall, states) < 0.02
    unknown = replace(hall, observations=None)
    assert np.isnan(unobserved_fraction(Scenario(), unknown, states))
