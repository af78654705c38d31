"""`splatpilot fly`: one flight with its page and video."""

import contextlib
import select
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram

from splatpilot.diagrams.flight.blocks import camera_info, camera_mount
from splatpilot.diagrams.flight.flight_diagram import (
    BuildFlightDiagram,
    check_drawings,
    open_meshcat,
)
from splatpilot.diagrams.flight.monitor import flight_monitors
from splatpilot.diagrams.flight.scenario import (
    Scenario,
    goal_position,
    sample_initial_state,
    sample_scenario,
    start_position,
)
from splatpilot.diagrams.flight.simulation import (
    FLIGHT_FILES,
    Flight,
    FlightError,
    fly,
    write_flight,
    write_summary,
)
from splatpilot.diagrams.worlds.appearance import randomize_appearance
from splatpilot.diagrams.worlds.moving_spheres import add_moving_spheres
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.files import (
    locks_folder,
    require_unused,
    require_writable_folder,
    write_text,
    written_atomically,
)
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.validation import require
from splatpilot.systems.policies.teleop import TeleopConfig
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.state import pose_from_state
from splatpilot.systems.visualization.live import LiveControls
from splatpilot.systems.visualization.meshcat_drawing import draw_vehicle
from splatpilot.systems.visualization.pages import (
    Frames,
    HtmlPage,
    ReplayedFlight,
    ReplayView,
    jpeg,
    live_page,
    replay_page,
)
from splatpilot.systems.visualization.rerun_sink import RerunSink
from splatpilot.systems.visualization.video import VideoRecorder


def replayed_flight(name: str, flight: Flight, frames: Frames | None) -> ReplayedFlight:
    """Converts a flight, with its camera's images, for a page."""
    arrays = flight.times, flight.states, flight.clearances, flight.hypotheses
    return ReplayedFlight(name, str(flight.outcome), *arrays, frames)


def recorded_frames(recorder: VideoRecorder, scenario: Scenario) -> Frames:
    """Returns the images of the scenario's camera."""
    # One by one: raw images of a flight do not fit in memory.
    pairs = [tuple(map(jpeg, pictures)) for pictures in recorder.frames(scenario.camera.z_far)]
    color, depth = zip(*pairs, strict=True)
    return Frames(1 / scenario.camera.fps, color, depth, scenario.camera.z_far)


def flight_page(
    scenario: Scenario, world: World, flights: Sequence[Flight | ReplayedFlight]
) -> HtmlPage:
    """Makes a page that shows flights from one start to one goal, see `replay_page`.

    A notebook shows it inline.
    """
    world = randomize_appearance(world, scenario.appearance, scenario.seed)
    meshcat = open_meshcat(scenario, world)
    shown = [
        replayed_flight(f"flight {k}", flight, None) if isinstance(flight, Flight) else flight
        for k, flight in enumerate(flights)
    ]
    for k in range(len(shown)):
        draw_vehicle(meshcat, f"/splatpilot/vehicles/{k}", scenario.vehicle.radius)
    if scenario.moving:
        world = add_moving_spheres(world, scenario.moving)
    spheres = world.moving.spheres if world.moving else None
    scene = world.gaussians, world.background, _view(scenario, world)
    return HtmlPage(replay_page(meshcat.StaticHtml(), *scene, shown, spheres))


def running_page(meshcat: Meshcat, scenario: Scenario, world: World) -> HtmlPage:
    """Makes a page that shows a running flight, which `meshcat` draws, see `live_page`."""
    world = randomize_appearance(world, scenario.appearance, scenario.seed)
    highest = max(start_position(scenario, world)[2], goal_position(scenario, world)[2])
    view = _view(scenario, world)
    cut = min(highest + 2 * scenario.vehicle.radius, view.upper)
    return HtmlPage(live_page(meshcat, world.gaussians, world.background, view, cut))


def _view(scenario: Scenario, world: World) -> ReplayView:
    field = world.distance_field
    return ReplayView(
        name=f"{world.name}, seed {scenario.seed}",
        X_BC=camera_mount(scenario.camera),
        fov_y=camera_info(scenario.camera).fov_y(),
        radius=scenario.vehicle.radius,
        lower=float(np.asarray(field.lower_W)[2]),
        upper=float(np.asarray(field.upper_W)[2]),
        num_frontier=world.num_frontier,
    )


_TRACEBACK = "traceback.txt"


@locks_folder("out")
def run(
    *,
    scenario: Scenario,
    out: Path,
    live: bool = False,
    draw: Sequence[str] = (),
    video: bool = True,
    rerun: Path | None = None,
    graphviz: Path | None = None,
    overwrite: bool = False,
) -> dict[str, float | str]:
    """Flies a scenario and writes into `out`:

    - `flight.html`, see `replay_page`;
    - `flight.mp4`: the images of the camera, color next to depth;
    - `traceback.txt`, if an exception other than `InfeasibleFlightError` ended the flight;
    - the files of `write_flight` and `write_summary`.

    Args:
        live: serves Meshcat with `LiveControls`, and afterwards until Enter is pressed;
            `live.html` in `out` shows it with the world's Gaussians.
        draw: what Meshcat draws, see `AddMeshcat`.
        video: writes `flight.mp4`.
        rerun: file of a `RerunSink`.
        graphviz: file for the diagram as Graphviz source.
        overwrite: replaces files in `out`, after the flight.

    Returns:
        `Flight.summary()` and `render_ms`, the mean time of a render along the flight [ms].
    """
    scenario = sample_scenario(scenario)
    scenario.validate()
    require_unused(out, overwrite)
    for path in filter(None, (rerun, graphviz)):
        require_unused(path, overwrite)
        require_writable_folder(path.absolute().parent)
    by_hand = isinstance(scenario.policy, TeleopConfig)
    require(live or not by_hand, "--policy teleop", "flown with --live", "no --live")
    check_drawings(draw)
    require(live or not draw, "--draw", "left out without --live", ",".join(draw))
    print(f"Building the world, seed {scenario.seed}...", flush=True)
    world = make_world(scenario.world, scenario.seed)
    sample_initial_state(scenario, world)  # Checks start and goal early.

    with contextlib.ExitStack() as stack:
        seen = randomize_appearance(world, scenario.appearance, scenario.seed)
        meshcat = open_meshcat(scenario, seen) if live else None
        recording = stack.enter_context(written_atomically(rerun)) if rerun else None
        diagram = BuildFlightDiagram(
            scenario, world, meshcat, video=True, draw=draw, rerun=recording
        )
        if recording is not None:
            stack.callback(cast(RerunSink, diagram.GetSubsystemByName("rerun")).close)
        if graphviz is not None:
            write_text(graphviz, diagram.GetGraphvizString())
        if meshcat is None:
            return _fly_and_write(scenario, world, diagram, out, video)
        running_page(meshcat, scenario, world).save(out / "live.html")
        address = f"{out / 'live.html'}, or {meshcat.web_url()} without Gaussians"
        print(f"The flight starts when you open {address}", flush=True)
        controls = LiveControls(meshcat, diagram, world.distance_field)
        while True:
            summary = _fly_and_write(scenario, world, diagram, out, video, controls)
            print("Press Enter to stop serving Meshcat, or restart in the page.", flush=True)
            if not controls.wait_for_restart(_is_stopped):
                return summary


def _is_stopped() -> bool:
    """Checks if Enter was pressed, or standard input cannot be read."""
    try:
        stopped = bool(select.select([sys.stdin], [], [], 0)[0])
    except (OSError, ValueError):  # not a terminal
        return True
    if stopped:
        sys.stdin.readline()
    return stopped


def _fly_and_write(
    scenario: Scenario,
    world: World,
    diagram: Diagram,
    out: Path,
    video: bool,
    monitor: LiveControls | None = None,
) -> dict[str, float | str]:
    failure = interruption = None
    try:
        flight = fly_with_bar(diagram, monitor)
    except FlightError as error:
        flight, failure = error.flight, error
    except KeyboardInterrupt as error:
        if "flight" not in vars(error):
            raise
        flight, interruption = vars(error)["flight"], error
    for name in ("flight.html", "flight.mp4", _TRACEBACK, *FLIGHT_FILES):
        (out / name).unlink(missing_ok=True)
    write_flight(out, scenario, flight)
    if failure is not None:
        write_text(out / _TRACEBACK, "".join(traceback.format_exception(failure)))
    camera = cast(SplatCamera, diagram.GetSubsystemByName("camera"))
    summary = flight.summary() | {"render_ms": _render_ms(camera, flight)}
    write_summary(out, summary)
    recorder = cast(VideoRecorder, diagram.GetSubsystemByName("video"))
    frames = recorded_frames(recorder, scenario)
    name = f"{world.name}, seed {scenario.seed}"
    shown = replayed_flight(name, flight, frames)
    flight_page(scenario, world, [shown]).save(out / "flight.html")
    written = ["flight.html", *FLIGHT_FILES, *([_TRACEBACK] if failure is not None else [])]
    if video:
        recorder.save(out / "flight.mp4", scenario.camera.z_far)
        written.insert(1, "flight.mp4")

    print(format_summary(summary))
    print(f"Wrote {', '.join(written)} in {out}")
    if interruption is not None:
        raise interruption
    return summary


def fly_with_bar(diagram: Diagram, monitor: LiveControls | None = None) -> Flight:
    """Calls `fly` with a progress bar of simulated time."""
    limit = flight_monitors(diagram)[0][1].scenario.timeout
    layout = "{desc} {n:.1f} s of at most {total:.0f} s [{elapsed}]"
    with Progress(total=limit, desc="flying", bar_format=layout, leave=False) as bar:
        return fly(diagram, monitor=monitor, progress=lambda now: bar.update(now - bar.n))


def format_summary(summary: dict[str, float | str]) -> str:
    """Formats the summary as a table of two columns."""
    rows = (
        ("outcome", "outcome", "{}"),
        ("flight time", "flight_time_s", "{:.2f} s"),
        ("path length", "path_length_m", "{:.2f} m"),
        ("mean speed", "mean_speed_m_s", "{:.2f} m/s"),
        ("minimum clearance", "min_clearance_m", "{:+z.3f} m"),
        ("unobserved pixels", "unobserved_fraction", "{:.1%}"),
        ("real-time factor", "real_time_factor", "{:.1f}"),
        ("render", "render_ms", "{:.1f} ms"),
    )
    return "\n".join(
        f"{title:<18} {form.format(summary[key])}" for title, key, form in rows if key in summary
    )


def _render_ms(camera: SplatCamera, flight: Flight, num_views: int = 30) -> float:
    """Measures the mean time [ms] of a render at poses evenly spaced along a flight."""
    rows = np.linspace(0, len(flight.states) - 1, num_views).astype(int)
    poses = [pose_from_state(state) for state in flight.states[rows]]
    started = time.perf_counter()
    for X_WB in poses:
        camera.render(X_WB)
    return (time.perf_counter() - started) / num_views * 1e3
