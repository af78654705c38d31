"""`splatpilot fly`: one flight, with everything a person wants to see of it afterwards."""

import contextlib
import time
import traceback
from pathlib import Path
from typing import cast

import numpy as np
from pydrake.systems.framework import Diagram

from splatpilot.diagrams.flight import Flight, FlightError, fly
from splatpilot.diagrams.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight_files import FLIGHT_FILES, write_flight, write_summary
from splatpilot.diagrams.flight_page import (
    recorded_frames,
    replayed_flight,
    write_flight_page,
    write_live_page,
)
from splatpilot.diagrams.flight_start import sample_initial_state
from splatpilot.diagrams.meshcat import open_meshcat
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.make_world import make_world
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.files import require_unused, require_writable_folder, written_atomically
from splatpilot.systems.output_folders import holds_folder
from splatpilot.systems.progress import Progress
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.state_to_pose import pose_from_state
from splatpilot.systems.visualization.video_recorder import VideoRecorder

_TRACEBACK = "traceback.txt"


@holds_folder("out")
def run(
    *,
    scenario: Scenario,
    out: Path,
    live: bool = False,
    video: bool = True,
    graphviz: Path | None = None,
    overwrite: bool = False,
) -> dict[str, float | str]:
    """
    Flies a scenario and leaves in `out`:

    - `flight.html`: a page to watch it in, see `replay_page`;
    - `flight.mp4`: what the onboard camera saw, colour beside depth;
    - `traceback.txt`, if an exception other than `InfeasibleFlightError` ended the flight;
    - what `write_flight` and `write_summary` write, the former before any picture is made.

    Args:
        live: serves Meshcat while flying, at real time, and afterwards until Enter is pressed;
            `live.html` in `out` shows it with the world's Gaussians.
        video: whether to write `flight.mp4`.
        graphviz: where to write the diagram as Graphviz source.
        overwrite: what is there. An earlier flight stays whole until this one has been flown.

    Returns:
        `Flight.summary()` and `render_ms`, the mean time of a render along the flight [ms].

    Raises:
        ValueError: for a scenario that cannot be flown.
        OSError: if `out` holds anything and is not to be overwritten, or cannot be written; nothing
            is flown then.
    """
    scenario.validate()
    for path in (out, graphviz):
        if path is not None:
            require_unused(path, overwrite)
    if graphviz is not None:
        require_writable_folder(graphviz.parent)
    print(f"Building the world, seed {scenario.seed}...", flush=True)
    world = make_world(scenario.world, scenario.seed)
    sample_initial_state(scenario, world)  # Refuses a start or goal without room before the rest.

    meshcat = open_meshcat(scenario, world) if live else None
    if meshcat is not None:
        page = out / "live.html"
        write_live_page(page, meshcat, scenario, world)
        print(
            f"Watch the flight: open {page}, or {meshcat.web_url()} without Gaussians", flush=True
        )
    diagram = BuildFlightDiagram(scenario, world, meshcat, video=True)
    if graphviz is not None:
        with written_atomically(graphviz) as path:
            path.write_text(diagram.GetGraphvizString())
    failure = None
    try:
        flight = fly_with_bar(diagram, scenario, world, realtime_rate=1.0 if live else 0.0)
    except FlightError as error:
        flight, failure = error.flight, error
    for name in ("flight.html", "flight.mp4", _TRACEBACK, *FLIGHT_FILES):
        (out / name).unlink(missing_ok=True)
    write_flight(out, scenario, flight)
    if failure is not None:
        with written_atomically(out / _TRACEBACK) as path:
            path.write_text("".join(traceback.format_exception(failure)))
    camera = cast(SplatCamera, diagram.GetSubsystemByName("camera"))
    summary = flight.summary() | {"render_ms": _render_ms(camera, flight)}
    write_summary(out, summary)
    recorder = cast(VideoRecorder, diagram.GetSubsystemByName("video"))
    frames = recorded_frames(recorder, scenario)
    name = f"{world.name}, seed {scenario.seed}"
    shown = replayed_flight(name, flight, frames)
    write_flight_page(out / "flight.html", scenario, world, [shown])
    written = ["flight.html", *FLIGHT_FILES, *([_TRACEBACK] if failure is not None else [])]
    if video:
        recorder.save(out / "flight.mp4", scenario.camera.z_far)
        written.insert(1, "flight.mp4")

    print(format_summary(summary))
    print(f"Wrote {', '.join(written)} in {out}")
    if live:
        with contextlib.suppress(EOFError):
            input("Press Enter to stop serving Meshcat. ")
    return summary


def fly_with_bar(
    diagram: Diagram, scenario: Scenario, world: World, realtime_rate: float = 0.0
) -> Flight:
    """`fly`, with a progress bar of simulated time."""
    layout = "{desc} {n:.1f} s of at most {total:.0f} s [{elapsed}]"
    with Progress(total=scenario.timeout, desc="flying", bar_format=layout, leave=False) as bar:
        return fly(
            diagram,
            scenario,
            world,
            progress=lambda now: bar.update(now - bar.n),
            realtime_rate=realtime_rate,
        )


def format_summary(summary: dict[str, float | str]) -> str:
    """The summary as a table of two columns."""
    rows = (
        ("outcome", "outcome", "{}"),
        ("flight time", "flight_time_s", "{:.2f} s"),
        ("path length", "path_length_m", "{:.2f} m"),
        ("mean speed", "mean_speed_m_s", "{:.2f} m/s"),
        ("minimum clearance", "min_clearance_m", "{:+.3f} m"),
        ("real-time factor", "real_time_factor", "{:.1f}"),
        ("render", "render_ms", "{:.1f} ms"),
    )
    return "\n".join(f"{title:<18} {form.format(summary[key])}" for title, key, form in rows)


def _render_ms(camera: SplatCamera, flight: Flight, num_views: int = 30) -> float:
    """Mean time of a render at poses evenly spaced along a flight [ms]."""
    rows = np.linspace(0, len(flight.states) - 1, num_views).astype(int)
    poses = [pose_from_state(state) for state in flight.states[rows]]
    started = time.perf_counter()
    for X_WB in poses:
        camera.render(X_WB)
    return (time.perf_counter() - started) / num_views * 1e3
