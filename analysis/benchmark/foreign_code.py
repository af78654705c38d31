"""Code of other packages that flies in a study: policies, worlds and sensors."""

import sys
from collections.abc import Iterable
from dataclasses import fields
from hashlib import blake2b
from pathlib import Path
from typing import Any

from splatpilot.diagrams.policies import POLICIES
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.sensors import SENSORS
from splatpilot.diagrams.worlds.make_world import WORLDS

_KNOWN = {"splatpilot", "__main__"} | sys.stdlib_module_names


def foreign_code(scenarios: Iterable[Scenario]) -> dict[str, str]:
    """A digest of the source of each package of others that has part in flights of scenarios, which
    are complete with who flies; by "source of PACKAGE", beside `provenance.program()`."""
    packages = set()
    for scenario in scenarios:
        packages |= _packages_of(scenario.policy, POLICIES.kind_of(scenario.policy))
        packages |= _packages_of(scenario.world, WORLDS.kind_of(scenario.world))
        for sensor in scenario.sensors.values():
            packages |= _packages_of(sensor, SENSORS.kind_of(sensor))
    return {f"source of {name}": _digest(name) for name in sorted(packages - _KNOWN)}


def _packages_of(config: Any, kind: Any) -> set[str]:
    """Where a configuration, and what makes something of it, is written."""
    made_by = (getattr(kind, field.name) for field in fields(kind))
    modules = [getattr(made, "__module__", None) for made in (type(config), *made_by)]
    return {module.partition(".")[0] for module in modules if module}


def _digest(package: str) -> str:
    module = sys.modules[package]
    folders = [Path(folder) for folder in getattr(module, "__path__", ())]
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
    if not folders and getattr(module, "__file__", None):
        files = [Path(str(module.__file__))]
    digest = blake2b(digest_size=8)
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()
