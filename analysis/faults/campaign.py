"""`splatpilot hardware faults`: many flights with random faults."""

import json
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from splatpilot.analysis.faults.trial import KINDS, Trial, fly_trial
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.files import claim_folder, locks_folder, written_atomically
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.validation import Config, bounded
from splatpilot.systems.messaging.flight_limits import FlightLimits


def _scenario() -> Scenario:
    return Scenario(world=ForestConfig(length=14.0, width=8.0, rocks=2, logs=1))


@dataclass
class FaultsConfig(Config):
    """A campaign."""

    # [-] Number of flights, which alternate between faults, commands and policies.
    trials: int = bounded(600, "[1, inf)")
    # Seed of everything random.
    seed: int = 0
    # [-] Number of worlds, which trials alternate between.
    worlds: int = bounded(10, "[1, inf)")
    # [m/s] Speed of the policies; `straight` collides without a failsafe.
    speed: float = 2.0
    # Limits that safe trials keep.
    limits: FlightLimits = field(default_factory=lambda: FlightLimits(max_speed=2.5))
    # Scenario of the trials, but for its policy and seed.
    scenario: Scenario = field(default_factory=_scenario)


@locks_folder("out")
def run(*, config: FaultsConfig, out: Path) -> dict[str, Any]:
    """Flies the trials, or resumes an interrupted campaign of the same configuration.

    Writes into `out`: `trials.jsonl`, results of `fly_trial`; `config.yaml`; `summary.json`, the
    number of safe trials and the outcomes by the type of fault, which is also returned.
    """
    config.validate()
    claim_folder(out / "config.yaml", config)
    lines = out / "trials.jsonl"
    rows = [json.loads(line) for line in lines.read_text().splitlines()] if lines.exists() else []
    world_of_seed = cache(lambda seed: make_world(config.scenario.world, seed))
    for number in Progress(range(len(rows), config.trials), "flying trials", unit="trial"):
        world = world_of_seed(config.seed + number % config.worlds)
        trial = Trial.sample(number, np.random.default_rng([config.seed, number]))
        seed, policy = config.seed + number, policy_named(trial.policy, config.speed)
        scenario = replace(config.scenario, seed=seed, policy=policy)
        rows.append(fly_trial(scenario, world, trial, config.limits, seed))
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
    """Counts safe trials, and outcomes by the type of fault."""
    kinds = {}
    for kind in KINDS:
        of_kind = [row for row in rows if kind in {fault["kind"] for fault in row["faults"]}]
        ends = [row["outcome"] for row in of_kind]
        kinds[kind] = {
            "trials": len(of_kind),
            "safe": sum(row["safe"] for row in of_kind),
            "outcomes": {end: ends.count(end) for end in sorted(set(ends))},
        }
    return {"trials": len(rows), "safe": sum(row["safe"] for row in rows), "kinds": kinds}
