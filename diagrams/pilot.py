"""Who flies: policy and controller, the same in simulation and on hardware."""

import math
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.diagrams.policies import POLICIES
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_collision import EsdfCollision
from splatpilot.systems.messaging.finite_vector import FiniteVector
from splatpilot.systems.policies.hypotheses import num_hypotheses_in
from splatpilot.systems.policies.hypothesis_selector import HypothesisSelector
from splatpilot.systems.policies.velocity_tracker import VelocityTracker
from splatpilot.systems.ports import connect
from splatpilot.systems.vehicle.flatness_controller import FlatnessController
from splatpilot.systems.vehicle.state_to_pose import StateToPose


class Pilot(NamedTuple):
    """What `AddPilot` added, as far as others connect to it."""

    policy: System
    controller: System
    pose: OutputPort
    """X_WB."""
    decision: OutputPort
    """What is flown: the port `waypoint`, `acceleration` or `velocity`."""


def make_policy(scenario: Scenario, world: World) -> System:
    """The scenario's policy.

    Raises:
        ValueError: for a configuration that no policy has, or of which none is built.
    """
    policy = POLICIES.kind_of(scenario.policy).build(scenario.policy, world, scenario.vehicle)
    if not isinstance(policy, System):
        raise ValueError(
            f"what builds the policy {POLICIES.name_of(POLICIES.kind_of(scenario.policy))!r} gave "
            f"{type(policy).__name__}; it must return a Drake system"
        )
    return policy


def AddPilot(
    builder: DiagramBuilder,
    scenario: Scenario,
    world: World,
    state: OutputPort,
    policy: System | None = None,
    controller: System | None = None,
    *,
    guarded: bool = False,
) -> Pilot:
    """
    Adds the systems `pose`, `collision`, `goal`, `policy`, `controller` and, of a policy that
    returns hypotheses, `selector`, or of one that returns velocities, `velocity_tracker`; exports
    `command`, `hypotheses` where there are any, `clearance`, `gradient`, `in_collision` and
    `field_state`.
    `ConnectObservation` is left to do.

    Args:
        state: (13) of the vehicle.
        policy, controller: see `BuildFlightDiagram`.
        guarded: whether a failsafe follows: the controller is given zeros, by `finite_decision`,
            instead of decisions that are not finite, and NaN, by `finite_heading`, instead of such
            headings; its command is not exported.

    Raises:
        ValueError: for a configuration that no policy has, and a system without the ports it needs
            or with one of another size.
    """
    policy = policy or make_policy(scenario, world)
    controller = controller or FlatnessController(scenario.controller, scenario.vehicle)
    balls = world.moving.balls if world.moving else None
    pose, collision = StateToPose(), EsdfCollision(world.distance_field, balls)
    builder.AddNamedSystem("pose", pose)
    builder.AddNamedSystem("collision", collision)
    builder.AddNamedSystem("goal", ConstantVectorSource(goal_of(scenario, world)))
    builder.AddNamedSystem("policy", policy)
    builder.AddNamedSystem("controller", controller)
    require_ports("controller", controller, inputs=["state"], outputs=["command"])

    builder.Connect(state, pose.state_input_port())
    builder.Connect(state, collision.state_input_port())
    decision = _ConnectDecision(builder, scenario, state, policy, controller, guarded)
    builder.Connect(state, controller.GetInputPort("state"))

    exported = {
        controller: [] if guarded else ["command"],
        collision: ["clearance", "gradient", "in_collision", "field_state"],
        policy: ["hypotheses"] if policy.HasOutputPort("hypotheses") else [],
    }
    for system, names in exported.items():
        for name in names:
            builder.ExportOutput(system.GetOutputPort(name), name)
    return Pilot(policy, controller, pose.pose_output_port(), decision)


def ConnectObservation(
    builder: DiagramBuilder, observed: dict[str, OutputPort], policy: System
) -> None:
    """
    Leads to each input of the policy what bears its name.

    Raises:
        ValueError: if there is no such thing, or it has another size.
    """
    observed = observed | {"goal": builder.GetSubsystemByName("goal").get_output_port(0)}
    for index in range(policy.num_input_ports()):
        port = policy.get_input_port(index)
        if port.get_name() not in observed:
            raise ValueError(
                f"nothing gives the input {port.get_name()!r} of the policy "
                f"{type(policy).__name__}; there are {', '.join(observed)}, and the outputs of "
                "sensors that the scenario names"
            )
        connect(builder, observed[port.get_name()], port)


def require_ports(what: str, system: System, inputs: list[str], outputs: list[str]) -> None:
    """Raises ValueError unless the system, which is `what`, has these ports."""
    lacking = [name for name in inputs if not system.HasInputPort(name)]
    lacking += [name for name in outputs if not system.HasOutputPort(name)]
    if lacking:
        raise ValueError(
            f"the {what} {type(system).__name__} has no port {lacking[0]!r}; it needs the inputs "
            f"{inputs} and the outputs {outputs}"
        )


def _ConnectDecision(
    builder: DiagramBuilder,
    scenario: Scenario,
    state: OutputPort,
    policy: System,
    controller: System,
    guarded: bool,
) -> OutputPort:
    """Leads what the policy decides to the controller, and returns it."""
    if policy.HasOutputPort("hypotheses"):
        hypotheses = policy.GetOutputPort("hypotheses")
        count = num_hypotheses_in(hypotheses.size())
        selector = HypothesisSelector(count, scenario.controller.lookahead)
        builder.AddNamedSystem("selector", selector)
        builder.Connect(hypotheses, selector.hypotheses_input_port())
        builder.Connect(state, selector.state_input_port())
        decision = selector.waypoint_output_port()
    else:
        kinds = [
            kind for kind in ("acceleration", "velocity", "waypoint") if policy.HasOutputPort(kind)
        ]
        if not kinds:
            raise ValueError(
                f"the policy {type(policy).__name__} has none of the outputs hypotheses, "
                "acceleration, velocity and waypoint; give it one"
            )
        decision = policy.GetOutputPort(kinds[0])
    flown = decision
    if guarded:
        finite = FiniteVector(decision.size())
        builder.AddNamedSystem("finite_decision", finite)
        builder.Connect(decision, finite.signal_input_port())
        flown = finite.finite_output_port()
    kind = decision.get_name()
    if decision.get_name() == "velocity":
        tracker = VelocityTracker()
        builder.AddNamedSystem("velocity_tracker", tracker)
        builder.Connect(state, tracker.state_input_port())
        connect(builder, flown, tracker.velocity_input_port())
        flown = tracker.acceleration_output_port()
        kind = "acceleration"
    require_ports("controller", controller, inputs=["state", kind], outputs=["command"])
    connect(builder, flown, controller.GetInputPort(kind))
    if policy.HasOutputPort("heading"):
        heading = policy.GetOutputPort("heading")
        if guarded:
            finite = FiniteVector(heading.size(), substitute=math.nan)
            builder.AddNamedSystem("finite_heading", finite)
            builder.Connect(heading, finite.signal_input_port())
            heading = finite.finite_output_port()
        connect(builder, heading, controller.GetInputPort("heading"))
    return decision


def goal_of(scenario: Scenario, world: World) -> np.ndarray:
    """The goal p_WG (3,) [m]: the scenario's, or the world's where the scenario leaves it open."""
    return np.asarray(world.p_WG if scenario.goal is None else scenario.goal, dtype=float)
