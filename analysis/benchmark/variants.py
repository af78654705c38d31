"""Policies and scenarios of a study, with changed fields and a label that names their flights."""

import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from splatpilot.systems.common.validation import errors_about, require

SCENARIO = "scenario"
"""The policy of the scenario itself, its `policy` block."""

LIVE = "live"
"""A policy that a function of Python makes for each flight, see `run_study.study`."""

BENCHMARK_POLICIES = "planner", "straight", "reactive", "diffaero", "depthnav", "agile_autonomy"
"""Default policies of a study: the planner, baselines and the published policies."""

_LABEL = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,79}")
_WEIGHTS = "weights="
_FIELD = r"[A-Za-z_][\w.]*="
_OUTSIDE_BRACKETS = r"(?![^\[{(]*[\]})])"


class Variant(NamedTuple):
    """A policy, with a label and changed fields of its configuration."""

    label: str  # names its flights, and files
    policy: str  # registered name, file of weights (.npz), "module:Class", or `SCENARIO`
    overrides: tuple[str, ...] = ()  # "dotted.field=YAML value" of its configuration

    @property
    def weights(self) -> Path | None:
        """The file of weights, if the policy or its field `weights` is one."""
        given = [text.partition("=")[2] for text in self.overrides if text.startswith(_WEIGHTS)]
        if given:
            import yaml  # the command line parses variants before slow imports

            return Path(str(yaml.safe_load(given[-1])))
        return Path(self.policy) if self.policy.endswith(".npz") else None

    def with_weights(self, file: Path) -> "Variant":
        """Returns the policy with its weights in another file."""
        if self.policy.endswith(".npz"):
            return self._replace(policy=str(file))
        return self._replace(overrides=(*self.overrides, _WEIGHTS + json.dumps(str(file))))

    def config(self, speed: float, own: Any, overrides: Sequence[str] = ()) -> Any:
        """Returns the configuration for a nominal speed [m/s]; `own` is the scenario's policy, and
        its `overrides` come after those of the variant."""
        # The command line parses variants before slow imports.
        from splatpilot.diagrams.flight.policies import policy_named
        from splatpilot.systems.common.config import load_config
        from splatpilot.systems.common.distributions import sample_distributions

        config = own if self.policy in (SCENARIO, LIVE) else policy_named(self.policy, speed)
        overrides = [*self.overrides, *overrides]
        if not overrides:
            return config
        with errors_about(f"policy {self.label}"):
            config = load_config(config, overrides=overrides)
            sample_distributions(config, 0, ("policy",)).validate()
        return config


class ScenarioVariant(NamedTuple):
    """A scenario, with a label and changed fields."""

    label: str  # names its flights, and files
    scenario: str  # name, or YAML file
    overrides: tuple[str, ...] = ()  # "dotted.field=YAML value" of all but its policy
    policy_overrides: tuple[str, ...] = ()  # of the policy that flies

    @property
    def base(self) -> str:
        """The name of the scenario without the changes."""
        return re.sub(r"\.ya?ml$", "", self.scenario)

    @property
    def world(self) -> tuple[str, ...]:
        """Equal for variants of a scenario that have the same worlds."""
        return (self.scenario, *(text for text in self.overrides if text.startswith("world")))

    @property
    def fields(self) -> list[str]:
        """The dotted names of the changed fields."""
        inner = [f"policy.{text}" for text in self.policy_overrides]
        return [text.partition("=")[0] for text in (*self.overrides, *inner)]


def parse_scenario(text: str) -> ScenarioVariant:
    """Parses `[LABEL=]SCENARIO[:FIELD=VALUE...]`; the default label is `default_label`, so
    `P02:world.spacing=2` is labeled `P02-world.spacing-2`."""
    label, _, rest = text.partition("=")
    if not (rest and _LABEL.fullmatch(label)):
        label, rest = "", text
    scenario, *overrides = re.split(f":(?={_FIELD})", rest)
    if not label:
        label = default_label(re.sub(r"\.ya?ml$", "", Path(scenario).name), overrides)
    inner = [each.removeprefix("policy.") for each in overrides if each.startswith("policy.")]
    others = [each for each in overrides if not each.startswith("policy.")]
    return ScenarioVariant(label, scenario, tuple(others), tuple(inner))


def default_label(name: str, overrides: Sequence[str]) -> str:
    """Returns a name with fields that are set, or with a digest of them if it names no file."""
    label = "-".join([name, *(override.replace("=", "-", 1) for override in overrides)])
    if not overrides or _LABEL.fullmatch(label):
        return label
    return f"{name}-{hashlib.sha256(':'.join(overrides).encode()).hexdigest()[:8]}"


def parse_variant(text: str) -> Variant:
    """Parses `[LABEL=]POLICY[:FIELD=VALUE...]`; the default label is the name of the policy, class
    or file with the fields that are set: `reactive-margin-0.2`."""
    label, _, rest = text.partition("=")
    if text.startswith("="):
        raise ValueError(f"the policy {text[:100]!r} has no label before its =; give it one")
    if "=" not in text or ":" in label:
        label, rest = "", text
    policy, *overrides = re.split(f":(?={_FIELD})", rest)
    for override in overrides:
        if override.partition("=")[0].rpartition(".")[2] == "speed":
            raise ValueError(
                f"the policy {text!r} must not set speed; give the speed of all policies by "
                "--speed (fly) or --speeds (benchmark)"
            )
    file = Path(policy[:100])
    require(
        policy.endswith(".npz") or not (policy.endswith(".py") or "/" in policy),
        "a policy",
        "a name, a file of weights (.npz) or module:Class",
        str(file),
        f"of a class in {file.name}, write {file.stem}:CLASS in the folder of that file",
    )
    if not label:
        name = Path(policy).stem if policy.endswith(".npz") else policy.rpartition(":")[2]
        label = "-".join([name, *(override.replace("=", "-", 1) for override in overrides)])
    if not _LABEL.fullmatch(label):
        raise ValueError(
            f"the policy {text[:100]!r} would be labeled {label[:100]!r}, but labels name files: "
            "give it one of at most 80 letters, digits and _ . + - in front, LABEL=POLICY"
        )
    return Variant(label, policy, tuple(overrides))


def flight_name(scenario: str, policy: str, speed: float | None, seed: int) -> str:
    """Returns the name of a flight; `speed` [m/s] is None if the policy has its own."""
    parts = [scenario, policy, *([] if speed is None else [f"{speed:g}"]), f"{seed:03d}"]
    return "-".join(parts)


def split_policies(text: str) -> list[str]:
    """Splits a list at commas outside of brackets."""
    return [part.strip() for part in re.split("," + _OUTSIDE_BRACKETS, text) if part.strip()]


def sweep(text: str) -> Iterator[str]:
    """Yields a variant for each combination of values of `POLICY:FIELD=A,B,...[:FIELD=...]`."""
    policy, *fields = re.split(f":(?={_FIELD})", text)
    if not fields:
        raise ValueError(f"the sweep {text!r} has no field; write POLICY:FIELD=VALUE,VALUE")
    for chosen in product(*map(_choices, fields)):
        yield ":".join([policy, *chosen])


def scenario_sweep(text: str) -> list[str] | None:
    """Returns `FIELD=VALUE` for each value of `FIELD=A,B,...`; None for the sweep of a policy."""
    is_field = re.fullmatch(_FIELD + ".*", text) and not re.search(f":{_FIELD}", text)
    return _choices(text) if is_field else None


def _choices(text: str) -> list[str]:
    field, _, values = text.partition("=")
    return [f"{field}={value}" for value in split_policies(values)]
