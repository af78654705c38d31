"""All policies: their configurations, their names, and how each becomes part of a diagram."""

from collections.abc import Callable
from dataclasses import replace

from pydrake.systems.framework import DiagramBuilder, System

from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.policies.agile_autonomy import AgileAutonomy, AgileAutonomyConfig
from splatpilot.systems.policies.depthnav import DepthNav, DepthNavConfig
from splatpilot.systems.policies.diffaero import DiffAero, DiffAeroConfig
from splatpilot.systems.policies.policy_checkpoint import policy_of
from splatpilot.systems.policies.privileged_planner import (
    PrivilegedPlanner,
    PrivilegedPlannerConfig,
)
from splatpilot.systems.policies.reactive import Reactive
from splatpilot.systems.policies.reactive_planner import ReactiveConfig
from splatpilot.systems.policies.straight import Straight, StraightConfig
from splatpilot.systems.policies.trajectory_lattice import LatticeConfig
from splatpilot.systems.vehicle.quadrotor_dynamics import QuadrotorParams

PolicyConfig = (
    PrivilegedPlannerConfig
    | StraightConfig
    | ReactiveConfig
    | DiffAeroConfig
    | DepthNavConfig
    | AgileAutonomyConfig
)
"""A configuration has `rate` [Hz] and `validate()`, and `camera`, an `OnboardCamera`, if its policy
sees. Configurations import without torch."""

POLICIES: dict[str, Callable[[float], PolicyConfig]] = {
    "planner": lambda speed: PrivilegedPlannerConfig(lattice=LatticeConfig(speed=speed)),
    "straight": lambda speed: StraightConfig(speed=speed),
    "reactive": lambda speed: ReactiveConfig(speed=speed),
    "diffaero": lambda speed: DiffAeroConfig(speed=speed),
    "depthnav": lambda speed: DepthNavConfig(speed=speed),
    "agile_autonomy": lambda speed: AgileAutonomyConfig(speed=speed),
}
"""By its name, the configuration of each policy that flies at a speed [m/s]."""


def policy_named(name: str, speed: float = 2.0) -> PolicyConfig:
    """The configuration of a policy for a nominal speed [m/s].

    Args:
        name: of the policy, or a file of weights (.npz) that one was trained to.
        speed: [m/s].

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if there is no such policy, the file holds none, or it does not fly at this
            speed.
    """
    weights = name if name.endswith(".npz") else ""
    policy = policy_of(weights) if weights else name
    if policy not in POLICIES:
        raise ValueError(
            f"there is no policy {policy!r}; the policies are {', '.join(POLICIES)}, and files of "
            "weights (.npz)"
        )
    config = POLICIES[policy](speed)
    if weights:
        config = replace(config, weights=weights)  # pyright: ignore[reportCallIssue]
    config.validate()
    return config


def AddPolicy(
    builder: DiagramBuilder, config: PolicyConfig, world: World, vehicle: QuadrotorParams
) -> System:
    """
    Adds the policy of `config` under the name `policy`, unconnected.

    A policy has the inputs `state` and `goal`, and `depth_image_32f` or `color_image` if it sees
    through the camera `config.camera`; and one of the outputs `hypotheses` (see
    `splatpilot.systems.policies.hypotheses`), `acceleration` (3) and `waypoint` (3); beside
    these it may have `heading` (1), where to look.

    Args:
        builder: of the diagram.
        config: which policy, and its parameters.
        world: read by privileged policies alone.
        vehicle: what policies may know of the vehicle that they fly.
    """
    match config:
        case PrivilegedPlannerConfig():
            policy = PrivilegedPlanner(world.esdf, config, vehicle)
        case StraightConfig():
            policy = Straight(config)
        case ReactiveConfig():
            policy = Reactive(config)
        case DiffAeroConfig():
            policy = DiffAero(config)
        case DepthNavConfig():
            policy = DepthNav(config)
        case AgileAutonomyConfig():
            policy = AgileAutonomy(config)
    return builder.AddNamedSystem("policy", policy)
