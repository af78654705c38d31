"""A page to watch flights in: what Meshcat has drawn, the world's Gaussians, and a time slider."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.collision.moving_balls import MovingBalls
from splatpilot.systems.policies.hypotheses import Hypotheses, num_hypotheses_in
from splatpilot.systems.splats.background import Background
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.visualization.splat_page import jpeg, rounded, splat_page

_COLORS = ("#e8432e", "#2f8fe8", "#e8b52e", "#a05ce0", "#30b870", "#e060b0", "#50c8d0", "#b0b0b0")
_RATE = 30.0  # [Hz], samples of a flight in the page
_BALLS_PERIOD = 0.1  # [s], between which balls go straight


@dataclass(frozen=True, eq=False)
class Frames:
    """What the onboard camera saw, `period` seconds apart from the start on."""

    period: float  # [s]
    color: Sequence[NDArray[np.uint8]]  # (H, W, 3) each, blue first, as OpenCV has it
    depth: Sequence[NDArray[np.uint8]]  # (H, W, 3) each, in colours


@dataclass(frozen=True, eq=False)
class ReplayedFlight:
    """One flight of a page; N samples."""

    name: str
    outcome: str
    times: NDArray[np.float64]  # (N,) [s]
    states: NDArray[np.float64]  # (N, 13), see `QuadrotorState`
    clearances: NDArray[np.float64]  # (N,) [m], NaN where unknown
    hypotheses: NDArray[np.float64]  # (M, size), see `Hypotheses.to_vector`; (0, 0) without
    frames: Frames | None = None


@dataclass(frozen=True, eq=False)
class ReplayView:
    """What a page knows of the vehicle and the place."""

    X_BC: RigidTransform  # pose of the onboard camera in the vehicle's body frame
    fov_y: float  # [rad], of the onboard camera
    radius: float  # [m], of the vehicle
    lower: float  # [m], height of the place's floor
    upper: float  # [m], and of its ceiling
    margin: float = 0.2  # [m], clearance below which the vehicle is marked red


def replay_page(
    meshcat_page: str,
    gaussians: GaussianScene,
    background: Background,
    view: ReplayView,
    flights: Sequence[ReplayedFlight],
    balls: MovingBalls | None = None,
) -> str:
    """
    The HTML of a page that needs nothing else, not even a network.

    Args:
        meshcat_page: `Meshcat.StaticHtml()` with what stands still, and the vehicle of flight k at
            `/splatpilot/vehicles/k`.
        gaussians, background: what cameras see.
        view: the vehicle and the place.
        flights: one or more, the first of which is shown at first.
        balls: what moves beside them.

    Raises:
        ValueError: if there is no flight.
    """
    if not flights:
        raise ValueError("flights is empty; a replay shows at least one flight")
    data = {
        "X_BC": view.X_BC.GetAsMatrix4().ravel().tolist(),
        "fov_y": np.degrees(view.fov_y),
        "radius": view.radius,
        "margin": view.margin,
        "lower": view.lower,
        "upper": view.upper,
        "cut": min(view.upper, _highest(flights) + 2 * view.radius),
        "balls": balls and _balls_data(balls, max(flight.times[-1] for flight in flights)),
        "flights": [
            _flight_data(flight, _COLORS[k % len(_COLORS)]) for k, flight in enumerate(flights)
        ],
    }
    return splat_page(
        meshcat_page,
        gaussians,
        background,
        data,
        ("replay_flight.js", "replay.js"),
        "window.replay = new Replay(viewer, splats, data);",
    )


def _highest(flights: Sequence[ReplayedFlight]) -> float:
    return max(float(QuadrotorState.of(flight.states).p_WB[:, 2].max()) for flight in flights)


def _flight_data(flight: ReplayedFlight, color: str) -> dict[str, Any]:
    # The samples nearest to the page's rate, and the last, at which a flight ends.
    wanted = np.arange(flight.times[0], flight.times[-1], 1 / _RATE)
    rows = np.unique(np.append(np.searchsorted(flight.times, wanted), len(flight.times) - 1))
    state = QuadrotorState.of(flight.states[rows])
    return {
        "name": flight.name,
        "outcome": flight.outcome,
        "color": color,
        "times": rounded(flight.times[rows]),
        "p_WB": rounded(state.p_WB),
        "q_WB": rounded(state.q_WB),
        "speeds": rounded(np.linalg.norm(state.v_WB, axis=1)),
        "clearances": [None if np.isnan(c) else round(c, 3) for c in flight.clearances[rows]],
        "plans": _plans(flight.hypotheses),
        "frames": flight.frames
        and {
            "period": flight.frames.period,
            "color": [jpeg(image) for image in flight.frames.color],
            "depth": [jpeg(image) for image in flight.frames.depth],
        },
    }


def _balls_data(balls: MovingBalls, duration: float) -> dict[str, Any]:
    times = np.arange(0.0, duration + 2 * _BALLS_PERIOD, _BALLS_PERIOD)
    centers = [np.round(balls.centers(time), 3).tolist() for time in times]
    return {
        "period": _BALLS_PERIOD,
        "radii": rounded(balls.radii),
        "centers": [
            [center if np.isfinite(center).all() else [None] * 3 for center in row]
            for row in centers
        ],
    }


def _plans(vectors: NDArray[np.float64]) -> list[dict[str, Any]]:
    """The plans in W, in the order of their times, each once."""
    plans: dict[float, dict[str, Any]] = {}
    for vector in vectors:
        plan = Hypotheses.from_vector(vector, num_hypotheses_in(len(vector)))
        if plan is not None:
            plans[plan.plan_time] = {
                "time": plan.plan_time,
                "p_WB": rounded(plan.X_WB.translation()),
                "waypoints_W": rounded(plan.waypoints_W),
                "costs": rounded(plan.costs),
            }
    return list(plans.values())
