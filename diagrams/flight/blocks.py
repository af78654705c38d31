"""Blocks of flight diagrams: policy, controller and sensors, in simulation and on hardware."""

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
from splatpilot.systems.common.validation import require
from splatpilot.systems.messaging.failsafe import FiniteVector
from splatpilot.systems.policies.hypotheses import HypothesisSelector, num_hypotheses_in
from splatpilot.systems.policies.velocity import VelocityTracker
from splatpilot.systems.sensing.latency import DelayedPose, FrameTimes
from splatpilot.systems.sensing.noise import ColorNoise, DepthNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.sensing.time_of_flight import TimeOfFlightGrid, equivalent_sensor
from splatpilot.systems.vehicle.flatness import FlatnessController
from splatpilot.systems.vehicle.state import StateToPose


class Autonomy(NamedTuple):
    """Systems and ports of `AddPolicyAndController`."""

    policy: System
    controller: System
    pose: OutputPort  # X_WB
    target: OutputPort  # `waypoint`, `acceleration` or `velocity`.


def make_policy(scenario: Scenario, world: World) -> System:
    """Builds the scenario's policy."""
    kind = POLICIES.entry_for(scenario.policy)
    policy = kind.build(scenario.policy, world, scenario.vehicle)
    what = f"the result of building the policy {POLICIES.entry_name(kind)!r}"
    require(isinstance(policy, System), what, "a Drake system", type(policy).__name__)
    return policy


def AddPolicyAndController(
    builder: DiagramBuilder,
    scenario: Scenario,
    world: World,
    state: OutputPort,
    policy: System | None = None,
    controller: System | None = None,
    *,
    guarded: bool = False,
) -> Autonomy:
    """Adds the systems `pose`, `collision`, `goal`, `policy`, `controller`, `selector` for
    hypotheses, and `velocity_tracker` for velocities.

    Exports `command`, `hypotheses`, `clearance`, `gradient`, `in_collision` and `field_state`.
    `ConnectObservation` must follow.

    Args:
        state: (13) of the vehicle.
        policy, controller: see `BuildFlightDiagram`.
        guarded: if a failsafe follows. `finite_target` replaces targets that are not finite by
            zeros, and `finite_heading` such headings by NaN; `command` is not exported.
    """
    # Pose, distances and goal.
    pose, collision = StateToPose(), EsdfCollision(world.distance_field)
    for name, system in (("pose", pose), ("collision", collision)):
        builder.AddNamedSystem(name, system)
        builder.Connect(state, system.GetInputPort("state"))
    builder.AddNamedSystem("goal", ConstantVectorSource(goal_position(scenario, world)))

    # Policy and controller.
    policy = policy or make_policy(scenario, world)
    controller = controller or FlatnessController(scenario.controller, scenario.vehicle)
    builder.AddNamedSystem("policy", policy)
    builder.AddNamedSystem("controller", controller)
    require_ports("controller", controller, inputs=["state"], outputs=["command"])
    target = _add_target(builder, scenario, state, policy)
    _connect_controller(builder, state, policy, target, controller, guarded)

    for name in ("clearance", "gradient", "in_collision", "field_state"):
        builder.ExportOutput(collision.GetOutputPort(name), name)
    if policy.HasOutputPort("hypotheses"):
        builder.ExportOutput(policy.GetOutputPort("hypotheses"), "hypotheses")
    if not guarded:
        builder.ExportOutput(controller.GetOutputPort("command"), "command")
    return Autonomy(policy, controller, pose.GetOutputPort("pose"), target)


def _add_target(
    builder: DiagramBuilder, scenario: Scenario, state: OutputPort, policy: System
) -> OutputPort:
    """Returns the policy's output; of hypotheses, the waypoint of the best."""
    if policy.HasOutputPort("hypotheses"):
        hypotheses = policy.GetOutputPort("hypotheses")
        count = num_hypotheses_in(hypotheses.size())
        selector = HypothesisSelector(count, scenario.controller.lookahead)
        builder.AddNamedSystem("selector", selector)
        builder.Connect(hypotheses, selector.GetInputPort("hypotheses"))
        builder.Connect(state, selector.GetInputPort("state"))
        return selector.GetOutputPort("waypoint")
    names = [
        name for name in ("acceleration", "velocity", "waypoint") if policy.HasOutputPort(name)
    ]
    if not names:
        raise ValueError(
            f"the policy {type(policy).__name__} has none of the outputs hypotheses, "
            "acceleration, velocity and waypoint; give it one"
        )
    return policy.GetOutputPort(names[0])


def _connect_controller(
    builder: DiagramBuilder,
    state: OutputPort,
    policy: System,
    target: OutputPort,
    controller: System,
    guarded: bool,
) -> None:
    def finite(name: str, port: OutputPort, substitute: float = 0.0) -> OutputPort:
        if not guarded:
            return port
        system = builder.AddNamedSystem(name, FiniteVector(port.size(), substitute))
        builder.Connect(port, system.GetInputPort("signal"))
        return system.GetOutputPort("finite")

    name, source = target.get_name(), finite("finite_target", target)
    if name == "velocity":
        tracker = builder.AddNamedSystem("velocity_tracker", VelocityTracker())
        builder.Connect(state, tracker.GetInputPort("state"))
        connect(builder, source, tracker.GetInputPort("velocity"))
        name, source = "acceleration", tracker.GetOutputPort("acceleration")
    require_ports("controller", controller, inputs=["state", name], outputs=["command"])
    builder.Connect(state, controller.GetInputPort("state"))
    connect(builder, source, controller.GetInputPort(name))
    if policy.HasOutputPort("heading"):
        heading = finite("finite_heading", policy.GetOutputPort("heading"), math.nan)
        connect(builder, heading, controller.GetInputPort("heading"))


def ConnectObservation(
    builder: DiagramBuilder, observed: dict[str, OutputPort], policy: System
) -> None:
    """Connects each input of the policy to the port of its name."""
    observed = observed | {"goal": builder.GetSubsystemByName("goal").get_output_port(0)}
    for index in range(policy.num_input_ports()):
        port = policy.get_input_port(index)
        if port.get_name() == "moving" and "moving" not in observed:
            continue
        if port.get_name() not in observed:
            raise ValueError(
                f"nothing gives the input {port.get_name()!r} of the policy "
                f"{type(policy).__name__}; there are {', '.join(observed)}, and the outputs of "
                "sensors that the scenario names"
            )
        connect(builder, observed[port.get_name()], port)


def ConnectInputs(builder: DiagramBuilder, system: System, sources: dict[str, OutputPort]) -> None:
    """Connects input ports of a system by their names."""
    for name, source in sources.items():
        builder.Connect(source, system.GetInputPort(name))


def require_ports(what: str, system: System, inputs: list[str], outputs: list[str]) -> None:
    """Raises ValueError unless the system, named `what`, has these ports."""
    missing = [name for name in inputs if not system.HasInputPort(name)]
    missing += [name for name in outputs if not system.HasOutputPort(name)]
    if missing:
        raise ValueError(
            f"the {what} {type(system).__name__} has no port {missing[0]!r}; it needs the inputs "
            f"{inputs} and the outputs {outputs}"
        )


def goal_position(scenario: Scenario, world: World) -> np.ndarray:
    """Returns p_WG (3,) [m] of the scenario, or of the world if the scenario has none."""
    return np.asarray(world.p_WG if scenario.goal is None else scenario.goal, dtype=float)


def start_position(scenario: Scenario, world: World) -> np.ndarray:
    """Returns p_WS (3,) [m] of the scenario, or of the world if the scenario has none."""
    return np.asarray(world.p_WS if scenario.start is None else scenario.start, dtype=float)


def decision_period(scenario: Scenario, policy: System) -> float:
    """Returns the period [s] of a policy's update; that of the scenario's policy if it has none."""
    update = policy.GetUniquePeriodicDiscreteUpdateAttribute()
    return update.period_sec() if update is not None else 1 / scenario.policy.rate


def onboard_sensors(scenario: Scenario, policy: System | None = None) -> dict[str, SensorConfig]:
    """Returns the sensors of the policy (the scenario's if None), and the scenario's, by name."""
    return getattr(policy or scenario.policy, "sensors", {}) | scenario.sensors


def policy_images(policy: System) -> list[str]:
    """Returns the names of a policy's input images."""
    names = ("depth_image_32f", "color_image", "depth_grid")
    return [name for name in names if policy.HasInputPort(name)]


def policy_camera(scenario: Scenario, policy: System) -> OnboardCamera:
    """Returns a policy's camera: its own, that of the scenario's policy, or the default one."""
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
    """Adds `policy_camera` if the policy has images as inputs; it renders when the policy updates.

    `delayed_pose`, `depth_noise` and `color_noise` apply the scenario's `observation`, and
    `time_of_flight_grid` makes grids of depth. `policy_camera_start_pose` is for a rolling shutter.

    Returns:
        The policy's input images, by their names.
    """
    names = policy_images(policy)
    if not names:
        return {}

    # Camera.
    config, noise = policy_camera(scenario, policy), scenario.observation
    camera = builder.AddNamedSystem("policy_camera", make_camera(config, world, noise.latency))
    frames = FrameTimes.draw(noise, scenario.seed)
    _connect_start_pose(builder, "policy_camera", camera, config, state, frames)
    if noise.is_late:
        delayed = builder.AddNamedSystem("delayed_pose", DelayedPose(frames))
        builder.Connect(state, delayed.GetInputPort("state"))
        pose = delayed.GetOutputPort("pose")
    builder.Connect(pose, camera.GetInputPort("body_pose"))
    rendered = {"depth_image_32f" if name == "depth_grid" else name for name in names}
    images = {name: camera.GetOutputPort(name) for name in sorted(rendered)}

    # Noise.
    for port, name, noise_type, active in (
        ("depth_image_32f", "depth_noise", DepthNoise, noise.changes_depth),
        ("color_image", "color_noise", ColorNoise, noise.changes_color),
    ):
        if port in images and active:
            rate = 1 / decision_period(scenario, policy)
            system = builder.AddNamedSystem(name, noise_type(noise, config, rate, scenario.seed))
            builder.Connect(images[port], system.get_input_port())
            images[port] = system.get_output_port()

    # Time of flight.
    if "depth_grid" in names:
        grid = builder.AddNamedSystem(
            "time_of_flight_grid", TimeOfFlightGrid(equivalent_sensor(config))
        )
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
    """Connects a rolling shutter to the pose at the readout of the first row."""
    if not camera.HasInputPort("start_pose"):
        return
    readout = getattr(config, "readout", 0.0)
    start = DelayedPose(replace(frames, before=readout), period=min(0.02, readout))
    builder.AddNamedSystem(f"{name}_start_pose", start)
    builder.Connect(state, start.GetInputPort("state"))
    builder.Connect(start.GetOutputPort("pose"), camera.GetInputPort("start_pose"))


_RESERVED = {
    *("plant", "pose", "collision", "goal", "policy", "controller", "camera", "video"),
    *("selector", "velocity_tracker"),
    *("policy_camera", "policy_camera_start_pose", "delayed_pose"),
    *("depth_noise", "color_noise", "time_of_flight_grid"),
    *("flight_visualizer", "camera_visualizer", "spheres_visualizer"),
    *("state_log", "command_log", "hypotheses_log"),
}
"""Names of the other systems of a flight."""


def AddSensors(
    builder: DiagramBuilder,
    sensors: dict[str, SensorConfig],
    world: World,
    state: OutputPort,
    pose: OutputPort,
) -> dict[str, OutputPort]:
    """Adds sensors under their names; returns their outputs, `p` of the sensor `s` as `s_p`."""
    measured = {}
    for name, config in sensors.items():
        if name in _RESERVED:
            raise ValueError(f"a sensor is named {name!r}, as a part of the flight; rename it")
        sensor = SENSORS.entry_for(config).build(config, world)
        what = f"the result of building the sensor {name!r}"
        require(isinstance(sensor, System), what, "a Drake system", type(sensor).__name__)
        builder.AddNamedSystem(name, sensor)
        for port, source in (("state", state), ("body_pose", pose)):
            if sensor.HasInputPort(port):
                builder.Connect(source, sensor.GetInputPort(port))
        _connect_start_pose(builder, name, sensor, config, state, FrameTimes.late(0.0))
        for index in range(sensor.num_output_ports()):
            port = sensor.get_output_port(index)
            measured[f"{name}_{port.get_name()}"] = port
    return measured
