"""`splatpilot faults`: flights in which something goes wrong, many, drawn at random."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatpilot.analysis.faults.fault import KINDS, Fault
from splatpilot.analysis.faults.trial import fly_trial
from splatpilot.diagrams.policies import policy_named
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.make_world import make_world
from splatpilot.systems.files import written_atomically
from splatpilot.systems.output_folders import claim_folder, holds_folder
from splatpilot.systems.progress import Progress


def _scenario() -> Scenario:
    return Scenario(
        world=ForestConfig(length=14.0, width=8.0, rocks=2, logs=1), policy=policy_named("reactive")
    )


@dataclass
class FaultsConfig:
    """A campaign."""

    # [-] Flights; the kinds of faults take turns.
    trials: int = 300
    # Seed of everything random.
    seed: int = 0
    # [-] Worlds that the trials take turns in.
    worlds: int = 10
    # What is flown; its policy must return accelerations.
    scenario: Scenario = field(default_factory=_scenario)

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("trials", "worlds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        self.scenario.validate()


@holds_folder("out")
def run(*, config: FaultsConfig, out: Path) -> dict[str, Any]:
    """
    Flies the trials, from where an interrupted campaign of the same configuration stopped.

    Leaves in `out`: `trials.jsonl`, what `fly_trial` says of each; `config.yaml`; `summary.json`,
    of each kind of fault how many trials were safe and how they ended.

    Returns:
        What `summary.json` says.

    Raises:
        ValueError: for a configuration out of range, or another than `out` has.
        OSError: if `out` cannot be written.
    """
    config.validate()
    claim_folder(out / "config.yaml", config)
    lines = out / "trials.jsonl"
    rows = [json.loads(line) for line in lines.read_text().splitlines()] if lines.exists() else []
    worlds: dict[int, Any] = {}
    for number in Progress(range(len(rows), config.trials), "flying trials", unit="trial"):
        world_seed = config.seed + number % config.worlds
        if world_seed not in worlds:
            worlds[world_seed] = make_world(config.scenario.world, world_seed)
        config.scenario.seed = config.seed + number
        fault = Fault.draw(number, np.random.default_rng([config.seed, number]))
        rows.append(fly_trial(config.scenario, worlds[world_seed], fault, config.seed + number))
        with written_atomically(lines) as path:
            path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    summary = summarize(rows)
    with written_atomically(out / "summary.json") as path:
        path.write_text(json.dumps(summary, indent=2) + "\n")
    print(f"{'fault':<16} {'safe':>9}  ended")
    for kind, row in summary["kinds"].items():
        ends = ", ".join(f"{name} {count}" for name, count in row["outcomes"].items())
        print(f"{kind:<16} {row['safe']:>4}/{row['trials']:<4}  {ends}")
    print(f"{summary['safe']} of {summary['trials']} trials were safe")
    return summary


def summarize(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """How many trials were safe, and how those of each kind ended."""
    kinds = {}
    for kind in KINDS:
        of_kind = [row for row in rows if row["kind"] == kind]
        ends = [row["outcome"] for row in of_kind]
        kinds[kind] = {
            "trials": len(of_kind),
            "safe": sum(row["safe"] for row in of_kind),
            "outcomes": {end: ends.count(end) for end in sorted(set(ends))},
        }
    return {"trials": len(rows), "safe": sum(row["safe"] for row in rows), "kinds": kinds}
