"""Studies: the same flights for every policy, with a unique name each."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from splatpilot.analysis.benchmark.variants import SCENARIO, Variant, flight_name, parse_variant
from splatpilot.diagrams.flight.policies import BENCHMARK_POLICIES, MAX_SPEED, policy_speed
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios, scenario_file
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.seeds import study_seeds
from splatpilot.systems.common.validation import require


class RolloutSpec(NamedTuple):
    """One flight of a study."""

    scenario: str
    policy: str
    speed: float  # [m/s]
    seed: int

    @property
    def id(self) -> str:
        """Its name: unique in a study, and valid as the name of a file."""
        return flight_name(self.scenario, self.policy, self.speed, self.seed)


@dataclass
class StudyConfig:
    """A study: scenarios x policies x speeds x seeds."""

    # Names of the benchmark's scenarios, or YAML files of others.
    scenarios: list[str] = field(default_factory=lambda: list(benchmark_scenarios()))
    # "[LABEL=]POLICY[:FIELD=VALUE...]" each, see `variants.parse_variant`.
    policies: list[str] = field(default_factory=lambda: list(BENCHMARK_POLICIES))
    # [m/s] Nominal speeds.
    speeds: list[float] = field(default_factory=lambda: [2.0])
    # Flights of each, with the first seeds of the split.
    seeds: int = 20
    # "dotted.field=YAML value", for all scenarios.
    overrides: list[str] = field(default_factory=list)
    # Seeds: "dev", for choosing, or "test", see `systems/common/seeds.py`.
    split: str = "dev"

    @property
    def variants(self) -> list[Variant]:
        """The policies, parsed."""
        return [parse_variant(policy) for policy in self.policies]

    @property
    def policy_names(self) -> list[str]:
        """The labels of the policies."""
        return [variant.label for variant in self.variants]

    @property
    def flies_own_policies(self) -> bool:
        """True if the scenarios' own policies fly."""
        return any(variant.policy == SCENARIO for variant in self.variants)

    def rollouts(self) -> list[RolloutSpec]:
        """Returns all flights; those through the same world are neighbors."""
        policies = self.policy_names
        return [
            RolloutSpec(Path(scenario).stem, policy, speed, seed)
            for scenario in self.scenarios
            for seed in study_seeds(self.split, self.seeds)
            for speed in self.speeds
            for policy in policies
        ]

    def load_scenarios(self) -> dict[str, Scenario]:
        """Loads the scenarios, by name, with the overrides, and checks that the study can fly."""
        self.validate()
        for override in self.overrides:
            _check_override(override)
        for variant in self.variants:
            for speed in self.speeds if variant.policy != SCENARIO else ():
                variant.config(speed, None)
        scenarios = {}
        for scenario in self.scenarios:
            file, name = scenario_file(scenario), Path(scenario).stem
            scenarios[name] = load_config(Scenario(), file, self.overrides)
            try:
                scenarios[name].validate()
                self._check_own_policy(file, scenarios[name].policy)
            except ValueError as error:
                raise ValueError(f"scenario {name}: {error}") from None
        return scenarios

    def validate(self) -> None:
        """Checks seeds and speeds, and that names are neither missing nor repeated."""
        study_seeds(self.split, self.seeds)
        for speed in self.speeds:
            require(0.0 < speed <= MAX_SPEED, "speeds", f"in (0, {MAX_SPEED:g}] m/s", f"{speed:g}")
        given: dict[str, list[Any]] = {
            "scenario": [Path(scenario).stem for scenario in self.scenarios],
            "policy": self.policy_names,
            "speed": [f"{speed:g}" for speed in self.speeds],
            "flight": [spec.id for spec in self.rollouts()],
        }
        for what, names in given.items():
            if not names:
                raise ValueError(f"the study has no {what}; name at least one")
            repeated = [name for k, name in enumerate(names) if name in names[:k]]
            if repeated:
                raise ValueError(
                    f"the {what} {repeated[0]} is given twice; give it once, or another name: "
                    "policies take one as LABEL=POLICY, scenarios that of their file"
                )

    def _check_own_policy(self, file: Path, policy: Any) -> None:
        """Checks that a scenario's own policy can fly, if it should."""
        if not self.flies_own_policies:
            return
        if not _has_own_policy(file):
            raise ValueError(f"{file} has no `policy`, which --policies {SCENARIO} would fly")
        speed = policy_speed(policy)
        if speed is not None and self.speeds != [speed]:
            raise ValueError(
                f"the policy of {file} flies at {speed:g} m/s, its own speed; give --speeds "
                f"{speed:g}"
            )
        for variant in self.variants:
            variant.config(self.speeds[0], policy)

    def unflown_policies(self) -> list[Path]:
        """Returns the files of scenarios with a policy of their own that the study does not fly."""
        if self.flies_own_policies:
            return []
        return [file for file in map(scenario_file, self.scenarios) if _has_own_policy(file)]


def _has_own_policy(file: Path) -> bool:
    """Checks that a file is a scenario with a `policy`."""
    try:
        root = yaml.compose(file.read_text(), yaml.SafeLoader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return False
    fields = root.value if isinstance(root, yaml.MappingNode) else []
    return any(name.value == "policy" for name, _ in fields)


def default_policies(scenarios: list[str]) -> list[str]:
    """Returns the default policies: the scenarios' own, if all have one, or the benchmark's."""
    own = all(_has_own_policy(scenario_file(scenario)) for scenario in scenarios)
    return [SCENARIO] if own else list(BENCHMARK_POLICIES)


def _check_override(override: str) -> None:
    """Checks that a field does not differ between the flights of a study."""
    field, _, value = override.partition("=")
    section, _, inner = field.partition(".")
    remedy = {
        "policy": f"policies, write --policies {f'NAME:{inner}={value}' if inner else 'NAME'}",
        "seed": "seeds, give their number with --seeds",
    }.get(section)
    if remedy:
        raise ValueError(
            f"a study must not override {field}, got {override!r}; its flights have their own "
            f"{remedy}"
        )
