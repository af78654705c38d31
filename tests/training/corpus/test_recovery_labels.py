import shutil
from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, Cylinder, HalfSpace
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, hover_state
from splatpilot.training.corpus.corpus import EXPERT, RECOVERY
from splatpilot.training.policies.recover import (
    StudentFlight,
    add_recovery,
    near_misses,
    obstacle_clearances,
    rows_to_recover,
)

TIMES = np.arange(0.0, 12.0, 0.02)


def clearances(*dips: tuple[float, float]) -> np.ndarray:
    """3 m, less at the times [s] of `dips`, to their clearance [m], at 1 m/s before and after."""
    return np.min([3.0 + 0 * TIMES, *(least + np.abs(TIMES - at) for at, least in dips)], axis=0)


@pytest.mark.parametrize(
    ("dips", "expected"),
    [
        ([], []),
        ([(4.0, 1.3)], []),  # not below 1.2 m
        ([(4.0, 1.1)], [4.0]),
        ([(4.0, 0.4), (8.0, -0.1)], [4.0, 8.0]),
        ([(4.0, 0.9), (4.6, 0.4)], [4.6]),  # one miss: within a second the nearer one counts
        ([(11.98, 0.0)], [11.98]),  # a collision ends the flight
    ],
)
def test_near_misses_are_the_minimum_clearances(dips, expected):
    np.testing.assert_allclose(near_misses(TIMES, clearances(*dips)), expected, atol=1e-9)


def test_ground_and_ceiling_are_no_obstacles():
    ground, ceiling = HalfSpace([0.0, 0.0, 1.0], 0.0), HalfSpace([0.0, 0.0, -1.0], -3.2)
    wire = Cylinder([-9.0, 20.0, 1.0], [9.0, 20.0, 1.0], 0.02)
    slit = [Box(RigidTransform([0.0, y, 1.6]), [8.0, 2.0, 3.2]) for y in (-1.6, 1.6)]
    shapes = [ground, ceiling, wire, *slit]
    field = AnalyticDistanceField(shapes, np.array([-9.0, -9.0, 0.0]), np.array([9.0, 29.0, 3.2]))
    level = [[0.0, 10.0, 0.6], [0.0, 10.0, 2.7], [6.0, -8.0, 1.0]]
    obstacles = [[0.0, 20.0, 1.7], [0.0, 20.6, 1.6], [0.0, 0.0, 1.6], [0.0, 3.3, 1.5]]
    states = np.stack([hover_state(np.array(p)) for p in level + obstacles])
    clear = field.distance(states[:, :3]) - VEHICLE_RADIUS
    flight = StudentFlight("W", np.zeros(3), np.arange(7.0), states, clear)
    expected = [np.inf, np.inf, np.inf, *clear[3:]]
    np.testing.assert_array_equal(obstacle_clearances(flight, field), expected)


def labeled_times(end: float, clear: np.ndarray, *events: float) -> np.ndarray:
    """The times [s] of labeled states of a flight to x = `end` [m]; its goal is at x = 10 m."""
    p_WB = np.linspace([0.0, 0.0, 1.5], [end, 0.0, 1.5], len(TIMES))
    states = np.stack([hover_state(p) for p in p_WB])
    flight = StudentFlight("W", np.array([10.0, 0.0, 1.5]), TIMES, states, clear)
    return TIMES[rows_to_recover(flight, np.array(events), 0.4)]


NEAR = [1.5, 1.9, 2.3, 2.7, 3.1, 3.5]
ALONG = np.arange(0.0, 11.9, 0.8)


@pytest.mark.parametrize(
    ("end", "events", "expected"),
    [
        (9.71, [], []),
        (9.71, [4.0], NEAR),
        (9.71, [2.0, 8.0], [0.3, 0.7, 1.1, 1.5, 5.5, 5.9, 6.3, 6.7, 7.1, 7.5]),
        (9.71, [0.3], []),
        (9.71, [8.0, 8.4], [5.5, 5.9, 6.3, 6.7, 7.1, 7.5, 7.9]),
        (9.69, [], ALONG),
        (3.0, [4.0], np.union1d(ALONG, NEAR)),
    ],
)
def test_states_are_labeled_before_near_misses_and_all_along_failed_flights(end, events, expected):
    np.testing.assert_allclose(labeled_times(end, clearances(), *events), expected, atol=0.021)


def test_states_in_contact_are_not_labeled():
    assert labeled_times(3.0, clearances() - 4.0 * (TIMES > 5.0), 6.0).max() <= 5.0


def straight_flight(record) -> StudentFlight:
    """A straight flight from start to goal in 8 s, through obstacles."""
    world = record.make()
    times = np.arange(0.0, 8.0, 0.02)
    p_WB = world.p_WS + times[:, None] / 8.0 * (world.p_WG - world.p_WS)
    states = np.stack([hover_state(p) for p in p_WB])
    states[:, 3:6] = (world.p_WG - world.p_WS) / 8.0
    clear = world.distance_field.distance(p_WB) - VEHICLE_RADIUS
    return StudentFlight(record.name, world.p_WG, times, states, clear)


@pytest.fixture
def folder(collected, tmp_path):
    """A copy of the corpus, to be added to."""
    return shutil.copytree(collected.folder, tmp_path / "corpus")


def test_recovery_samples_have_the_labels_of_the_expert(folder, collected):
    record = collected.worlds[1]
    flight = straight_flight(record)
    field = record.make().distance_field
    events = near_misses(flight.times, obstacle_clearances(flight, field))
    assert len(events) > 0
    corpus = add_recovery(folder, [flight], jobs=1)
    samples = corpus.samples(np.arange(len(corpus)))
    old, new = samples.source == EXPERT, samples.source == RECOVERY
    assert old.sum() == len(collected)
    assert new.sum() == len(corpus) - len(collected) > 0
    assert {corpus.worlds[k].name for k in samples.world[new]} == {record.name}
    exact = samples.X_WB[new][::2, 4:]
    for p_WB in exact:
        row = np.abs(flight.states[:, :3] - p_WB).sum(axis=1).argmin()
        np.testing.assert_allclose(flight.states[row, :3], p_WB, atol=1e-9)
        ahead = events - flight.times[row]
        assert ((ahead > 0.5 - 0.03) & (ahead < 2.5 + 0.03)).any()
    field = record.esdf.conservative()
    first_W = samples.trajectories_B[new][::2, 0] + exact[:, None]  # hovering level: B as W
    assert (field.distance(first_W.astype(float)) > VEHICLE_RADIUS - 1e-3).all()


def test_the_same_flights_add_nothing_twice(folder, collected):
    flight = straight_flight(collected.worlds[0])
    once = add_recovery(folder, [flight], jobs=1)
    shard, every = once.shards[-1].path, np.arange(len(once))
    before = (shard / "color.npy").stat().st_mtime_ns
    assert len(add_recovery(folder, [flight], jobs=1)) == len(once)
    assert (shard / "color.npy").stat().st_mtime_ns == before
    color = once.samples(every).color
    shutil.rmtree(shard)
    again = add_recovery(folder, [flight], jobs=1)
    np.testing.assert_array_equal(again.samples(every).color, color)
    end = {name: getattr(flight, name)[:300] for name in ("times", "states", "clearances")}
    later = add_recovery(folder, [replace(flight, **end)], jobs=1)
    assert len(later.shards) == len(once.shards) + 1
    rows = (folder / "ledger.csv").read_text().splitlines()
    assert sum("recovery" in row for row in rows) == 2
    with pytest.raises(ValueError, match="not collected in the world 'P99-7'"):
        add_recovery(folder, [replace(flight, world="P99-7")], jobs=1)
