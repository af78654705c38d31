"""Writes the page `configuration`: every field of every configuration class."""

import inspect
import typing
from collections.abc import Iterator
from typing import Any

import numpy as np
import yaml

from splatpilot.analysis.faults import FaultsConfig
from splatpilot.analysis.gap import GapConfig
from splatpilot.analysis.reconstruction.fidelity import FidelityConfig
from splatpilot.analysis.reconstruction.measure_scene import RenderedSceneConfig
from splatpilot.analysis.twin import TwinConfig
from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.diagrams.flight.scenario import WITHOUT_EFFECT, Scenario
from splatpilot.diagrams.flight.sensors import ESTIMATORS, SENSORS
from splatpilot.diagrams.gym.spaces import FlightEnvConfig
from splatpilot.diagrams.hardware.bridge import HardwareConfig
from splatpilot.diagrams.hardware.px4 import Px4Config
from splatpilot.diagrams.worlds.world_registry import WORLDS
from splatpilot.systems.common.config import FieldDescription, describe_fields, is_configuration
from splatpilot.systems.common.registry import Registry
from splatpilot.systems.vehicle.vehicles import VEHICLES
from splatpilot.training.captures.check import CheckConfig
from splatpilot.training.captures.render import RenderConfig
from splatpilot.training.corpus.corpus import CorpusConfig
from splatpilot.training.policies.train import TRAINERS
from splatpilot.training.reconstruction.config import ReconstructConfig

GROUPS: list[tuple[str, str, list[type] | Registry]] = [
    (
        "Flights",
        "For `splatpilot fly`, `benchmark`, `hardware vehicle` and `hardware bridge`: fields of a "
        "scenario file, or `--set timeout=20`.",
        [Scenario],
    ),
    (
        "Vehicles",
        "Types of `vehicle` in a scenario: `vehicle: !Kingfisher {model: lags}` in a file, "
        "`--set 'vehicle=!Kingfisher {}'`.",
        VEHICLES,
    ),
    ("Sensors", "Entries of `sensors` in a scenario or a policy.", SENSORS),
    (
        "Estimators",
        "Types of `estimator` in a scenario: `--set 'estimator=!VisualInertial {}'`.",
        ESTIMATORS,
    ),
    (
        "Policies",
        "Types of `policy` in a scenario: `policy: !ReactiveConfig {margin: 0.2}` in a file, "
        "`--policy reactive --set policy.margin=0.2`, `--policies reactive:margin=0.2`.",
        POLICIES,
    ),
    (
        "Worlds",
        "Types of `world` in a scenario: `world: !RoomConfig {items: 8}` in a file, "
        "`--set 'world=!RoomConfig {items: 8}'`.",
        WORLDS,
    ),
    (
        "Captures",
        "For `splatpilot capture check` and `capture render`.",
        [CheckConfig, RenderConfig],
    ),
    (
        "Reconstruction",
        "For `splatpilot reconstruct` and `scene ablate`; for meshes and generated worlds in "
        "`reconstruct` and `library make`; for `scene fidelity`, `scene twin` and `gap`.",
        [ReconstructConfig, RenderedSceneConfig, FidelityConfig, TwinConfig, GapConfig],
    ),
    ("Training", "For `splatpilot train` and `recover`, by policy.", TRAINERS),
    ("Environments", "Arguments of `FlightEnv` and `VectorFlightEnv`.", [FlightEnvConfig]),
    ("Corpora", "For `splatpilot corpus make`.", [CorpusConfig]),
    (
        "Hardware",
        "For `splatpilot hardware`: `bridge` and `vehicle` (`--hardware FILE`), `px4` and "
        "`faults`.",
        [HardwareConfig, Px4Config, FaultsConfig],
    ),
]
"""Heading, introduction, and root configurations of each group."""


def configurations() -> Iterator[tuple[str, str, list[Any]]]:
    """Yields heading, introduction and configurations of each group, with nested configurations.

    Each configuration appears once, in the first group. Drake's are in a group at the end.
    """
    seen: set[type] = set()
    drakes: list[Any] = []

    def met(config: Any) -> Iterator[Any]:
        if type(config) in seen:
            return
        seen.add(type(config))
        if type(config).__module__.startswith("pydrake"):
            drakes.append(config)
            return
        yield config
        for field in describe_fields(config):
            for held in _held(config, field):
                yield from met(held)

    for heading, introduction, roots in GROUPS:
        types = roots.configs() if isinstance(roots, Registry) else roots
        yield heading, introduction, [config for root in types for config in met(root())]
    yield (
        "Drake",
        "Configurations of Drake, without fields that flights ignore.",
        drakes,
    )


def _held(config: Any, field: FieldDescription) -> list[Any]:
    """Returns the configuration of a field, or its possible types if it is None by default."""
    if field.registry is not None:
        return []
    if field.value is None:
        hint = typing.get_type_hints(type(config)).get(field.name)
        return [kind() for kind in typing.get_args(hint) if is_configuration(kind)]
    return [field.value] if is_configuration(field.value) else []


def page() -> str:
    """Returns the sections of the page in Markdown."""
    parts = []
    for heading, introduction, configs in configurations():
        parts.append(f"## {heading}\n\n{introduction}\n")
        parts += [_section(config) for config in configs]
    return "\n".join(parts)


def _section(config: Any) -> str:
    name = type(config).__name__
    about = inspect.cleandoc(type(config).__doc__ or "").replace("::\n", ":\n")
    if type(config).__module__.startswith("pydrake"):
        about = about.partition("\n\n")[0]
    rows = [
        f"| `{field.name}` | {_default(field)} | {_text(config, field)} |"
        for field in describe_fields(config)
        if not (name == "CameraConfig" and field.name in WITHOUT_EFFECT)
    ]
    table = ["| field | default | description |", "|---|---|---|", *rows]
    return f"(config-{name})=\n### {name}\n\n{about}\n\n" + "\n".join(table) + "\n"


def _text(config: Any, field: FieldDescription) -> str:
    text = field.text.replace("|", "\\|") or "See Drake's documentation."
    if field.registry is None:
        may = [_link(type(held)) for held in _held(config, field) if field.value is None]
        return f"{text} A {may[0]}." if may else text
    kinds = ", ".join(_link(kind) for kind in field.registry.configs())
    return f"{text} One of {kinds}."


def _default(field: FieldDescription) -> str:
    """Returns a default as YAML; for a configuration, a link and the changed defaults."""
    value = field.value
    if not is_configuration(value):
        return f"`{_yaml(value)}`"
    if type(value).__module__.startswith("pydrake"):
        return _link(type(value)) if type(value).__name__.endswith("Config") else f"`{value}`"
    ours = zip(describe_fields(value), describe_fields(type(value)()), strict=True)
    changed = [f"`{a.name}: {_yaml(a.value)}`" for a, b in ours if _yaml(a.value) != _yaml(b.value)]
    return _link(type(value)) + (f" with {', '.join(changed)}" if changed else "")


def _link(config: type) -> str:
    return f"[{config.__name__}](#config-{config.__name__})"


def _yaml(value: Any) -> str:
    if is_configuration(value):
        return str(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name}: {_yaml(held)}" for name, held in value.items()) + "}"
    plain = value.tolist() if isinstance(value, np.ndarray) else value
    return yaml.safe_dump(plain, default_flow_style=True, width=1000).split("\n")[0]
