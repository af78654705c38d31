"""Studies: the same flights for every policy, with a unique name each."""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import yaml
from pydrake.systems.framework import System

from splatpilot.analysis.benchmark.variants import (
    BENCHMARK_POLICIES,
    LIVE,
    SCENARIO,
    ScenarioVariant,
    Variant,
    default_label,
    flight_name,
    parse_scenario,
    parse_variant,
)
from splatpilot.diagrams.flight.policies import MAX_SPEED, POLICIES, policy_name, policy_speed
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios, scenario_file
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.common.config import dump_config, load_config, yaml_line
from splatpilot.systems.common.distributions import distribution_text, draw, is_distribution
from splatpilot.systems.common.provenance import study_seeds
from splatpilot.systems.common.validation import errors_about, require

MakeSystem = Callable[[Scenario, World], System]
"""Makes the system of a policy for one flight."""


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
        """Loads the scenarios, by label, with the overrides, and checks that the study can fly;
        `given` are scenarios by name, others are found by `scenario_file`."""
        self.validate()
        _check_overrides(self.overrides, "")
        scenarios = {}
        for variant in self.scenario_variants:
            _check_overrides(variant.overrides, f" by scenario {variant.label}")
            overrides = [*self.overrides, *variant.overrides]
            if given and variant.scenario in given:
                scenario = load_config(given[variant.scenario], overrides=overrides)
            else:
                file = scenario_file(variant.scenario)
                scenario = load_config(Scenario(), file, overrides)
                if self.flies_own_policies and not _has_own_policy(file):
                    raise ValueError(
                        f"{file} has no `policy`, which --policies {SCENARIO} would fly"
                    )
            with errors_about(f"scenario {variant.label}"):
                scenario.validate()
                self._check_policies(variant, scenario.policy)
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

    def unflown_policies(self, given: Collection[str] = ()) -> list[Path]:
        """Returns the files of scenarios with a policy of their own that the study does not fly;
        `given` scenarios have no file."""
        if self.flies_own_policies:
            return []
        names = dict.fromkeys(scenario.scenario for scenario in self.scenario_variants)
        files = [scenario_file(name) for name in names if name not in given]
        return [file for file in files if _has_own_policy(file)]


def _has_own_policy(file: Path) -> bool:
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


def own_speeds(config: StudyConfig) -> list[float]:
    """Returns the speed of the scenarios' own policies, if no other ones fly; empty if they have
    none or several."""
    if config.policies != [SCENARIO]:
        return []
    files = {scenario_file(variant.scenario) for variant in config.scenario_variants}
    first, *others = [policy_speed(load_config(Scenario(), file).policy) for file in files]
    if isinstance(first, float) and all(speed == first for speed in others):
        return [first]
    return []


def _check_overrides(overrides: Iterable[str], where: str) -> None:
    """Checks that no field is set that differs between the flights of a study."""
    for override in overrides:
        field, _, value = override.partition("=")
        section, _, inner = field.partition(".")
        remedy = {
            "policy": f"policies, write --policies {f'NAME:{inner}={value}' if inner else 'NAME'}",
            "seed": "seeds, give their number with --seeds",
        }.get(section)
        if remedy:
            raise ValueError(
                f"a study must not override {field}{where}, got {override!r}; its flights have "
                f"their own {remedy}"
            )


def parameter_rows(parameters: Any, samples: int | None = None) -> list[dict[str, Any]]:
    """Returns rows of values, or distributions, by dotted fields of a scenario; for the arguments
    see `run_study.study`. Missing values of a table are left out."""
    if parameters is None:
        return [{}]
    if isinstance(parameters, Mapping):
        return _grid(parameters, samples)
    require(samples is None, "samples", "None without distributions", samples)
    rows = parameters.to_dict("records") if hasattr(parameters, "to_dict") else parameters
    return [{name: value for name, value in row.items() if not _is_missing(value)} for row in rows]


def _grid(parameters: Mapping[str, Any], samples: int | None) -> list[dict[str, Any]]:
    drawn = {name: value for name, value in parameters.items() if is_distribution(value)}
    lists = {name: value for name, value in parameters.items() if name not in drawn}
    for name, values in lists.items():
        valid = isinstance(values, Iterable) and not isinstance(values, str)
        require(valid, f"parameters[{name!r}]", "a list of values or a distribution", values)
    draws = [drawn]
    if samples is not None:
        require(drawn, "samples", "None without distributions", samples)
        require(samples >= 1, "samples", "at least 1", samples)
        draws = [{name: draw(drawn[name], seed, name) for name in drawn} for seed in range(samples)]
    rows = [dict(zip(lists, values, strict=True)) for values in product(*lists.values())]
    return [row | values for row in rows for values in draws]


def _is_missing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def scenario_texts(names: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Returns scenarios with the fields of each row, as `parse_scenario` reads them."""
    rows = list(rows)
    return [
        ":".join([name, *(f"{field}={_text(value)}" for field, value in row.items())])
        for name in names
        for row in rows
    ]


def _text(value: Any) -> str:
    if is_distribution(value):
        return distribution_text(value)
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    return yaml_line(str(value) if isinstance(value, Path) else value)


def policy_texts(policies: Any) -> tuple[list[str], dict[str, MakeSystem], list[float]]:
    """Converts the policies of `study` to texts for `parse_variant`, functions that make systems by
    label, and speeds [m/s] of the configurations."""
    if policies is None:
        return [SCENARIO], {}, []
    if isinstance(policies, Mapping):
        named = [(str(label), policy) for label, policy in policies.items()]
    else:
        single = isinstance(policies, str) or not isinstance(policies, Sequence)
        named = [("", policy) for policy in ([policies] if single else policies)]
    texts, systems, speeds = [], {}, []
    for label, policy in named:
        prefix = f"{label}=" if label else ""
        if isinstance(policy, str):
            texts.append(prefix + policy)
        elif callable(policy) and not isinstance(policy, type):
            label = label or getattr(policy, "__name__", type(policy).__name__)
            valid = label.isidentifier() or prefix
            require(valid, "a policy", "named", label, "write policies={LABEL: FUNCTION}")
            texts.append(f"{label}={LIVE}")
            systems[label] = cast(MakeSystem, policy)
        else:
            name, overrides = _config_overrides(policy)
            prefix = prefix or f"{default_label(name, overrides)}="
            texts.append(":".join([prefix + name, *overrides]))
            speeds += [speed for speed in [policy_speed(policy)] if isinstance(speed, float | int)]
    return texts, systems, speeds


def _config_overrides(config: Any) -> tuple[str, list[str]]:
    """Returns the name of a configuration's policy, and the fields that are not its defaults."""
    entry = POLICIES.entry_for(config)
    what = f"a policy's configuration {type(config).__name__}"
    remedy = "register it by register_policy"
    require(type(config) is entry.config, what, "registered", "another type", remedy)
    node, default = (yaml.compose(dump_config(each)) for each in (config, entry.config()))
    changed = dict(_differences(node, default, ()))
    changed.pop(entry.speed_field, None)
    return policy_name(config), [f"{name}={text}" for name, text in changed.items()]


def _differences(node: Any, default: Any, path: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Yields dotted names and YAML of the values in which two YAML nodes differ."""
    texts = [_one_line(each) for each in (node, default)]
    if texts[0] == texts[1]:
        return
    same = isinstance(node, yaml.MappingNode) and node.tag == getattr(default, "tag", "")
    defaults = {key.value: value for key, value in default.value} if same else {}
    if not same or [key.value for key, _ in node.value] != list(defaults):
        yield ".".join(path), texts[0]
        return
    for key, value in node.value:
        yield from _differences(value, defaults[key.value], (*path, key.value))


def _one_line(node: Any) -> str:
    nodes = [node]
    for each in nodes:
        if isinstance(each, yaml.CollectionNode):
            each.flow_style = True
            pairs = each.value if isinstance(each, yaml.MappingNode) else [each.value]
            nodes += [part for pair in pairs for part in pair]
    return yaml.serialize(node, width=math.inf).removesuffix("...\n").strip()


def named_scenarios(scenario: Any) -> tuple[list[str], dict[str, Scenario]]:
    """Returns the names of scenarios, and the given `Scenario` objects by name; a single object is
    named after its world."""
    if isinstance(scenario, Scenario):
        name = type(scenario.world).__name__.removesuffix("Config").lower()
        return [name], {name: scenario}
    if isinstance(scenario, Mapping):
        return list(scenario), dict(scenario)
    names = [scenario] if isinstance(scenario, str | Path) else scenario
    return [str(name) for name in names], {}
