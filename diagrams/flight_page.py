"""Pages to watch flights in."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat

from splatpilot.diagrams.flight import Flight
from splatpilot.diagrams.flight_diagram import camera_info, camera_mount
from splatpilot.diagrams.meshcat import open_meshcat
from splatpilot.diagrams.pilot import goal_of
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.appearance import seen_otherwise
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.files import written_atomically
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from splatpilot.systems.visualization.drawing import draw_vehicle
from splatpilot.systems.visualization.live_page import live_page
from splatpilot.systems.visualization.replay_page import (
    Frames,
    ReplayedFlight,
    ReplayView,
    replay_page,
)
from splatpilot.systems.visualization.video_recorder import VideoRecorder


def replayed_flight(name: str, flight: Flight, frames: Frames | None) -> ReplayedFlight:
    """A flight as a page shows it, with what its camera saw."""
    return ReplayedFlight(
        name,
        str(flight.outcome),
        flight.times,
        flight.states,
        flight.clearances,
        flight.hypotheses,
        frames,
    )


def recorded_frames(recorder: VideoRecorder, scenario: Scenario) -> Frames:
    """The pictures of the scenario's camera."""
    color, depth = zip(*recorder.frames(scenario.camera.z_far), strict=True)
    return Frames(1 / scenario.camera.fps, color, depth)


def write_flight_page(
    path: Path, scenario: Scenario, world: World, flights: Sequence[ReplayedFlight]
) -> None:
    """
    Writes a page that shows flights from one start to one goal, see `replay_page`.

    Args:
        path: the file, ending in .html.
        scenario, world: what was flown.
        flights: one or more.

    Raises:
        OSError: if it cannot be written.
    """
    world = seen_otherwise(world, scenario.appearance, scenario.seed)
    lower, upper = _heights(world)
    view = ReplayView(
        X_BC=camera_mount(scenario.camera),
        fov_y=camera_info(scenario.camera).fov_y(),
        radius=VEHICLE_RADIUS,
        lower=lower,
        upper=upper,
    )
    meshcat = open_meshcat(scenario, world)
    for k in range(len(flights)):
        draw_vehicle(meshcat, f"/splatpilot/vehicles/{k}", VEHICLE_RADIUS)
    balls = world.moving.balls if world.moving else None
    page = replay_page(
        meshcat.StaticHtml(), world.gaussians, world.background, view, flights, balls
    )
    with written_atomically(path) as partial:
        partial.write_text(page)


def write_live_page(path: Path, meshcat: Meshcat, scenario: Scenario, world: World) -> None:
    """
    Writes a page that shows a flight while it goes on, see `live_page`, at first from above.

    Args:
        path: the file, ending in .html.
        meshcat: draws the flight, see `open_meshcat`.
        scenario, world: what is flown.

    Raises:
        OSError: if it cannot be written.
    """
    world = seen_otherwise(world, scenario.appearance, scenario.seed)
    lower, upper = _heights(world)
    start = world.p_WS if scenario.start is None else scenario.start
    highest = max(start[2], goal_of(scenario, world)[2])
    cut = min(highest + 2 * VEHICLE_RADIUS, upper)
    page = live_page(meshcat, world.gaussians, world.background, (lower, upper), cut)
    with written_atomically(path) as partial:
        partial.write_text(page)


def _heights(world: World) -> tuple[float, float]:
    """[m], of a place's floor and ceiling."""
    field = world.distance_field
    return float(np.asarray(field.lower_W)[2]), float(np.asarray(field.upper_W)[2])
