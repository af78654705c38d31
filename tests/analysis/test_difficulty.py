import numpy as np
import pytest
from pydrake.math import RigidTransform

import splatpilot as sp
from splatpilot.analysis import difficulty as difficulty_module
from splatpilot.analysis.difficulty import (
    SPACING,
    angle_over_length,
    bottleneck,
    difficulty,
    march,
    path_length,
    relative_gap_size,
    resample,
    run,
    shortest_path,
    traversability,
    traversability_obstacle,
    view_obstacle,
)
from splatpilot.diagrams.worlds.feasibility import grid_distances
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, Capsule
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS as R

LOWER, UPPER = np.array([0.0, -4, 0]), np.array([12.0, 4, 4])
EMPTY = AnalyticDistanceField([], LOWER, UPPER)
START, GOAL = np.array([1.5, 0.1, 2.0]), np.array([10.5, 0.1, 2.0])


def wall(low: float, high: float) -> Box:
    """A thin wall across the volume at x = 6, from y = low to high."""
    return Box(RigidTransform([6.0, (low + high) / 2, 2.0]), [0.2, high - low, 8.0])


CLOSED = AnalyticDistanceField([wall(-4.5, 4.5)], LOWER, UPPER)


def test_an_empty_volume_is_easy():
    measured = difficulty(EMPTY, START, GOAL)
    assert measured.detour_ratio == pytest.approx(1.0, abs=1e-9)
    assert measured.angle_over_length == 0.0
    assert measured.view_obstacle == 0.0
    assert np.isnan(measured.relative_gap_size)
    # The ends are 1.5 m from the bounds.
    assert measured.bottleneck_m == pytest.approx(1.5 - R, abs=0.15)


def test_detour_and_bend_around_a_wall_are_those_of_the_triangle():
    field = AnalyticDistanceField([wall(-4.0, 1.0)], LOWER, UPPER)
    path = shortest_path(field, grid_distances(field, SPACING), START, GOAL)
    assert (field.distance(resample(path, 0.02)) > R - 1e-3).all()
    side = np.hypot(4.5, 0.9 + R)
    assert path_length(path) == pytest.approx(2 * side, rel=0.03)
    assert angle_over_length(np.array([START, [6, 1.0 + R, 2], GOAL])) == pytest.approx(
        np.expm1(2 / np.pi * 2 * np.arctan2(0.9 + R, 4.5)) / (2 * side)
    )


@pytest.mark.parametrize("gap", [1.2, 2.0])
def test_bottleneck_is_half_the_gap(gap):
    field = AnalyticDistanceField([wall(-4.0, -gap / 2), wall(gap / 2, 4.0)], LOWER, UPPER)
    found = bottleneck(field, grid_distances(field, SPACING), START, GOAL)
    assert 0 <= gap / 2 - R - found < SPACING / 2 + 0.02


def test_traversability_of_an_empty_volume_is_the_mean_distance_to_its_bounds():
    rng = np.random.default_rng(0)
    p, angle = rng.uniform(LOWER + R, UPPER - R, (20000, 3)), rng.uniform(0, 2 * np.pi, 20000)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    lengths = np.where(direction > 0, UPPER[:2] - p[:, :2], LOWER[:2] - p[:, :2]) / direction
    exact = lengths.min(axis=1) / R
    found = traversability(EMPTY, np.random.default_rng(1), samples=3000)
    assert found == pytest.approx(exact.mean(), abs=3 * exact.std() / np.sqrt(3000))


def test_relative_gap_size_is_that_between_posts():
    # 2 m axis to axis, radius 0.3: gaps of 1.4 m over a diameter of 0.708 m.
    posts = [Capsule([x, 0.05, -1], [x, 0.05, 5], 0.3) for x in (2.05, 4.05, 6.05, 8.05)]
    field = AnalyticDistanceField(posts, LOWER, UPPER)
    assert relative_gap_size(field, 2.0) == pytest.approx(1.4 / (2 * R), abs=0.12 / (2 * R))


def test_traversability_obstacle_is_range_over_diameter_in_a_tunnel():
    lower, upper = np.array([0.0, -1, 0]), np.array([20.0, 1, 2])
    tunnel = AnalyticDistanceField([], lower, upper)
    path = np.array([[2.0, 0, 1], [18.0, 0, 1]])
    assert traversability_obstacle(tunnel, path) == pytest.approx(4.0 / (2 * (1 - R)), rel=1e-6)


def test_view_obstacle_of_a_wall_ahead():
    path = np.array([[2.9, 0.0, 2.0], [3.3, 0.0, 2.0]])
    middles = np.pi * np.array([(1 / 5 + 1 / 6) / 2, (1 / 6 + 1 / 8) / 2, (1 / 8 + 1 / 12) / 2])
    rays = 3.0 / np.array([*np.cos(middles), 1.0])
    expected = np.sum(np.array([0.05, 0.1, 0.3, 0.55]) * 4.0 / rays)
    assert view_obstacle(CLOSED, path) == pytest.approx(expected, rel=0.01)


@pytest.fixture
def small(tmp_path, monkeypatch) -> str:
    """A scenario in a small room, without scenes."""
    monkeypatch.setenv("SPLATPILOT_SCENES", str(tmp_path))
    file = tmp_path / "small.yaml"
    file.write_text("world: !RoomConfig {length: 6, width: 4, height: 2.6, items: 1}\n")
    return str(file)


def test_infeasible_seeds_are_counted_and_a_missing_scene_is_not_run(small, monkeypatch, capsys):
    def lines(**options) -> list[str]:
        run(**options)
        return capsys.readouterr().out.splitlines()

    infeasible = {1}

    def make(config, seed):
        if seed in infeasible:
            raise sp.InfeasibleFlightError("no path")
        return sp.make_world(config, seed)

    monkeypatch.setattr(difficulty_module, "make_world", make)
    _, measured, absent = lines(scenarios=[small, "R13"], seeds=3)
    assert "2/3" in measured and "not run" in absent and "TartanAir" in absent
    infeasible.add(0)
    assert "0/2" in lines(scenarios=[small], seeds=2)[1]
    infeasible.clear()
    # Seed 0 has one obstacle, and no gap.
    assert "nan" not in lines(scenarios=["P12"], seeds=2)[1]


def test_a_closed_wall_leaves_no_path():
    with pytest.raises(sp.InfeasibleFlightError, match="no path"):
        shortest_path(CLOSED, grid_distances(CLOSED, SPACING), START, GOAL)


def test_march_stops_at_walls_and_bounds():
    x = np.array([[1.0, 0.0, 0.0]])
    start = np.array([[1.0, 0.0, 2.0]])
    assert march(CLOSED, start, x, R, 99.0) == pytest.approx([4.9 - R], abs=0.011)
    assert march(CLOSED, start, -x, 0.0, 99.0) == pytest.approx([1.0], rel=1e-12)
    assert march(CLOSED, start, -x, R, 99.0) == pytest.approx([1.0], rel=1e-12)
    slanted = np.array([[-0.6, 0.8, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, -1.0]])
    lengths = march(CLOSED, start.repeat(3, axis=0), slanted, 0.0, 99.0)
    assert lengths == pytest.approx([1.0 / 0.6, 2.0 / 0.8, 2.0], rel=1e-12)
    assert march(CLOSED, start, x, R, 2.0) == [2.0]
