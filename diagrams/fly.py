"""`splatpilot fly`: one flight, with everything a person wants to see of it afterwards."""

import contextlib
import json
import time
from pathlib import Path
from typing import cast

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams
from tqdm import tqdm

from splatpilot.diagrams.flight import Flight, fly, sample_initial_state
from splatpilot.diagrams.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.pilot import goal_of
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.make_world import make_world
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.configuration import dump_config
from splatpilot.systems.files import require_writable_folder, written_atomically
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.state_to_pose import pose_from_state
from splatpilot.systems.visualization.video_recorder import VideoRecorder


def run(
    *, scenario: Scenario, out: Path, live: bool = False, graphviz: Path | None = None
) -> dict[str, float | str]:
    """
    Flies a scenario and leaves in `out`:

    - `flight.html`: the flight in Meshcat, to replay in a browser;
    - `flight.mp4`: what the onboard camera saw, colour beside depth;
    - `trajectory.npz`: the arrays of `Flight`;
    - `summary.json`: the summary this function returns;
    - `scenario.yaml`: the scenario with every field, which gives the same flight again.

    Args:
        live: serves Meshcat while flying, at real time, and afterwards until Enter is pressed.
        graphviz: where to write the diagram as Graphviz source.

    Returns:
        `Flight.summary()` and `render_ms`, the mean time of a render along the flight [ms].

    Raises:
        ValueError: for a scenario that cannot be flown.
        OSError: if `out` cannot be written; nothing is flown then.
    """
    scenario.validate()
    print(f"Building the world, seed {scenario.seed}...", flush=True)
    world = make_world(scenario.world, scenario.seed)
    sample_initial_state(scenario, world)  # Refuses a start or goal without room before the rest.
    require_writable_folder(out)
    if graphviz is not None:
        require_writable_folder(graphviz.parent)

    meshcat = open_meshcat(scenario, world)
    if live:
        print(f"Meshcat shows the flight at {meshcat.web_url()}", flush=True)
    camera, flight = film_flight(
        scenario,
        world,
        meshcat,
        page=out / "flight.html",
        video=out / "flight.mp4",
        graphviz=graphviz,
        realtime_rate=1.0 if live else 0.0,
    )
    summary = flight.summary() | {"render_ms": _render_ms(camera, flight)}
    with written_atomically(out / "trajectory.npz") as path:
        flight.save(path)
    with written_atomically(out / "scenario.yaml") as path:
        path.write_text(dump_config(scenario))
    with written_atomically(out / "summary.json") as path:
        path.write_text(json.dumps(summary, indent=2) + "\n")

    print(format_summary(summary))
    print(f"Wrote flight.html, flight.mp4, trajectory.npz, summary.json, scenario.yaml in {out}")
    if live:
        with contextlib.suppress(EOFError):
            input("Press Enter to stop serving Meshcat. ")
    return summary


def film_flight(
    scenario: Scenario,
    world: World,
    meshcat: Meshcat | None = None,
    *,
    page: Path | None = None,
    video: Path | None = None,
    graphviz: Path | None = None,
    realtime_rate: float = 0.0,
) -> tuple[SplatCamera, Flight]:
    """
    Flies a scenario and films it; what is filmed changes nothing of the flight.

    Args:
        scenario, world: the flight.
        meshcat: draws the flight there.
        page: where to write what Meshcat shows, to replay in a browser.
        video: where to write what the onboard camera saw, colour beside depth.
        graphviz: where to write the diagram as Graphviz source.
        realtime_rate: simulated over real time to slow down to; 0 for as fast as possible.

    Returns:
        The onboard camera and the flight.

    Raises:
        ValueError: for a scenario that cannot be flown.
        OSError: if a file cannot be written.
    """
    diagram = BuildFlightDiagram(scenario, world, meshcat, video=video is not None)
    if graphviz is not None:
        with written_atomically(graphviz) as path:
            path.write_text(diagram.GetGraphvizString())

    if meshcat is not None:
        meshcat.StartRecording(frames_per_second=scenario.policy.rate)
    layout = "{desc} {n:.1f} s of at most {total:.0f} s [{elapsed}]"
    with tqdm(
        total=scenario.timeout, desc="flying", bar_format=layout, leave=False, disable=None
    ) as bar:
        flight = fly(
            diagram,
            scenario,
            world,
            progress=lambda now: bar.update(now - bar.n),
            realtime_rate=realtime_rate,
        )
    if video is not None:
        recorder = cast(VideoRecorder, diagram.GetSubsystemByName("video"))
        recorder.save(video, max_depth=scenario.camera.z_far)
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
        if page is not None:
            with written_atomically(page) as path:
                path.write_text(meshcat.StaticHtml())
    return cast(SplatCamera, diagram.GetSubsystemByName("camera")), flight


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


def open_meshcat(scenario: Scenario, world: World) -> Meshcat:
    """A Meshcat whose camera is behind and above the start and looks towards the goal."""
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    p_WS = np.asarray(world.p_WS if scenario.start is None else scenario.start, dtype=float)
    along = goal_of(scenario, world) - p_WS
    along /= max(np.linalg.norm(along), 1e-6)
    meshcat.SetCameraPose(p_WS - 4.0 * along + [0.0, 0.0, 2.0], p_WS + 4.0 * along)
    return meshcat


def _render_ms(camera: SplatCamera, flight: Flight, num_views: int = 30) -> float:
    """Mean time of a render at poses evenly spaced along a flight [ms]."""
    rows = np.linspace(0, len(flight.states) - 1, num_views).astype(int)
    poses = [pose_from_state(state) for state in flight.states[rows]]
    started = time.perf_counter()
    for X_WB in poses:
        camera.render(X_WB)
    return (time.perf_counter() - started) / num_views * 1e3
