"""Studies: the same flights for every policy, with a unique name each."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from splatpilot.analysis.benchmark.variants import (
    LIVE,
    SCENARIO,
    ScenarioVariant,
    Variant,
    flight_name,
    parse_scenario,
    parse_variant,
)
from splatpilot.diagrams.flight.policies import (
    BENCHMARK_POLICIES,
    MAX_SPEED,
    POLICIES,
    policy_speed,
)
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios, scenario_file
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.provenance import study_seeds
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

    # "[LABEL=]SCENARIO[:FIELD=VALUE...]" each: a name of the benchmark's or a YAML file, and
    # fields that are changed, see `variants.parse_scenario`.
    scenarios: list[str] = field(default_factory=lambda: list(benchmark_scenarios()))
    # "[LABEL=]POLICY[:FIELD=VALUE...]" each, see `variants.parse_variant`.
    policies: list[str] = field(default_factory=lambda: list(BENCHMARK_POLICIES))
    # [m/s] Nominal speeds.
    speeds: list[float] = field(default_factory=lambda: [2.0])
    # Flights of each, with the first seeds of the split.
    seeds: int = 20
    # "dotted.field=YAML value", for all scenarios.
    overrides: list[str] = field(default_factory=list)
    # Seeds: "dev", for choosing, or "test", see `systems/common/provenance.py`.
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
    def scenario_variants(self) -> list[ScenarioVariant]:
        """The scenarios, parsed."""
        return [parse_scenario(scenario) for scenario in self.scenarios]

    @property
    def flies_own_policies(self) -> bool:
        """True if the scenarios' own policies fly."""
        return any(variant.policy == SCENARIO for variant in self.variants)

    def rollouts(self) -> list[RolloutSpec]:
        """Returns all flights; those through the same world are neighbors."""
        policies, worlds = self.policy_names, {}
        for scenario in self.scenario_variants:
            worlds.setdefault(scenario.world, []).append(scenario.label)
        return [
            RolloutSpec(label, policy, speed, seed)
            for labels in worlds.values()
            for seed in study_seeds(self.split, self.seeds)
            for label in labels
            for speed in self.speeds
            for policy in policies
        ]

    def load_scenarios(self, given: Mapping[str, Scenario] | None = None) -> dict[str, Scenario]:
        """Loads the scenarios, by label, with the overrides, and checks that the study can fly.

        Args:
            given: scenarios by name; others are found by `scenario_file`.
        """
        self.validate()
        for override in self.overrides:
            _check_override(override, "")
        scenarios = {}
        for variant in self.scenario_variants:
            for override in variant.overrides:
                _check_override(override, f" by scenario {variant.label}")
            overrides = [*self.overrides, *variant.overrides]
            if given and variant.scenario in given:
                scenario = load_config(given[variant.scenario], overrides=overrides)
            else:
                file = scenario_file(variant.scenario)
                scenario = load_config(Scenario(), file, overrides)
                self._check_own_policy(file)
            try:
                scenario.validate()
                self._check_policies(variant, scenario.policy)
            except ValueError as error:
                raise ValueError(f"scenario {variant.label}: {error}") from None
            scenarios[variant.label] = scenario
        return scenarios

    def _check_policies(self, scenario: ScenarioVariant, own: Any) -> None:
        """Checks that all policies can fly in a scenario, with its policy `own`."""
        for variant in self.variants:
            for speed in self.speeds:
                config = variant.config(speed, own, scenario.policy_overrides)
                field = POLICIES.entry_for(config).speed_field
                if f"policy.{field}" in scenario.fields:
                    raise ValueError(
                        f"a study must not set policy.{field}; give the speeds of all policies by "
                        "speeds"
                    )
                if variant.policy == SCENARIO:
                    flown = policy_speed(config)
                    if isinstance(flown, float | int) and self.speeds != [flown]:
                        raise ValueError(
                            f"its policy flies at {flown:g} m/s, its own speed; give --speeds "
                            f"{flown:g}"
                        )
                if variant.policy == LIVE and len(self.speeds) > 1:
                    raise ValueError(
                        f"policy {variant.label} is made by a function; give one speed"
                    )

    def validate(self) -> None:
        """Checks seeds and speeds, and that names are neither missing nor repeated."""
        study_seeds(self.split, self.seeds)
        for speed in self.speeds:
            require(0.0 < speed <= MAX_SPEED, "speeds", f"in (0, {MAX_SPEED:g}] m/s", f"{speed:g}")
        given: dict[str, list[Any]] = {
            "scenario": [scenario.label for scenario in self.scenario_variants],
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

    def _check_own_policy(self, file: Path) -> None:
        """Checks that a scenario's file has a policy, if it should fly."""
        if self.flies_own_policies and not _has_own_policy(file):
            raise ValueError(f"{file} has no `policy`, which --policies {SCENARIO} would fly")

    def unflown_policies(self, given: Collection[str] = ()) -> list[Path]:
        """Returns the files of scenarios with a policy of their own that the study does not fly;
        `given` scenarios have no file."""
        if self.flies_own_policies:
            return []
        names = dict.fromkeys(scenario.scenario for scenario in self.scenario_variants)
        files = [scenario_file(name) for name in names if name not in given]
        return [file for file in files if _has_own_policy(file)]


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
    files = [scenario_file(parse_scenario(scenario).scenario) for scenario in scenarios]
    own = all(map(_has_own_policy, files))
    return [SCENARIO] if own else list(BENCHMARK_POLICIES)


def _check_override(override: str, where: str) -> None:
    """Checks that a field does not differ between the flights of a study."""
    field, _, value = override.partition("=")
    section, _, inner = field.partition(".")
    remedy = {
        "policy": f"policies, write --policies {f'NAME:{inner}={value}' if inner else 'NAME'}",
        "seed": "seeds, give their number with --seeds",
    }.get(section)
    if remedy:
        raise ValueError(
            f"a study must not override {field}{where}, got {override!r}; its flights have their "
            f"own {remedy}"
        )
