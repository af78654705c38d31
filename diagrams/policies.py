"""All policies: their configurations, their names, and how each becomes a system."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

from pydrake.systems.framework import System

from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.policies.agile_autonomy import AgileAutonomy, AgileAutonomyConfig
from splatpilot.systems.policies.depthnav import DepthNav, DepthNavConfig
from splatpilot.systems.policies.diffaero import DiffAero, DiffAeroConfig
from splatpilot.systems.policies.diffaero_tof import DiffAeroTof, DiffAeroTofConfig
from splatpilot.systems.policies.policy_checkpoint import policy_of
from splatpilot.systems.policies.privileged_planner import (
    PrivilegedPlanner,
    PrivilegedPlannerConfig,
)
from splatpilot.systems.policies.reactive import Reactive
from splatpilot.systems.policies.reactive_planner import ReactiveConfig
from splatpilot.systems.policies.straight import Straight, StraightConfig
from splatpilot.systems.policies.student import Student, StudentDepthConfig, StudentRgbConfig
from splatpilot.systems.policies.trajectory_lattice import LatticeConfig
from splatpilot.systems.registry import Registry
from splatpilot.systems.vehicle.quadrotor_dynamics import QuadrotorParams


class PolicyConfig(Protocol):
    """
    The configuration of a policy: a dataclass that imports without torch.

    Beside what follows it may have `camera`, an `OnboardCamera` through which the policy sees;
    `sensors`, a dictionary of the configurations of others (`diagrams/sensors.py`); and `weights`,
    a file of weights.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def rate(self) -> float:
        """[Hz], of decisions."""
        ...

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        ...


@dataclass(frozen=True)
class PolicyKind:
    """How a policy is configured and built."""

    config: type
    """The type of its configurations."""
    build: Callable[[Any, World, QuadrotorParams], System]
    """From a configuration, the world (for privileged policies) and what is known of the vehicle
    to a system with the ports that `BuildFlightDiagram` connects."""
    at_speed: Callable[[float], Any]
    """The configuration for a nominal speed [m/s]."""


POLICIES = Registry("policy", "splatpilot.policies", PolicyKind)
"""All policies by name."""


def register_policy(
    config: type,
    build: Callable[[Any, World, QuadrotorParams], System],
    *,
    name: str = "",
    at_speed: Callable[[float], Any] | None = None,
) -> None:
    """
    Makes a policy known, so that scenarios, studies and the command line can name it.

    Args:
        config: the type of its configurations, see `PolicyConfig`; its name is their YAML tag.
        build: see `PolicyKind.build`.
        name: of the policy; that of the type without "Config", in small letters, if empty.
        at_speed: makes the configuration for a nominal speed [m/s]; `config(speed=speed)` if None.

    Raises:
        ValueError: if another policy has the name.
    """
    kind = PolicyKind(config, build, at_speed or (lambda speed: config(speed=speed)))
    POLICIES.add(name or config.__name__.removesuffix("Config").lower(), kind)


register_policy(
    PrivilegedPlannerConfig,
    lambda config, world, vehicle: PrivilegedPlanner(
        world.esdf, config, vehicle, world.moving.balls if world.moving else None
    ),
    name="planner",
    at_speed=lambda speed: PrivilegedPlannerConfig(lattice=LatticeConfig(speed=speed)),
)
register_policy(StraightConfig, lambda config, world, vehicle: Straight(config))
register_policy(ReactiveConfig, lambda config, world, vehicle: Reactive(config))
register_policy(DiffAeroConfig, lambda config, world, vehicle: DiffAero(config))
register_policy(DepthNavConfig, lambda config, world, vehicle: DepthNav(config))
register_policy(
    AgileAutonomyConfig,
    lambda config, world, vehicle: AgileAutonomy(config),
    name="agile_autonomy",
)

BENCHMARK_POLICIES = tuple(POLICIES.registered())
"""Those that a study flies when nobody says which: our own, whatever else is installed, but for
those that see by a sensor of their own."""


register_policy(
    DiffAeroTofConfig, lambda config, world, vehicle: DiffAeroTof(config), name="diffaero_tof"
)

# Of these no weights ship.
for _config, _name in ((StudentRgbConfig, "student_rgb"), (StudentDepthConfig, "student_depth")):
    register_policy(
        _config,
        lambda config, world, vehicle: Student(config),
        name=_name,
        at_speed=lambda speed, config=_config: config(),
    )


def policy_named(name: str, speed: float = 2.0) -> Any:
    """
    The configuration of a policy for a nominal speed.

    Args:
        name: of the policy, `module:attribute` of one that is not installed, or a file of weights
            (.npz) that one was trained to.
        speed: [m/s].

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if there is no such policy, the file holds none, or it does not fly at this
            speed.
    """
    weights = name if name.endswith(".npz") else ""
    kind = POLICIES.find(policy_of(weights) if weights else name)
    config = kind.at_speed(speed)
    if weights:
        config = replace(config, weights=weights)
    config.validate()
    return config
