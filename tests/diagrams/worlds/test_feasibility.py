import numpy as np
import pytest

from splatpilot.diagrams.worlds.feasibility import (
    choose_start_and_goal,
    connects,
    short_route_warning,
)
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Capsule
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.policies.lattice import LatticeConfig
from splatpilot.systems.policies.time_of_arrival import time_of_arrival
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS


def corridors(*boxes, unknown=(), size=(60, 60, 20), voxel_size=0.1):
    """A solid block of voxels with free (or unknown) boxes, given in meters as (lower, upper)."""
    occupied = np.ones(size, bool)
    hidden = np.zeros(size, bool)
    for grid, value, some in ((occupied, False, (*boxes, *unknown)), (hidden, True, unknown)):
        for lower, upper in some:
            first, last = (np.round(np.array(x) / voxel_size).astype(int) for x in (lower, upper))
            grid[tuple(slice(a, b) for a, b in zip(first, last, strict=True))] = value
    return esdf_from_occupancy(occupied, hidden, np.zeros(3), voxel_size)


ALONG_X = ((0.2, 0.2, 0.2), (5.8, 1.8, 1.8))
ALONG_Y = ((4.2, 0.2, 0.2), (5.8, 5.8, 1.8))


def test_length_is_measured_around_the_corner():
    p_WS, p_WG, length = choose_start_and_goal(corridors(ALONG_X, ALONG_Y), margin=0.1)
    straight = np.linalg.norm(p_WS - p_WG)
    assert straight < length < 9
    ends = np.array(sorted([p_WS.tolist(), p_WG.tolist()]))
    assert ends[0, 0] < 1 and ends[1, 1] > 5


def test_unknown_space_is_not_flown_through():
    esdf = corridors(ALONG_X, unknown=[((1.5, 0.2, 0.2), (2.0, 1.8, 1.8))])
    p_WS, p_WG, _ = choose_start_and_goal(esdf, margin=0.1)
    assert min(p_WS[0], p_WG[0]) > 2.0 + VEHICLE_RADIUS


def test_narrow_corridors_get_less_margin():
    esdf = corridors(((0.2, 0.2, 0.2), (5.8, 1.3, 1.3)))
    p_WS, p_WG, length = choose_start_and_goal(esdf)
    assert length > 3
    assert (esdf.conservative().distance(np.array([p_WS, p_WG])) > VEHICLE_RADIUS + 0.1).all()
    times = time_of_arrival(esdf.conservative(), p_WG, LatticeConfig().margin)
    assert times.is_reachable(p_WS)


def test_the_longer_route_is_chosen_not_the_larger_part():
    hall = ((0.2, 0.2, 0.2), (3.2, 3.2, 3.2))
    corridor = ((4.0, 0.2, 0.2), (5.3, 9.8, 1.5))
    esdf = corridors(hall, corridor, size=(60, 100, 40))
    for seed in (None, 0):
        p_WS, p_WG, length = choose_start_and_goal(esdf, seed=seed)
        assert min(p_WS[0], p_WG[0], length) > 4.0


def test_half_of_the_margin_is_taken_for_a_much_longer_route():
    rooms = [((x, 0.2, 0.2), (x + 1.8, 2.0, 2.0)) for x in (0.2, 4.0, 7.8)]
    doors = [((x, 0.6, 0.6), (x + 2.0, 1.7, 1.7)) for x in (2.0, 5.8)]
    esdf = corridors(*rooms, *doors, size=(100, 22, 22))
    _, _, length = choose_start_and_goal(esdf)
    assert length > 8.0 and not short_route_warning(length)
    assert "5.0 m" in short_route_warning(5.0)


@pytest.mark.parametrize("upper", [(5.8, 0.7, 0.7), (1.8, 1.4, 1.4)])
@pytest.mark.parametrize("seed", [None, 0])
def test_space_too_narrow_for_a_route_is_refused(upper, seed):
    message = r"radius 0\.354 m .* at least 1 m, got 0\.\d\d m; the largest clearance is 0\.\d\d m"
    with pytest.raises(InfeasibleFlightError, match=message):
        choose_start_and_goal(corridors(((0.2, 0.2, 0.2), upper)), seed=seed)


def test_drawn_ends_keep_the_minimum_distance():
    esdf = corridors(ALONG_X, ALONG_Y)
    _, _, longest = choose_start_and_goal(esdf)
    for seed in range(2):
        _, _, length = choose_start_and_goal(esdf, min_length=0.8 * longest, seed=seed)
        assert 0.8 * longest <= length <= longest + 1e-9
    with pytest.raises(InfeasibleFlightError, match=r"at least 50 m, got \d\.\d+ m"):
        choose_start_and_goal(esdf, min_length=50.0, seed=0)


def test_a_net_of_wires_between_grid_points_blocks_the_path():
    lower, upper = np.array([0.0, -1.5, 0]), np.array([8.0, 1.5, 3])
    ends = np.array([1.5, 0, 1.5]), np.array([6.5, 0, 1.5])
    net = [Capsule([4.0, y, -1], [4.0, y, 4], 0.01) for y in np.arange(-1.3, 1.5, 0.52)]
    assert connects(AnalyticDistanceField([], lower, upper), *ends, VEHICLE_RADIUS, 0.15)
    assert not connects(AnalyticDistanceField(net, lower, upper), *ends, VEHICLE_RADIUS, 0.15)
