"""Measures what realism costs: policies fly P01 to P12 ideally, under `realistic` and `harsh`, and
under each section of `harsh` alone.

    python -m splatpilot.analysis.realism out/realism --policies planner,diffaero --seeds 10

writes `realism.csv`, with a row for each condition and policy. The same command resumes.
"""

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from splatpilot.analysis.benchmark import run_study
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.analysis.benchmark.tables import Row
from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.diagrams.scenarios import benchmark_scenarios, profile_file
from splatpilot.systems.common.files import write_csv, write_text
from splatpilot.systems.common.validation import require

PROFILES = "ideal", "realistic", "harsh"
_ROTORS = ["vehicle=!Kingfisher {radius: 0.354}", "controller.disturbance_time=1.0"]
_UNFLOWN = "straight", "teleop"  # without sensors, and by hand


def write_effects(folder: Path) -> dict[str, list[str]]:
    """Writes a profile for each section of `harsh`, with its controller, and returns the overrides
    of each effect by name. `rotors` is another vehicle, of the same radius."""
    root: Any = yaml.compose(profile_file("harsh").read_text())
    sections = {key.value: (key, value) for key, value in root.value}
    controller = sections.pop("controller")
    folder.mkdir(parents=True, exist_ok=True)
    effects = {"rotors": _ROTORS}
    for name, section in sections.items():
        text = yaml.serialize(yaml.MappingNode(root.tag, [controller, section]))
        write_text(folder / f"{name}.yaml", text)
        effects[name] = [f"profile={folder / name}.yaml"]
    return effects


def compare(conditions: str, rows: Sequence[Row], ideal: Sequence[Row]) -> list[dict[str, Any]]:
    """Returns a row for each policy: numbers of flights by outcome, of those that succeed under
    these conditions alone (gained) or ideally alone (lost), and means of feasible flights."""
    key = "policy", "scenario", "seed"
    succeeded = {tuple(row[name] for name in key): row["success"] for row in ideal}
    table = []
    for policy in dict.fromkeys(row["policy"] for row in rows):
        flights = [row for row in rows if row["policy"] == policy]
        outcomes = Counter(row["outcome"] for row in flights)
        pairs = [(row["success"], succeeded[tuple(row[name] for name in key)]) for row in flights]
        flown = [row for row in flights if "min_clearance_m" in row]
        table.append(
            {
                "conditions": conditions,
                "policy": policy,
                "flights": len(flights),
                "successes": sum(now for now, _ in pairs),
                **{name: outcomes[name] for name in ("collision", "timeout", "left_volume")},
                "lost": sum(before and not now for now, before in pairs),
                "gained": sum(now and not before for now, before in pairs),
                "clearance_m": f"{np.mean([row['min_clearance_m'] for row in flown]):.3f}",
                "time_s": f"{np.mean([row['flight_time_s'] for row in flown]):.2f}",
            }
        )
    return table


def run(
    *, out: Path, policies: Sequence[str], seeds: int, effect_seeds: int, split: str = "test"
) -> list[dict[str, Any]]:
    """Flies `seeds` flights of each scenario and profile, and `effect_seeds` of each effect."""
    require(seeds >= 1, "--seeds", "at least 1", seeds)
    require(0 <= effect_seeds <= seeds, "--effect-seeds", f"in [0, {seeds}]", effect_seeds)
    scenarios = [name for name in benchmark_scenarios() if name.startswith("P")]
    profiles = {name: [] if name == "ideal" else [f"profile={name}"] for name in PROFILES}
    table, ideal, first = [], [], ""
    for name, overrides in (profiles | write_effects(out / "effects")).items():
        count = seeds if name in profiles else effect_seeds
        if not count:
            continue
        config = StudyConfig(scenarios, list(policies), seeds=count, split=split)
        config.overrides = overrides
        rows = run_study.run(config=config, out=out / name, jobs=1, report=False).rows
        flown_by = StudyFolder(out / name).program()["splatpilot"]
        first, ideal = first or flown_by, ideal or rows
        remedy = "choose another folder for all conditions"
        require(flown_by == first, f"revision of {out / name}", first, flown_by, remedy)
        table += compare(name, rows, ideal)
        write_csv(out / "realism.csv", table)
    return table


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", type=Path)
    released = [name for name in POLICIES.registered() if name not in _UNFLOWN]
    parser.add_argument("--policies", type=lambda text: text.split(","), default=released)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--effect-seeds", type=int, default=1)
    run(**vars(parser.parse_args()))
