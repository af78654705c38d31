"""Difficulty measures where they are known in closed form."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.analysis import difficulty as difficulty_module
from splatpilot.analysis.commands.main import main
from splatpilot.analysis.difficulty import (
    SPACING,
    angle_over_length,
    bottleneck,
    difficulty,
    path_length,
    relative_gap_size,
    resampled,
    run,
    shortest_path,
    traversability,
    traversability_obstacle,
    view_obstacle,
)
from splatpilot.diagrams.worlds.feasibility import grid_distances
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, Capsule
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS as R

LOWER, UPPER = np.array([0.0, -4, 0]), np.array([12.0, 4, 4])
EMPTY = AnalyticDistanceField([], LOWER, UPPER)
UP = np.array([0.0, 0, 1])
START, GOAL = np.array([1.5, 0.1, 2.0]), np.array([10.5, 0.1, 2.0])


def wall(low: float, high: float) -> Box:
    """Across the volume at x = 6, from y = low to high, thin."""
    return Box(RigidTransform([6.0, (low + high) / 2, 2.0]), [0.2, high - low, 8.0])


def test_a_straight_way_is_easy():
    """In an empty volume the way is straight, has no bends and shows nothing."""
    measured = difficulty(EMPTY, START, GOAL)
    assert measured.detour_ratio == pytest.approx(1.0, abs=1e-9)
    assert measured.angle_over_length == 0.0
    assert measured.view_obstacle == 0.0
    assert np.isnan(measured.relative_gap_size)
    # Nothing is further from the bounds than half the height; the ends are 1.5 m from theirs.
    assert measured.bottleneck_m == pytest.approx(1.5 - R, abs=0.15)


def test_detour_and_bend_around_a_wall_are_those_of_the_triangle():
    """A wall with one open side: the path bends once about its edge, at the vehicle's radius."""
    field = AnalyticDistanceField([wall(-4.0, 1.0)], LOWER, UPPER)
    path = shortest_path(field, grid_distances(field, SPACING), START, GOAL)
    assert (field.distance(resampled(path, 0.02)) > R - 1e-3).all()
    side = np.hypot(4.5, 0.9 + R)
    assert path_length(path) == pytest.approx(2 * side, rel=0.03)
    assert angle_over_length(np.array([START, [6, 1.0 + R, 2], GOAL])) == pytest.approx(
        np.expm1(2 / np.pi * 2 * np.arctan2(0.9 + R, 4.5)) / (2 * side)
    )


@pytest.mark.parametrize("gap", [1.2, 2.0])
def test_bottleneck_is_half_the_gap(gap):
    """A slit of a given width leaves half of it, less the radius, to within half a cell."""
    field = AnalyticDistanceField([wall(-4.0, -gap / 2), wall(gap / 2, 4.0)], LOWER, UPPER)
    found = bottleneck(field, grid_distances(field, SPACING), START, GOAL)
    assert gap / 2 - R - SPACING / 2 - 0.02 < found <= gap / 2 - R


def test_traversability_of_an_empty_volume_is_the_mean_way_to_its_bounds():
    """Averaged over places where the vehicle fits and horizontal directions, within three standard
    errors of 20,000 exact ones.
    """
    rng = np.random.default_rng(0)
    p, angle = rng.uniform(LOWER + R, UPPER - R, (20000, 3)), rng.uniform(0, 2 * np.pi, 20000)
    way = np.column_stack([np.cos(angle), np.sin(angle)])
    lengths = np.where(way > 0, UPPER[:2] - p[:, :2], LOWER[:2] - p[:, :2]) / way
    exact = lengths.min(axis=1) / R
    found = traversability(EMPTY, np.random.default_rng(1), samples=3000)
    assert found == pytest.approx(exact.mean(), abs=3 * exact.std() / np.sqrt(3000))


def test_traversability_falls_with_obstacles_and_scales():
    """Posts and walls make the mean free way shorter."""
    rng = np.random.default_rng(5)
    feet = rng.uniform(LOWER, UPPER, (12, 3)) * (1, 1, 0)
    posts = [Capsule(foot - UP, foot + 5 * UP, 0.2) for foot in feet]
    crowded = AnalyticDistanceField(posts, LOWER, UPPER)
    walls = AnalyticDistanceField([wall(-4.5, 4.5)], LOWER, UPPER)
    free, halved, narrow = (
        traversability(field, np.random.default_rng(1)) for field in (EMPTY, walls, crowded)
    )
    assert free > max(halved, narrow) and min(halved, narrow) > 2.0


def test_relative_gap_size_is_that_between_posts():
    """Posts in a row, 2 m axis to axis, radius 0.3: gaps of 1.4 m over a diameter of 0.708 m."""
    posts = [Capsule([x, 0.05, -1], [x, 0.05, 5], 0.3) for x in (2.05, 4.05, 6.05, 8.05)]
    field = AnalyticDistanceField(posts, LOWER, UPPER)
    assert relative_gap_size(field, 2.0) == pytest.approx(1.4 / (2 * R), abs=0.12 / (2 * R))


def test_traversability_obstacle_is_range_over_diameter_in_a_tunnel():
    """In a square tunnel all balls have one radius, at best, so TO = R / (2 r)."""
    lower, upper = np.array([0.0, -1, 0]), np.array([20.0, 1, 2])
    tunnel = AnalyticDistanceField([], lower, upper)
    path = np.array([[2.0, 0, 1], [18.0, 0, 1]])
    assert traversability_obstacle(tunnel, path) == pytest.approx(4.0 / (2 * (1 - R)), rel=1e-6)


def test_view_obstacle_of_a_wall_ahead():
    """Flying at a wall 3 m ahead, each ring's weight counts over the distance along its rays."""
    field = AnalyticDistanceField([wall(-4.5, 4.5)], LOWER, UPPER)
    path = np.array([[2.9, 0.0, 2.0], [3.3, 0.0, 2.0]])
    middles = np.pi * np.array([(1 / 5 + 1 / 6) / 2, (1 / 6 + 1 / 8) / 2, (1 / 8 + 1 / 12) / 2])
    rays = 3.0 / np.array([*np.cos(middles), 1.0])
    expected = np.sum(np.array([0.05, 0.1, 0.3, 0.55]) * 4.0 / rays)
    assert view_obstacle(field, path) == pytest.approx(expected, rel=0.01)


def test_table_says_what_was_not_run(tmp_path, monkeypatch, capsys):
    """A generated scenario is measured; a scene that is not there is reported as not run."""
    monkeypatch.setenv("SPLATPILOT_SCENES", str(tmp_path))
    small = tmp_path / "small.yaml"
    small.write_text("world: !RoomConfig {length: 6, width: 4, height: 2.6, items: 1}\n")
    lines = run(scenarios=[str(small), "R13"], seeds=1)
    assert "1/1" in lines[1]
    assert "not run" in lines[2] and "TartanAir" in lines[2] and str(tmp_path) in lines[2]


def test_infeasible_seeds_are_counted(tmp_path, monkeypatch):
    small = tmp_path / "small.yaml"
    small.write_text("world: !RoomConfig {length: 6, width: 4, height: 2.6, items: 1}\n")

    def make(config, seed):
        if seed % 2:
            raise InfeasibleFlightError("no way")
        return make_world(config, seed)

    monkeypatch.setattr(difficulty_module, "make_world", make)
    assert "2/3" in run(scenarios=[str(small)], seeds=3)[1]
    monkeypatch.setattr(difficulty_module, "make_world", lambda config, seed: make(config, 1))
    assert "0/2" in run(scenarios=[str(small)], seeds=2)[1]


@pytest.mark.parametrize("seeds", ["0", "-1"])
def test_no_seeds_are_refused(seeds, capsys):
    """There is nothing to measure in no world."""
    assert main(["difficulty", "P10", "--seeds", seeds]) == 1
    assert f"--seeds must be at least 1, got {seeds}" in capsys.readouterr().err
