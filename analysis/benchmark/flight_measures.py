"""What is measured of a flight."""

import math

import numpy as np

from splatpilot.diagrams.flight import Flight, Outcome
from splatpilot.diagrams.flight_diagram import LOG_PERIOD
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState

_JERK_STRIDE = 5
"""Samples between which velocities are differentiated: 0.1 s. The controller's steps every 0.02 s
are no motion of the vehicle."""


def flight_measures(flight: Flight, shortest: float) -> dict[str, float | str | bool]:
    """
    The measures of a flight, by the names of their columns.

    - `success`: the goal was reached, and the clearance at the vehicle's radius never negative;
    - `outcome`: `goal`, `collision`, `left_volume`, `timeout` or `error`;
    - `flight_time_s`, `path_length_m`, `mean_speed_m_s`, `min_clearance_m`;
    - `shortest_path_m`, `path_excess`: the way flown over the shortest way, less one; NaN of
      flights that did not arrive;
    - `jerk_m_s3`: root mean square of the second differences of the velocity at 0.1 s;
    - `smoothness`: the logarithmic dimensionless jerk, -ln(T³ / v_max² ∫ |jerk|² dt) (N. Hogan and
      D. Sternad, J. Motor Behavior 41, 2009); greater is smoother.

    Args:
        flight: as flown.
        shortest: length of the shortest way from its start to its goal [m].
    """
    summary = flight.summary()
    arrived = flight.outcome == Outcome.GOAL
    least = float(np.nanmin(flight.clearances))
    length, duration = float(summary["path_length_m"]), float(summary["flight_time_s"])
    jerk, smoothness = jerk_measures(QuadrotorState.of(flight.states).v_WB, flight.times)
    return {
        "success": arrived and least >= 0.0,
        "outcome": str(flight.outcome),
        "flight_time_s": duration,
        "path_length_m": length,
        "mean_speed_m_s": float(summary["mean_speed_m_s"]),
        "min_clearance_m": least,
        "shortest_path_m": shortest,
        "path_excess": length / shortest - 1.0 if arrived and shortest > 0 else math.nan,
        "jerk_m_s3": jerk,
        "smoothness": smoothness,
    }


def jerk_measures(velocities: np.ndarray, times: np.ndarray) -> tuple[float, float]:
    """Root mean square jerk [m/s^3] and smoothness [-] of velocities (N, 3) [m/s] at times (N,) [s]
    `LOG_PERIOD` apart, see `flight_measures`; NaN of flights too short to tell.
    """
    sampled = velocities[np.isclose(np.arange(len(times)) * LOG_PERIOD, times)][::_JERK_STRIDE]
    if len(sampled) < 4:
        return math.nan, math.nan
    step = _JERK_STRIDE * LOG_PERIOD
    square = np.square(np.diff(sampled, n=2, axis=0) / step**2).sum(axis=1).mean()
    duration = step * (len(sampled) - 1)
    fastest = np.linalg.norm(sampled, axis=1).max()
    if square == 0.0 or fastest == 0.0:
        return float(np.sqrt(square)), math.nan
    return float(np.sqrt(square)), float(-np.log(duration**4 * square / fastest**2))


def shortest_length(lengths: TimeOfArrival, p_WS: np.ndarray, goal_radius: float) -> float:
    """Length [m] of the shortest way from p_WS (3,) into the sphere that counts as the goal; NaN
    where the grid shows none.

    Args:
        lengths: of the ways to the goal, `way_lengths`.
    """
    if not lengths.is_reachable(p_WS):
        return math.nan
    return max(float(lengths.value(p_WS)) - goal_radius, 0.0)
