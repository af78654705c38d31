"""What a study is: the same flights for every policy, each with a name by which it can be flown
again."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from splatpilot.diagrams.policies import BENCHMARK_POLICIES, policy_named
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.scenario_files import benchmark_scenarios, scenario_file
from splatpilot.systems.configuration import load_config
from splatpilot.systems.seeds import TRAINING_SEEDS


class RolloutSpec(NamedTuple):
    """One flight of a study."""

    scenario: str
    policy: str
    speed: float  # [m/s]
    seed: int

    @property
    def id(self) -> str:
        """Its name: unique in a study, and good as the name of a file."""
        return f"{self.scenario}-{self.policy}-{self.speed:g}-{self.seed:03d}"


@dataclass
class StudyConfig:
    """A study: scenarios x policies x speeds x seeds."""

    # Names of the benchmark's scenarios, or YAML files of others.
    scenarios: list[str] = field(default_factory=lambda: list(benchmark_scenarios()))
    # Names of policies, or files of weights (.npz), whose policies are named after the file.
    policies: list[str] = field(default_factory=lambda: list(BENCHMARK_POLICIES))
    # [m/s] Nominal speeds.
    speeds: list[float] = field(default_factory=lambda: [2.0])
    # Flights of each, with the seeds from 0 on.
    seeds: int = 20
    # "dotted.field=YAML value", for all scenarios.
    overrides: list[str] = field(default_factory=list)

    @property
    def policy_names(self) -> list[str]:
        """The policies by the names that their flights bear."""
        return [Path(policy).stem for policy in self.policies]

    def rollouts(self) -> list[RolloutSpec]:
        """All flights; those through the same place stand together."""
        return [
            RolloutSpec(Path(scenario).stem, policy, speed, seed)
            for scenario in self.scenarios
            for seed in range(self.seeds)
            for speed in self.speeds
            for policy in self.policy_names
        ]

    def load_scenarios(self) -> dict[str, Scenario]:
        """
        The scenarios by name, with the overrides.

        Raises:
            ValueError: for an unknown scenario, policy or speed, anything given twice, and values
                that cannot be flown; the message names it and what there is.
        """
        if not 1 <= self.seeds <= TRAINING_SEEDS:
            raise ValueError(f"seeds is {self.seeds}; it must be 1 to {TRAINING_SEEDS}")
        names = [Path(scenario).stem for scenario in self.scenarios]
        given: dict[str, list[Any]]
        given = {"scenario": names, "policy": self.policy_names, "speed": self.speeds}
        for what, values in given.items():
            if not values:
                raise ValueError(f"the study has no {what}; name at least one")
            twice = [value for value in values if values.count(value) > 1]
            if twice:
                raise ValueError(
                    f"the {what} {twice[0]} is given twice; give it once, or rename the file"
                )
        for override in self.overrides:
            field = override.partition("=")[0].partition(".")[0]
            if field in ("policy", "seed"):
                raise ValueError(
                    f"the override {override!r} has no place in a study: each of its flights has "
                    "its own policy, speed and seed; name them with --policies (also files of "
                    "weights), --speeds and --seeds"
                )
        for speed in self.speeds:
            if not 0.0 < speed < math.inf:
                raise ValueError(f"the speed {speed:g} m/s cannot be flown; it must be positive")
            for policy in self.policies:
                policy_named(policy, speed)
        scenarios = {}
        for name, scenario in zip(names, self.scenarios, strict=True):
            loaded = load_config(Scenario(), scenario_file(scenario), self.overrides)
            try:
                loaded.validate()
            except ValueError as error:
                raise ValueError(f"scenario {name}: {error}") from None
            scenarios[name] = loaded
        return scenarios


def scenario_of(
    spec: RolloutSpec, scenario: Scenario, weights: Mapping[str, str] | None = None
) -> Scenario:
    """The scenario of one flight: with its policy, speed and seed.

    Args:
        spec: the flight.
        scenario: without these.
        weights: files of weights by the names of their policies; others fly as they ship.
    """
    policy = (weights or {}).get(spec.policy, spec.policy)
    return replace(scenario, policy=policy_named(policy, spec.speed), seed=spec.seed)
