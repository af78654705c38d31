"""The files that a flight leaves, whoever flew it."""

import json
from pathlib import Path

from splatpilot.diagrams.flight import Flight
from splatpilot.diagrams.scenario import Scenario
from splatpilot.systems.configuration import dump_config
from splatpilot.systems.files import written_atomically

FLIGHT_FILES = "trajectory.npz", "scenario.yaml", "summary.json"


def write_flight(out: Path, scenario: Scenario, flight: Flight) -> None:
    """
    Writes into the folder `out`, before anything else is made of the flight:

    - `trajectory.npz`: the arrays of `Flight`;
    - `scenario.yaml`: the scenario with every field, which gives the same flight again.
    """
    with written_atomically(out / "trajectory.npz") as path:
        flight.save(path)
    with written_atomically(out / "scenario.yaml") as path:
        path.write_text(dump_config(scenario))


def write_summary(out: Path, summary: dict[str, float | str]) -> None:
    """Writes `summary.json` into the folder `out`: the flight in numbers."""
    with written_atomically(out / "summary.json") as path:
        path.write_text(json.dumps(summary, indent=2) + "\n")
