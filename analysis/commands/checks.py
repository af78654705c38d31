"""What the command line checks before it imports anything slow: names and paths."""

import sys
from collections.abc import Sequence
from pathlib import Path

from splatpilot.analysis.benchmark.variants import SCENARIO, Variant
from splatpilot.diagrams.scenario_files import (
    benchmark_scenarios,
    other_scenarios,
    scenario_file,
)
from splatpilot.systems.files import require_existing
from splatpilot.systems.registry import check_name

SCENARIOS = tuple(benchmark_scenarios() | other_scenarios())
"""The names of the scenarios that come with the program."""

POLICIES = (
    "planner",
    "straight",
    "reactive",
    "diffaero",
    "depthnav",
    "agile_autonomy",
    "diffaero_tof",
    "diffaero_rgb",
    "student_rgb",
    "student_depth",
    "pilot_rgb",
)
"""The names of our own policies."""

TRAINERS = (
    "diffaero",
    "depthnav",
    "diffaero_tof",
    "agile_autonomy",
    "diffaero_rgb",
    "student_rgb",
    "student_depth",
)
"""The names of our own trainers."""


def check_policy(variant: Variant) -> None:
    """
    Raises:
        FileNotFoundError: if the file of weights that it names is not there.
        ValueError: if there is no policy of its name.
    """
    if variant.weights is not None:
        require_existing(variant.weights, "a file of weights")
    elif variant.policy != SCENARIO:
        name, colon, field = variant.policy.partition(":")
        if colon and name in POLICIES:
            raise ValueError(
                f"the policy {variant.policy!r} names a field of {name} without a value; write "
                f"{name}:{field}=VALUE"
            )
        registry = "splatpilot.diagrams.policies"
        _check_name("policy", "splatpilot.policies", variant.policy, POLICIES, registry)


def check_trainer(name: str) -> None:
    """
    Raises:
        ValueError: if there is no trainer of this name.
    """
    registry = "splatpilot.training.policies.registry"
    _check_name("trainer", "splatpilot.trainers", name, TRAINERS, registry)


def _check_name(what: str, group: str, name: str, ours: Sequence[str], registry: str) -> None:
    # Once the registry has been imported, as by modules that --import names, it may know more.
    if registry not in sys.modules:
        check_name(what, group, name, ours)


def check_scenario(name: str) -> None:
    """
    Raises:
        FileNotFoundError: if the file that it names is not there.
        ValueError: if there is no scenario of this name.
    """
    require_existing(scenario_file(name), "a scenario")


def check_config(path: Path | None) -> None:
    """
    Raises:
        FileNotFoundError: if a file of a configuration is named and not there.
    """
    if path is not None:
        require_existing(path, "a YAML file of a configuration")


def check_place(place: Path, what: str) -> None:
    """
    Raises:
        FileNotFoundError: unless it is a file, a folder or the name of a scenario; the message says
            that `what` is needed.
    """
    if str(place) not in SCENARIOS:
        require_existing(place, what)
