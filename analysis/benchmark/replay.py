"""`splatpilot replay`: flies one flight of a study again."""

import contextlib
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np

from splatpilot.analysis.benchmark.rollout import digest, study_world
from splatpilot.analysis.benchmark.study import RolloutSpec
from splatpilot.analysis.benchmark.study_folder import (
    StudyFolder,
    input_digests,
    kept_flights,
    plugin_digests,
)
from splatpilot.analysis.benchmark.tables import Row
from splatpilot.analysis.benchmark.variants import LIVE
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.fly import (
    flight_page,
    fly_with_bar,
    recorded_frames,
    replayed_flight,
)
from splatpilot.diagrams.flight.scenario import Scenario, sample_scenario
from splatpilot.systems.common.files import (
    require_unused,
    require_writable_folder,
    written_atomically,
)
from splatpilot.systems.common.provenance import program
from splatpilot.systems.vehicle.state import QuadrotorState
from splatpilot.systems.visualization.pages import ReplayedFlight
from splatpilot.systems.visualization.rerun_sink import RerunSink
from splatpilot.systems.visualization.video import VideoRecorder

_LOGS = "times", "states", "clearances"


def run(
    *,
    study: Path,
    id: str,
    out: Path | None = None,
    meshcat: bool = False,
    video: bool = False,
    rerun: Path | None = None,
    overwrite: bool = False,
) -> bool:
    """Flies one flight of a study again, from the study's folder alone; returns True if it is
    bitwise identical to its record. Page and video go to `replays/ID` in the study by default;
    `rerun` is the file of a `RerunSink`."""
    folder = StudyFolder(study)
    spec, row, recorded = _read_flight(folder, id)
    variants = folder.config().variants
    if any(each.label == spec.policy and each.policy == LIVE for each in variants):
        raise ValueError(
            f"{id} was flown by a system that a function of Python made; fly it again by the same "
            "call of study, in another folder"
        )
    scenario = sample_scenario(next(kept_flights(folder, [spec]))[1])
    world = study_world(scenario)
    out = out or study / "replays" / id
    files = [name for name, asked in {"flight.html": meshcat, "flight.mp4": video}.items() if asked]
    if filmed := bool(files):
        require_unused(out, overwrite)
        require_writable_folder(out)
    with contextlib.ExitStack() as stack:
        recording = stack.enter_context(written_atomically(rerun)) if rerun else None
        camera = filmed or recording is not None
        diagram = BuildFlightDiagram(scenario, world, video=filmed, camera=camera, rerun=recording)
        flight = fly_with_bar(diagram)
        if recording is not None:
            cast(RerunSink, diagram.GetSubsystemByName("rerun")).close()
    common = min(len(flight.times), len(recorded["times"]))
    flown, before = (
        QuadrotorState.of(states[:common]).p_WB for states in (flight.states, recorded["states"])
    )
    deviation = float(np.linalg.norm(flown - before, axis=1).max())
    exact = digest(flight) == row["digest"]
    print(f"{id}: {flight.outcome} after {flight.times[-1]:.2f} s")
    if exact:
        print("The replay is bitwise identical to the recorded flight.")
    else:
        print(
            f"THE REPLAY DIFFERS from the recorded flight ({row['outcome']}) by up to "
            f"{deviation:.3g} m. {_likely_reason(folder, spec, scenario)}."
        )
    if filmed:
        recorder = cast(VideoRecorder, diagram.GetSubsystemByName("video"))
        if meshcat:
            shown = replayed_flight(id, flight, recorded_frames(recorder, scenario))
            flight_page(scenario, world, [shown]).save(out / "flight.html")
        if video:
            recorder.save(out / "flight.mp4", scenario.camera.z_far)
        print(f"Wrote {' and '.join(files)} in {out}")
    return exact


def overlay(
    *, study: Path, ids: Sequence[str], out: Path | None = None, overwrite: bool = False
) -> Path:
    """Writes a page with several recorded flights through one world, without plans and images;
    `replays/FIRST-ID/flights.html` in the study by default."""
    folder = StudyFolder(study)
    records = [_read_flight(folder, id) for id in ids]
    first, flights = records[0][0], []
    for spec, row, arrays in records:
        if (spec.scenario, spec.seed) != (first.scenario, first.seed):
            raise ValueError(
                f"{spec.id} flew another world than {first.id}; name flights of one scenario and "
                "seed"
            )
        times, states, clearances = (arrays[name].astype(float) for name in _LOGS)
        no_plans = np.empty((0, 0))
        flights.append(ReplayedFlight(spec.id, row["outcome"], times, states, clearances, no_plans))
    scenario = sample_scenario(next(kept_flights(folder, [first]))[1])
    out = out or study / "replays" / first.id
    page = out / "flights.html"
    require_unused(page, overwrite)
    require_writable_folder(out)
    flight_page(scenario, study_world(scenario), flights).save(page)
    print(f"Wrote {page}")
    return page


def _read_flight(folder: StudyFolder, id: str) -> tuple[RolloutSpec, Row, dict[str, np.ndarray]]:
    specs = {spec.id: spec for spec in folder.config().rollouts()}
    if id not in specs:
        raise ValueError(
            f"{folder.path} has no flight {id!r}; its flights are named like {next(iter(specs))}, "
            "see rollouts.csv"
        )
    try:
        row, arrays = folder.read(specs[id])
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{id} has not been flown yet in {folder.path}; run the study again, it resumes"
        ) from None
    if not arrays:
        raise ValueError(f"{id} could not be flown and has no record: {row['reason']}")
    return specs[id], row, arrays


def _likely_reason(folder: StudyFolder, spec: RolloutSpec, scenario: Scenario) -> str:
    recorded, inputs = folder.program(), input_digests(folder.config(), {spec.scenario: scenario})
    scenes = {name: each for name, each in inputs.items() if name.startswith("scene of")}
    for name, version in (program() | plugin_digests([scenario]) | scenes).items():
        if recorded.get(name) != version:
            return f"It was flown by {name} {recorded.get(name, 'unknown')}, this is {version}"
    host = folder.read_timing(spec.id).get("host", "an unknown machine")
    if host != platform.node():
        return (
            f"It was flown on {host}, this is {platform.node()}: another C library, or a processor "
            "without AVX2, rounds differently"
        )
    return (
        f"It was flown by this program and machine: {spec.policy} keeps state outside of the "
        "Context, or draws random numbers without the seed"
    )
