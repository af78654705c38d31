"""Policies of a study, with changed fields and a label that names their flights."""

import re
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from splatpilot.systems.common.validation import require

SCENARIO = "scenario"
"""The policy of the scenario itself, its `policy` block."""

_LABEL = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,79}")
_FIELD = r"[A-Za-z_][\w.]*="
_OUTSIDE_BRACKETS = r"(?![^\[{(]*[\]})])"


class Variant(NamedTuple):
    """A policy, with a label and changed fields of its configuration."""

    label: str  # names its flights, and files
    policy: str  # registered name, file of weights (.npz), "module:Class", or `SCENARIO`
    overrides: tuple[str, ...] = ()  # "dotted.field=YAML value" of its configuration

    @property
    def weights(self) -> Path | None:
        """The file of weights, if it is given as one."""
        return Path(self.policy) if self.policy.endswith(".npz") else None

    def config(self, speed: float, own: Any) -> Any:
        """Returns the configuration for a nominal speed [m/s]; `own` is the scenario's policy."""
        # The command line parses variants before slow imports.
        from splatpilot.diagrams.flight.policies import policy_named
        from splatpilot.systems.common.config import load_config

        config = own if self.policy == SCENARIO else policy_named(self.policy, speed)
        if not self.overrides:
            return config
        try:
            config = load_config(config, overrides=list(self.overrides))
            config.validate()
        except ValueError as error:
            raise ValueError(f"policy {self.label}: {error}") from None
        return config


def parse_variant(text: str) -> Variant:
    """Parses `[LABEL=]POLICY[:FIELD=VALUE[:FIELD=VALUE...]]`.

    The default label is the name of the policy, class or file with the fields that are set:
    `reactive:margin=0.2` is labeled `reactive-margin-0.2`.
    """
    label, _, rest = text.partition("=")
    if text.startswith("="):
        raise ValueError(f"the policy {text[:100]!r} has no label before its =; give it one")
    if "=" not in text or ":" in label:
        label, rest = "", text
    policy, *overrides = re.split(f":(?={_FIELD})", rest)
    for override in overrides:
        field = override.partition("=")[0].rpartition(".")[2]
        remedy = {
            "speed": "give the speed of all policies by --speed (fly) or --speeds (benchmark)",
            "weights": "give the file of weights as the policy, LABEL=FILE.npz",
        }.get(field)
        if remedy:
            raise ValueError(f"the policy {text!r} must not set {field}; {remedy}")
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
    choices = []
    for given in fields:
        field, _, values = given.partition("=")
        choices.append([f"{field}={value}" for value in split_policies(values)])
    for chosen in product(*choices):
        yield ":".join([policy, *chosen])
