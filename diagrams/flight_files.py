"""The files that a flight leaves, whoever flew it."""

import json
from pathlib import Path

from splatpilot.diagrams.flight import Flight
from splatpilot.diagrams.scenario import Scenario
from splatpilot.systems.configuration import dump_config
from splatpilot.systems.files import written_atomically

FLIGHT_FILES = "trajectory.npz", "summary.json", "scenario.yaml"


def write_flight(
    out: Path, scenario: Scenario, flight: Flight, summary: dict[str, float | str]
) -> None:
    """
    Writes into the folder `out`:

    - `trajectory.npz`: the arrays of `Flight`;
    - `summary.json`: `summary`;
    - `scenario.yaml`: the scenario with every field, which gives the same flight again.
    """
    trajectory, numbers, flown = (out / name for name in FLIGHT_FILES)
    with written_atomically(trajectory) as path:
        flight.save(path)
    with written_atomically(numbers) as path:
        path.write_text(json.dumps(summary, indent=2) + "\n")
    with written_atomically(flown) as path:
        path.write_text(dump_config(scenario))
