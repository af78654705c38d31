"""Parameters and policies of `study` as texts of a `StudyConfig`."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, cast

import numpy as np
import yaml

from splatpilot.analysis.benchmark.rollout import MakeSystem
from splatpilot.analysis.benchmark.variants import LIVE, SCENARIO, default_label
from splatpilot.diagrams.flight.policies import POLICIES, policy_name, policy_speed
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.systems.common.config import dump_config, yaml_line
from splatpilot.systems.common.distributions import distribution_text, draw, is_distribution
from splatpilot.systems.common.validation import require


def parameter_rows(parameters: Any, samples: int | None = None) -> list[dict[str, Any]]:
    """Returns rows of values, or distributions, by dotted fields of a scenario.

    Args:
        parameters: a table (a DataFrame, or a list of rows), whose missing values are left out; or
            a grid (a dictionary of lists: all combinations), which may have distributions.
        samples: number of values drawn from the distributions. By default these stay, and each
            flight draws by its seed.
    """
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
    require(samples is None or drawn, "samples", "None without distributions", samples)
    require(samples is None or samples >= 1, "samples", "at least 1", samples)
    draws = [drawn]
    if samples is not None:
        draws = [
            {name: draw(distribution, seed, name) for name, distribution in drawn.items()}
            for seed in range(samples)
        ]
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
    plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    plain = str(plain) if isinstance(plain, Path) else plain
    return yaml_line(plain)


def policy_texts(policies: Any) -> tuple[list[str], dict[str, MakeSystem], list[float]]:
    """Converts the policies of `study`.

    Returns:
        Texts for `parse_variant`; functions that make systems, by label; speeds [m/s] of the
        configurations.
    """
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
    return [
        str(name) for name in ([scenario] if isinstance(scenario, str | Path) else scenario)
    ], {}
