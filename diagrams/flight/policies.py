"""Registry of policies."""

import operator
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Protocol

from pydrake.systems.framework import System

from splatpilot.diagrams.flight.sensors import SensorConfig
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.common.config import require_configuration
from splatpilot.systems.common.registry import Registry
from splatpilot.systems.common.validation import require
from splatpilot.systems.policies.agile_autonomy import AgileAutonomy, AgileAutonomyConfig
from splatpilot.systems.policies.checkpoint import checkpoint_policy, shipped_weights
from splatpilot.systems.policies.depthnav import DepthNav, DepthNavConfig
from splatpilot.systems.policies.diffaero import (
    DiffAero,
    DiffAeroConfig,
    DiffAeroTof,
    DiffAeroTofConfig,
)
from splatpilot.systems.policies.diffaero_rgb import (
    DiffAeroRgb,
    DiffAeroRgbConfig,
    DistilledRgbConfig,
)
from splatpilot.systems.policies.planner import PrivilegedPlanner, PrivilegedPlannerConfig
from splatpilot.systems.policies.reactive import Reactive, ReactiveConfig
from splatpilot.systems.policies.straight import Straight, StraightConfig
from splatpilot.systems.policies.student import (
    Student,
    StudentDepthConfig,
    StudentRgbConfig,
)
from splatpilot.systems.policies.teleop import Teleop, TeleopConfig


class PolicyConfig(SensorConfig, Protocol):
    """Configuration of a policy: a dataclass that imports without torch.

    Optional fields: `camera`, an `OnboardCamera`; `sensors`, configurations by name (see
    `diagrams/flight/sensors.py`); `weights`, a file.
    """

    @property
    def rate(self) -> float:
        """[Hz] of updates."""
        ...


@dataclass(frozen=True)
class PolicyEntry:
    """Entry of the registry.

    `build` makes a system, with ports as `AddFlight` connects them, of a configuration, the world
    (for privileged policies) and the scenario, with its seed and vehicle. `speed_field` is the
    field of the nominal speed [m/s], such as `lattice.speed`; empty for a fixed speed.
    """

    config: type
    build: Callable[[Any, World, Any], System]
    speed_field: str


POLICIES = Registry("policy", "splatpilot.policies", PolicyEntry)
"""All policies by name."""


def register_policy(
    config: type,
    build: Callable[[Any, World, Any], System],
    *,
    name: str = "",
    speed_field: str = "speed",
) -> None:
    """Registers a policy for scenarios, studies and the command line.

    Args:
        config: type of its configurations, see `PolicyConfig`; its name is their YAML tag.
        build, speed_field: see `PolicyEntry`; a default field that is missing means a fixed speed.
        name: by default that of the type without "Config", in lower case.
    """
    require_configuration(config)
    if speed_field == "speed" and "speed" not in {field.name for field in fields(config)}:
        speed_field = ""
    entry = PolicyEntry(config, build, speed_field)
    POLICIES.add(name or config.__name__.removesuffix("Config").lower(), entry)


register_policy(
    PrivilegedPlannerConfig,
    lambda config, world, scenario: PrivilegedPlanner(world.esdf, config, scenario.vehicle),
    name="planner",
    speed_field="lattice.speed",
)
for _name, _config, _system in (
    ("straight", StraightConfig, Straight),
    ("teleop", TeleopConfig, Teleop),
    ("reactive", ReactiveConfig, Reactive),
    ("diffaero", DiffAeroConfig, DiffAero),
    ("depthnav", DepthNavConfig, DepthNav),
    ("agile_autonomy", AgileAutonomyConfig, AgileAutonomy),
    ("diffaero_tof", DiffAeroTofConfig, DiffAeroTof),
    ("diffaero_rgb", DiffAeroRgbConfig, DiffAeroRgb),
    ("distilled_rgb", DistilledRgbConfig, DiffAeroRgb),
    ("student_rgb", StudentRgbConfig, Student),
    ("student_depth", StudentDepthConfig, Student),
):
    register_policy(
        _config, lambda config, world, scenario, system=_system: system(config), name=_name
    )

DEFAULT_SPEED, MAX_SPEED = 2.0, 20.0
"""[m/s] Default nominal speed of policies, and its maximum."""


def policy_named(name: str, speed: float = DEFAULT_SPEED) -> Any:
    """Returns the configuration of a policy for a nominal speed [m/s].

    Args:
        name: a registered name, `module:attribute`, or a file of trained weights (.npz).
    """
    weights = name if name.endswith(".npz") else ""
    entry = POLICIES.find(checkpoint_policy(weights) if weights else name)
    config = entry.config()
    if entry.speed_field:
        config = at_speed(config, speed)
    if weights:
        config = replace(config, weights=weights)
    config.validate()
    return config


def at_speed(config: Any, speed: float) -> Any:
    """Changes the nominal speed [m/s] of a policy's configuration."""
    field = POLICIES.entry_for(config).speed_field
    what, learned = f"the speed of {policy_name(config)}", "left out, as it has learned one"
    require(field, what, learned, f"{speed:g} m/s")
    require(0.0 < speed <= MAX_SPEED, "the speed", f"in (0, {MAX_SPEED:g}] m/s", f"{speed:g}")
    return _with_field(config, field, speed)


def policy_speed(config: Any) -> float | None:
    """Returns the nominal speed [m/s] of a policy; None if it is fixed."""
    field = POLICIES.entry_for(config).speed_field
    return operator.attrgetter(field)(config) if field else None


def policy_name(config: Any) -> str:
    """Returns the name of a configuration's policy; raises ValueError if there is none."""
    return POLICIES.entry_name(POLICIES.entry_for(config))


def weights_file(config: Any) -> Path | None:
    """Returns a policy's file of weights; None if it has none."""
    given = getattr(config, "weights", None)
    file = Path(given) if given else shipped_weights(policy_name(config))
    return file if given is not None and file.is_file() else None


def _with_field(config: Any, field: str, value: float) -> Any:
    name, _, rest = field.partition(".")
    return replace(
        config, **{name: _with_field(getattr(config, name), rest, value) if rest else value}
    )
