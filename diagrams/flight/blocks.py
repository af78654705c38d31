"""Who flies: policy and controller, the same in simulation and on hardware."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.sensors import SENSORS, SensorConfig, make_camera
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_collision import EsdfCollision
from splatpilot.systems.common.drake import connect
from splatpilot.systems.messaging.failsafe import FiniteVector
from splatpilot.systems.policies.hypotheses import HypothesisSelector, num_hypotheses_in
from splatpilot.systems.policies.velocity import VelocityTracker
from splatpilot.systems.sensing.latency import DelayedPose, FrameTimes
from splatpilot.systems.sensing.noise import ColorNoise, DepthNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.sensing.time_of_flight import TimeOfFlightGrid, sensor_of
from splatpilot.systems.vehicle.flatness import FlatnessController
from splatpilot.systems.vehicle.state import StateToPose


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

    builder.Connect(state, pose.GetInputPort("state"))
    builder.Connect(state, collision.GetInputPort("state"))
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
    return Pilot(policy, controller, pose.GetOutputPort("pose"), decision)


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
        builder.Connect(hypotheses, selector.GetInputPort("hypotheses"))
        builder.Connect(state, selector.GetInputPort("state"))
        decision = selector.GetOutputPort("waypoint")
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
        builder.Connect(decision, finite.GetInputPort("signal"))
        flown = finite.GetOutputPort("finite")
    kind = decision.get_name()
    if decision.get_name() == "velocity":
        tracker = VelocityTracker()
        builder.AddNamedSystem("velocity_tracker", tracker)
        builder.Connect(state, tracker.GetInputPort("state"))
        connect(builder, flown, tracker.GetInputPort("velocity"))
        flown = tracker.GetOutputPort("acceleration")
        kind = "acceleration"
    require_ports("controller", controller, inputs=["state", kind], outputs=["command"])
    connect(builder, flown, controller.GetInputPort(kind))
    if policy.HasOutputPort("heading"):
        heading = policy.GetOutputPort("heading")
        if guarded:
            finite = FiniteVector(heading.size(), substitute=math.nan)
            builder.AddNamedSystem("finite_heading", finite)
            builder.Connect(heading, finite.GetInputPort("signal"))
            heading = finite.GetOutputPort("finite")
        connect(builder, heading, controller.GetInputPort("heading"))
    return decision


def goal_of(scenario: Scenario, world: World) -> np.ndarray:
    """The goal p_WG (3,) [m]: the scenario's, or the world's where the scenario leaves it open."""
    return np.asarray(world.p_WG if scenario.goal is None else scenario.goal, dtype=float)


_TAKEN = {
    *("plant", "pose", "collision", "goal", "policy", "controller", "camera", "video"),
    *("selector", "velocity_tracker"),
    *("policy_camera", "policy_camera_start_pose", "delayed_pose"),
    *("depth_noise", "color_noise", "time_of_flight_grid"),
    *("flight_visualizer", "camera_visualizer", "balls_visualizer"),
    *("state_log", "command_log", "hypotheses_log"),
}
"""Names of the other systems of a flight."""


def decision_period(scenario: Scenario, policy: System) -> float:
    """[s] between decisions of a policy: that of its periodic update, or of the scenario's policy
    where it has none."""
    update = policy.GetUniquePeriodicDiscreteUpdateAttribute()
    return update.period_sec() if update is not None else 1 / scenario.policy.rate


def sensors_of(scenario: Scenario, policy: System | None = None) -> dict[str, SensorConfig]:
    """What is on board by name: what the policy (the scenario's if None) brings in its `sensors`,
    and the scenario's."""
    return getattr(policy or scenario.policy, "sensors", {}) | scenario.sensors


def images_of(policy: System) -> list[str]:
    """The names of the images that a policy has inputs for."""
    names = ("depth_image_32f", "color_image", "depth_grid")
    return [name for name in names if policy.HasInputPort(name)]


def camera_of(scenario: Scenario, policy: System) -> OnboardCamera:
    """Through which a policy sees: its own camera, the scenario's policy's, or the default one."""
    config = getattr(policy, "camera", None) or getattr(scenario.policy, "camera", None)
    return config or OnboardCamera()


def AddObservation(
    builder: DiagramBuilder,
    scenario: Scenario,
    world: World,
    state: OutputPort,
    pose: OutputPort,
    policy: System,
) -> dict[str, OutputPort]:
    """
    Adds the camera of a policy that sees, as `policy_camera`.

    It renders when the policy looks. Where the scenario asks for them, `delayed_pose` makes its
    images late, and `depth_noise` or `color_noise` noisy; `time_of_flight_grid` makes grids of
    them. With a rolling shutter `policy_camera_start_pose` tells where its first row is read.

    Returns:
        The images that the policy has inputs for, by their names.
    """
    names = images_of(policy)
    if not names:
        return {}
    config, noise = camera_of(scenario, policy), scenario.observation
    camera = builder.AddNamedSystem("policy_camera", make_camera(config, world, noise.latency))
    frames = FrameTimes.draw(noise, scenario.seed)
    _connect_start_pose(builder, "policy_camera", camera, config, state, frames)
    if noise.is_late:
        delayed = builder.AddNamedSystem("delayed_pose", DelayedPose(frames))
        builder.Connect(state, delayed.GetInputPort("state"))
        pose = delayed.GetOutputPort("pose")
    builder.Connect(pose, camera.GetInputPort("body_pose"))
    sees_grid = "depth_grid" in names
    taken = {"depth_image_32f" if name == "depth_grid" else name for name in names}
    images = {name: camera.GetOutputPort(name) for name in sorted(taken)}
    for port, name, kind, active in (
        ("depth_image_32f", "depth_noise", DepthNoise, noise.changes_depth),
        ("color_image", "color_noise", ColorNoise, noise.changes_color),
    ):
        if port in images and active:
            system = kind(noise, config, 1 / decision_period(scenario, policy), scenario.seed)
            builder.AddNamedSystem(name, system)
            builder.Connect(images[port], system.get_input_port())
            images[port] = system.get_output_port()
    if sees_grid:
        grid = TimeOfFlightGrid(sensor_of(config))
        builder.AddNamedSystem("time_of_flight_grid", grid)
        builder.Connect(images["depth_image_32f"], grid.GetInputPort("depth_image_32f"))
        images["depth_grid"] = grid.GetOutputPort("depth_grid")
    return images


def _connect_start_pose(
    builder: DiagramBuilder,
    name: str,
    camera: System,
    config: SensorConfig,
    state: OutputPort,
    frames: FrameTimes,
) -> None:
    """Tells a camera with a rolling shutter where the vehicle was when it read its first row."""
    if not camera.HasInputPort("start_pose"):
        return
    readout = getattr(config, "readout", 0.0)
    start = DelayedPose(replace(frames, before=readout), period=min(0.02, readout))
    builder.AddNamedSystem(f"{name}_start_pose", start)
    builder.Connect(state, start.GetInputPort("state"))
    builder.Connect(start.GetOutputPort("pose"), camera.GetInputPort("start_pose"))


def AddSensors(
    builder: DiagramBuilder,
    sensors: dict[str, SensorConfig],
    world: World,
    state: OutputPort,
    pose: OutputPort,
) -> dict[str, OutputPort]:
    """
    Adds sensors under their names.

    Returns:
        Their outputs: `p` of the sensor `s` as `s_p`.

    Raises:
        ValueError: for a configuration that no sensor has, or of which none is built, and a name
            that is taken.
    """
    measured = {}
    for name, config in sensors.items():
        if name in _TAKEN:
            raise ValueError(f"a sensor is named {name!r}, as a part of the flight; rename it")
        sensor = SENSORS.kind_of(config).build(config, world)
        if not isinstance(sensor, System):
            raise ValueError(
                f"what builds the sensor {name!r} gave {type(sensor).__name__}; it must return a "
                "Drake system"
            )
        builder.AddNamedSystem(name, sensor)
        for port, source in (("state", state), ("body_pose", pose)):
            if sensor.HasInputPort(port):
                builder.Connect(source, sensor.GetInputPort(port))
        _connect_start_pose(builder, name, sensor, config, state, FrameTimes.late(0.0))
        for index in range(sensor.num_output_ports()):
            port = sensor.get_output_port(index)
            measured[f"{name}_{port.get_name()}"] = port
    return measured
