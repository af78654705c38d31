"""What is measured of flights."""

import math

import numpy as np
import pytest

from splatpilot.analysis.benchmark.rollout import flight_metrics, jerk_metrics, shortest_length
from splatpilot.diagrams.flight.flight import Flight, Outcome
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Cylinder
from splatpilot.systems.policies.time_of_arrival import path_lengths
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS


def straight_flight(outcome=Outcome.GOAL, clearance=0.5) -> Flight:
    """Two meters a second along x for three seconds, and a last sample between two periods."""
    times = np.append(np.arange(151) * 0.02, 3.007)
    states = np.zeros((152, 13))
    states[:, 0], states[:, 3] = 2.0 * times, 2.0
    return Flight(
        outcome, times, states, np.zeros((152, 4)), np.full(152, clearance), np.empty((0, 0)), 1.0
    )


def test_success_needs_goal_and_clearance():
    assert flight_metrics(straight_flight(), 6.0)["success"]
    assert not flight_metrics(straight_flight(clearance=-0.001), 6.0)["success"]
    for outcome in (Outcome.COLLISION, Outcome.TIMEOUT, Outcome.LEFT_VOLUME):
        measures = flight_metrics(straight_flight(outcome), 6.0)
        assert not measures["success"]
        assert math.isnan(measures["path_excess"])


def test_figures_of_a_straight_flight():
    measures = flight_metrics(straight_flight(), shortest=5.0)
    assert measures["path_length_m"] == pytest.approx(6.014)
    assert measures["mean_speed_m_s"] == pytest.approx(2.0)
    assert measures["path_excess"] == pytest.approx(6.014 / 5.0 - 1)
    assert measures["jerk_m_s3"] == pytest.approx(0.0, abs=1e-9)


def test_jerk_of_a_sine():
    amplitude, w = 2.0, np.pi / 2
    times = np.append(np.arange(0, 801) * 0.02, 16.013)  # Four periods.
    velocities = np.zeros((802, 3))
    velocities[:, 1] = amplitude * np.sin(w * times)
    jerk, smoothness = jerk_metrics(velocities, times)
    assert jerk == pytest.approx(amplitude * w**2 / np.sqrt(2), rel=0.01)
    expected = -np.log(16.0**3 / amplitude**2 * (amplitude * w**2) ** 2 / 2 * 16.0)
    assert smoothness == pytest.approx(expected, abs=0.02)


def test_shortest_way_goes_round_a_post():
    post = Cylinder(p_WA=[5.0, 0.0, -2.0], p_WB=[5.0, 0.0, 6.0], radius=0.5)
    exact = AnalyticDistanceField([post], [0.0, -3.0, 0.0], [10.0, 3.0, 4.0])
    field = esdf_from_distance_field(exact, 0.1).conservative()
    lengths = path_lengths(field, np.array([9.0, 0.0, 2.0]))
    shortest = shortest_length(lengths, np.array([1.0, 0.0, 2.0]), goal_radius=0.3)
    r = 0.5 + VEHICLE_RADIUS
    tangents, arc = 2 * np.sqrt(16 - r**2), r * (np.pi - 2 * np.arccos(r / 4.0))
    assert shortest == pytest.approx(tangents + arc - 0.3, abs=0.15)
    assert shortest > 8.0 - 0.3
    assert math.isnan(shortest_length(lengths, np.array([5.0, 0.0, 2.0]), 0.3))
