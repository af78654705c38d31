from dataclasses import replace

import numpy as np
import pytest

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.simulation import unobserved_fraction
from splatpilot.diagrams.worlds import observed_routes, scene_folder
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.collision.observations import Observations
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.training.captures.coverage import look_along

STEP = 0.1  # [m]


@pytest.fixture(scope="module")
def capture(box_room):
    def capture(positions: list[float]) -> World:
        """A hall, captured by cameras at some x [m] that look along +x."""
        room = box_room(12.0, 3.0, 3.0)
        poses = [look_along(np.array([x, 1.5, 1.5]), 0.0, 0.0) for x in positions]
        depths = [room.depth(X_WC) for X_WC in poses]
        observations = Observations.from_depth_images(depths, room.K, poses, STEP)
        occupied = np.zeros((124, 34, 34), bool)
        for axis in range(3):
            occupied.swapaxes(0, axis)[[0, 1, -2, -1]] = True
        esdf = esdf_from_occupancy(occupied, np.zeros_like(occupied), np.full(3, -2 * STEP), STEP)
        ends = np.array([2.0, 1.5, 1.5]), np.array([9.0, 1.5, 1.5])
        gaussians, black = room.gaussians(STEP, scale=0.6), (0.0, 0.0, 0.0)
        world = World("hall", gaussians, esdf, esdf, black, *ends, observations=observations)
        return observed_routes.with_views(world)

    return capture


@pytest.fixture(scope="module")
def hall(capture) -> World:
    return capture([0.3, 1.5, 3.0, 4.5, 6.0, 7.5, 9.0])


@pytest.mark.parametrize("seed", [None, 0])
def test_routes_lead_where_the_capture_looked(hall, seed):
    route = observed_routes.choose_observed_route(hall, limit=0.05, seed=seed)
    assert route.p_WG[0] - route.p_WS[0] > 4.0
    assert route.unobserved <= 0.05


def test_views_as_captured_are_observed_and_views_back_and_of_the_frontier_are_not(hall):
    p_WB = np.array([8.0, 1.5, 1.5])
    assert observed_routes.ObservedViews(hall).ahead(p_WB, 0.0) < 0.02
    assert observed_routes.ObservedViews(hall).ahead(p_WB, np.pi) > 0.3
    wall = hall.gaussians.means[:, 0] > 11.99
    order = np.argsort(wall, kind="stable")
    names = ("means", "quats", "scales", "opacities", "sh")
    ordered = {name: getattr(hall.gaussians, name)[order] for name in names}
    gaussians = replace(hall.gaussians, **ordered)
    closed = replace(hall, gaussians=gaussians, num_frontier=int(wall.sum()))
    # The wall of 3 m x 3 m is 3.9 m ahead of the camera; its edges blend with the walls beside it.
    inner, outer = ((side / 3.9) ** 2 / (2.0 * 1.5) for side in (2.2, 3.0))
    assert inner < observed_routes.ObservedViews(closed).ahead(p_WB, 0.0) < outer + 0.02


def test_a_capture_that_covers_too_little_is_infeasible(capture, monkeypatch):
    monkeypatch.setattr(observed_routes, "_STARTS", 4)
    hall = capture([11.0])
    with pytest.raises(InfeasibleFlightError, match=r"at most 2%.*capture more"):
        observed_routes.choose_observed_route(hall, seed=0)
    assert observed_routes.choose_default_route(hall).unobserved > 0.1


def test_ends_are_drawn_by_the_scene_file(hall, tmp_path):
    scene_folder.write_scene_folder(tmp_path / "hall", hall, provenance="")
    config = scene_folder.SceneConfig(
        path=str(tmp_path / "hall"), draw_ends=True, max_unobserved=0.05
    )
    drawn = scene_folder.read_scene_world(config, 0)
    assert drawn.p_WG[0] - drawn.p_WS[0] > 4.0
    (tmp_path / "hall" / "observations.npz").unlink()
    assert scene_folder.read_scene(tmp_path / "hall").observations is None


def test_fraction_of_a_flight(hall):
    states = np.array([hover_state(np.array([x, 1.5, 1.5]), yaw=0.0) for x in (3.0, 4.0)])
    assert unobserved_fraction(Scenario(), hall, states) < 0.02
    unknown = replace(hall, observations=None)
    assert np.isnan(unobserved_fraction(Scenario(), unknown, states))
