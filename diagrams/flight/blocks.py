"""Blocks of flight diagrams: policy, controller and sensors, in simulation and on hardware."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    LeafSystem,
    OutputPort,
    System,
)
from pydrake.systems.primitives import ConstantVectorSource
from pydrake.systems.sensors import CameraConfig, CameraInfo

from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.diagrams.flight.scenario import Scenario, policy_rate, sample_scenario
from splatpilot.diagrams.flight.sensors import SENSORS, SensorConfig, make_onboard_camera
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_collision import EsdfCollision
from splatpilot.systems.common.drake import connect
from splatpilot.systems.common.validation import require, require_type
from splatpilot.systems.messaging.failsafe import FiniteVector
from splatpilot.systems.policies.hypotheses import HypothesisSelector, num_hypotheses_in
from splatpilot.systems.policies.velocity import VelocityTracker
from splatpilot.systems.sensing.imaging import (
    AutoExposure,
    Compression,
    DepthSensor,
    Stereo,
    StereoMatcher,
)
from splatpilot.systems.sensing.latency import DecisionDelay, DelayedPose, FrameTimes
from splatpilot.systems.sensing.noise import ColorNoise, DepthNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.sensing.time_of_flight import TimeOfFlightGrid, equivalent_sensor
from splatpilot.systems.splats.moving_bodies import MovingBodies
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.flatness import FlatnessController
from splatpilot.systems.vehicle.state import StateToPose
from splatpilot.systems.vehicle.wind import DrydenWind

DECISIONS = {"command": 4, "acceleration": 3, "velocity": 3, "waypoint": 3}
"""Decisions of policies besides hypotheses, and their sizes."""


class DecisionInput(LeafSystem):
    """Passes the decision of a policy outside of the diagram from its input to its output.

    The input and the output have the name and size of one of `DECISIONS`.

    Args:
        camera, rate: of the policy, its images and decisions [Hz]; by default those of the
            scenario's policy.
    """

    def __init__(
        self, decision: str, camera: OnboardCamera | None = None, rate: float | None = None
    ) -> None:
        super().__init__()
        require(decision in DECISIONS, "policy", f"one of {', '.join(DECISIONS)}", decision)
        self.camera, self.rate = camera, rate
        source = self.DeclareVectorInputPort(decision, DECISIONS[decision])
        self.DeclareVectorOutputPort(
            decision, source.size(), self._calc, prerequisites_of_calc={source.ticket()}
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(np.asarray(self.get_input_port().Eval(context)))


class Autonomy(NamedTuple):
    """Systems and ports of `AddPolicyAndController`."""

    policy: System
    controller: System | None  # None if the policy decides the command
    target: OutputPort  # one of `DECISIONS`
    command: OutputPort  # (4)


def make_policy(scenario: Scenario, world: World) -> System:
    """Builds the scenario's policy."""
    entry = POLICIES.entry_for(scenario.policy)
    policy = entry.build(scenario.policy, world, scenario)
    what = f"the result of building the policy {POLICIES.entry_name(entry)!r}"
    require(isinstance(policy, System), what, "a Drake system", type(policy).__name__)
    return policy


def AddPoseAndCollision(
    builder: DiagramBuilder, world: World, state: OutputPort, radius: float
) -> tuple[OutputPort, EsdfCollision]:
    """Adds the systems `pose` and `collision` of a state (13) and a radius [m]; returns the port of
    X_WB too."""
    pose, collision = StateToPose(), EsdfCollision(world.distance_field, radius)
    for name, system in (("pose", pose), ("collision", collision)):
        builder.AddNamedSystem(name, system)
        connect(builder, state, system.GetInputPort("state"))
    return pose.GetOutputPort("pose"), collision


def AddWind(builder: DiagramBuilder, scenario: Scenario, plant: System) -> None:
    """Adds the system `wind` to a plant whose input `wind` is open, unless the scenario is calm."""
    wind = scenario.wind
    if not (wind.gusts or any(wind.mean)):
        return
    require_ports("plant", plant, inputs=["wind"], outputs=[])
    port = plant.GetInputPort("wind")
    if not builder.IsConnectedOrExported(port):
        gusty = DrydenWind(wind, scenario.seed) if wind.gusts else None
        source = gusty or ConstantVectorSource(np.array(wind.mean))
        builder.Connect(builder.AddNamedSystem("wind", source).get_output_port(), port)


def AddMovingBodies(
    builder: DiagramBuilder, world: World, viewers: Iterable[System], name: str = "moving"
) -> MovingBodies:
    """Adds the moving obstacles of a world, for systems with an open input `moving`."""
    bodies = MovingBodies(world.moving)
    builder.AddNamedSystem(name, bodies)
    for system in viewers:
        if system.HasInputPort("moving"):
            port = system.GetInputPort("moving")
            if not builder.IsConnectedOrExported(port):
                connect(builder, bodies.moving_output_port(), port)
    return bodies


def ExportCollision(builder: DiagramBuilder, collision: System) -> None:
    """Exports `clearance`, `barrier`, `gradient`, `in_collision` and `field_state`."""
    for name in ("clearance", "barrier", "gradient", "in_collision", "field_state"):
        builder.ExportOutput(collision.GetOutputPort(name), name)


def AddPolicyAndController(
    builder: DiagramBuilder,
    scenario: Scenario,
    state: OutputPort,
    policy: System,
    controller: System | None = None,
    *,
    guarded: bool = False,
    delay: Sequence[float] = (),
) -> Autonomy:
    """Adds the systems `policy`, `controller`, `selector` for hypotheses, and `velocity_tracker`
    for velocities. `ConnectObservation` must follow.

    Args:
        state: (13) of the vehicle, as policy and controller know it.
        policy, controller: see `AddFlight`.
        guarded: if a failsafe follows. `finite_target` replaces targets that are not finite by
            zeros, and `finite_heading` such headings by NaN.
        delay: see `DecisionDelay`; adds `delayed_` and the name of each of the policy's outputs.
    """
    add_system(builder, "policy", policy)
    decision, heading = decision_port(policy), None
    if policy.HasOutputPort("heading"):
        heading = policy.GetOutputPort("heading")
    if delay and delay[1] > 0.0:
        decision = _add_delay(builder, scenario, policy, decision, delay)
        heading = heading and _add_delay(builder, scenario, policy, heading, delay)
    target = decision
    if decision.get_name() == "hypotheses":
        count = num_hypotheses_in(decision.size())
        selector = HypothesisSelector(count, scenario.controller.lookahead)
        builder.AddNamedSystem("selector", selector)
        ConnectInputs(builder, selector, {"hypotheses": decision, "state": state})
        target = selector.GetOutputPort("waypoint")
    name = target.get_name()
    if name == "command":
        other = controller or guarded
        require(not other, "the policy's decision", "other than command", name, _NO_COMMAND)
        return Autonomy(policy, None, target, target)

    def finite(name: str, port: OutputPort, substitute: float = 0.0) -> OutputPort:
        if not guarded:
            return port
        system = builder.AddNamedSystem(name, FiniteVector(port.size(), substitute))
        builder.Connect(port, system.GetInputPort("signal"))
        return system.GetOutputPort("finite")

    controller = controller or FlatnessController(scenario.controller, scenario.vehicle)
    add_system(builder, "controller", controller)
    source = finite("finite_target", target)
    if name == "velocity":
        tracker = builder.AddNamedSystem("velocity_tracker", VelocityTracker())
        ConnectInputs(builder, tracker, {"state": state, "velocity": source})
        name, source = "acceleration", tracker.GetOutputPort("acceleration")
    require_ports("controller", controller, inputs=["state", name], outputs=["command"])
    sources = {"state": state, name: source}
    if heading is not None:
        sources["heading"] = finite("finite_heading", heading, math.nan)
    ConnectInputs(builder, controller, sources)
    return Autonomy(policy, controller, target, controller.GetOutputPort("command"))


_NO_COMMAND = "a controller of its own and the failsafe need another decision"


def add_system(builder: DiagramBuilder, name: str, system: System) -> None:
    """Adds a system under a name, unless it is in the builder already."""
    require_type(system, System, name)
    if all(system is not added for added in builder.GetSystems()):
        builder.AddNamedSystem(name, system)


def decision_port(policy: System) -> OutputPort:
    """Returns the policy's hypotheses or decision."""
    if policy.HasOutputPort("hypotheses"):
        return policy.GetOutputPort("hypotheses")
    decisions = [name for name in DECISIONS if policy.HasOutputPort(name)]
    outputs = [policy.get_output_port(k).get_name() for k in range(policy.num_output_ports())]
    what = f"an output of the policy {type(policy).__name__}"
    known = f"one of hypotheses, {', '.join(DECISIONS)}"
    require(decisions, what, known, ", ".join(outputs))
    return policy.GetOutputPort(decisions[0])


def _add_delay(
    builder: DiagramBuilder,
    scenario: Scenario,
    policy: System,
    output: OutputPort,
    delay: Sequence[float],
) -> OutputPort:
    update = policy.GetUniquePeriodicDiscreteUpdateAttribute()
    at_zero = update is None or update.offset_sec() == 0.0
    require(at_zero, "decision_delay", "empty for a policy that first updates after time 0", delay)
    condition = "empty for a policy without a periodic discrete update"
    valid = update or getattr(policy, "rate", None) is not None
    require(valid, "decision_delay", condition, delay, "declare one in the policy")
    name, period = output.get_name(), decision_period(scenario, policy)
    step, seed = scenario.controller.period, scenario.seed
    system = DecisionDelay(name, output.size(), period, delay, step, seed, update is None)
    builder.AddNamedSystem(f"delayed_{name}", system)
    builder.Connect(output, system.get_input_port())
    return system.get_output_port()


def ConnectObservation(
    builder: DiagramBuilder, what: str, system: System, observed: dict[str, OutputPort]
) -> None:
    """Connects each open input of a system, named `what`, to the port of its name.

    The input `moving` is for `AddMovingBodies`.
    """
    for index in range(system.num_input_ports()):
        port = system.get_input_port(index)
        if builder.IsConnectedOrExported(port) or port.get_name() == "moving":
            continue
        name = port.get_name()
        if name == "acceleration" and name not in observed:
            continue  # A plant of the caller may not have it, and sensors do without.
        described = f"each input of the {what} {type(system).__name__}"
        known = f"one of {', '.join(observed)}, or an output of the scenario's sensors"
        require(name in observed, described, known, repr(name))
        connect(builder, observed[name], port)


def ConnectOrExport(
    builder: DiagramBuilder, system: System, known: dict[str, OutputPort], prefix: str
) -> None:
    """Connects open inputs to ports of their names; exports each other input `p` as `prefix_p`."""
    for index in range(system.num_input_ports()):
        port = system.get_input_port(index)
        if builder.IsConnectedOrExported(port):
            continue
        if port.get_name() in known:
            connect(builder, known[port.get_name()], port)
        else:
            builder.ExportInput(port, f"{prefix}_{port.get_name()}")


def ConnectInputs(builder: DiagramBuilder, system: System, sources: dict[str, OutputPort]) -> None:
    """Connects input ports of a system by their names."""
    for name, source in sources.items():
        connect(builder, source, system.GetInputPort(name))


def require_ports(what: str, system: System, inputs: list[str], outputs: list[str]) -> None:
    """Raises ValueError unless the system, named `what`, has these ports."""
    missing = [name for name in inputs if not system.HasInputPort(name)]
    missing += [name for name in outputs if not system.HasOutputPort(name)]
    described = f"ports of the {what} {type(system).__name__}"
    condition = f"the inputs {inputs} and the outputs {outputs}"
    require(not missing, described, condition, f"no {', '.join(map(repr, missing))}")


def decision_period(scenario: Scenario, policy: System) -> float:
    """Returns the period [s] of a policy's update; that of the scenario's policy if it has none."""
    update = policy.GetUniquePeriodicDiscreteUpdateAttribute()
    if update is not None:
        return update.period_sec()
    return 1 / (getattr(policy, "rate", None) or policy_rate(scenario.policy))


def onboard_sensors(scenario: Scenario, policy: System | None = None) -> dict[str, SensorConfig]:
    """Returns the sensors of the policy (the scenario's if None), and the scenario's, by name."""
    return getattr(policy or scenario.policy, "sensors", {}) | scenario.sensors


def policy_images(*systems: System) -> list[str]:
    """Returns the names of the input images of a policy, and of systems with the same images."""
    names = ("depth_image_32f", "color_image", "depth_grid")
    return [name for name in names if any(system.HasInputPort(name) for system in systems)]


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
    names: list[str],
) -> dict[str, OutputPort]:
    """Adds `policy_camera` if images are named; it renders when the policy updates.

    `delayed_pose`, `depth_noise` and `color_noise` apply the scenario's `observation`;
    `depth_sensor`, `auto_exposure` and `compression` its `imaging`. `time_of_flight_grid` makes
    grids of depth. `policy_camera_start_pose` is for a rolling shutter and for motion blur.

    Returns:
        The images, by their names.
    """
    if not names:
        return {}

    # Camera.
    noise, imaging = scenario.observation, scenario.imaging
    nominal = policy_camera(scenario, policy)
    config = imaging.camera(nominal)
    exposure = imaging.exposure_time if "color_image" in names else 0.0
    frames = FrameTimes.draw(noise, scenario.seed)
    age = frames.age if noise.is_late else 0.0
    if noise.is_late:
        pose = AddDelayedPose(builder, "delayed_pose", state, frames)

    def add_camera(name: str, config: OnboardCamera, exposure: float = 0.0) -> System:
        camera = builder.AddNamedSystem(name, make_onboard_camera(config, world, age, exposure))
        _connect_start_pose(builder, name, camera, config, state, frames, exposure)
        builder.Connect(pose, camera.GetInputPort("body_pose"))
        return camera

    camera = add_camera("policy_camera", config, exposure)
    rendered = {"depth_image_32f" if name == "depth_grid" else name for name in names}
    images = {name: camera.GetOutputPort(name) for name in sorted(rendered)}
    depth_sensor, is_grid = None, "depth_grid" in names
    if "depth_image_32f" in images:
        depth_sensor = imaging.depth_sensor(is_grid, config)
    if isinstance(depth_sensor, Stereo) and depth_sensor.matching:
        matcher = builder.AddNamedSystem("depth_sensor", StereoMatcher(depth_sensor, config))
        for name, each in StereoMatcher.cameras(depth_sensor, config).items():
            eye = add_camera(f"policy_camera_{name}", each)
            builder.Connect(eye.GetOutputPort("color_image"), matcher.GetInputPort(name))
        images["depth_image_32f"] = matcher.get_output_port()
        depth_sensor = None

    # Sensor and noise.
    period = decision_period(scenario, policy)
    rest = config, 1 / period, scenario.seed, frames.number
    changes: list[tuple[str, System]] = []
    if depth_sensor is not None:
        changes.append(("depth_sensor", DepthSensor(depth_sensor, *rest)))
    if noise.changes_depth:
        changes.append(("depth_noise", DepthNoise(noise, *rest)))
    if imaging.changes_light:
        changes.append(("auto_exposure", AutoExposure(imaging, config, period)))
    if noise.changes_color:
        changes.append(("color_noise", ColorNoise(noise, *rest)))
    if imaging.jpeg_quality is not None:
        changes.append(("compression", Compression(imaging, *rest)))
    for name, system in changes:
        port = system.get_input_port().get_name()
        if port in images:
            builder.AddNamedSystem(name, system)
            builder.Connect(images[port], system.get_input_port())
            images[port] = system.get_output_port()

    # Time of flight.
    if is_grid:
        grid = builder.AddNamedSystem(
            "time_of_flight_grid", TimeOfFlightGrid(equivalent_sensor(nominal))
        )
        builder.Connect(images["depth_image_32f"], grid.GetInputPort("depth_image_32f"))
        images["depth_grid"] = grid.GetOutputPort("depth_grid")
    return images


def AddDelayedPose(
    builder: DiagramBuilder,
    name: str,
    state: OutputPort,
    frames: FrameTimes,
    period: float = 0.02,
) -> OutputPort:
    """Adds a `DelayedPose` of a state (13); returns the port of X_WB."""
    delayed = builder.AddNamedSystem(name, DelayedPose(frames, period))
    builder.Connect(state, delayed.GetInputPort("state"))
    return delayed.GetOutputPort("pose")


def _connect_start_pose(
    builder: DiagramBuilder,
    name: str,
    camera: System,
    config: SensorConfig,
    state: OutputPort,
    frames: FrameTimes,
    exposure: float = 0.0,
) -> None:
    """Connects a camera to the pose at the beginning of its first row's exposure."""
    if not camera.HasInputPort("start_pose"):
        return
    readout = getattr(config, "readout", 0.0)
    start = AddDelayedPose(
        builder,
        f"{name}_start_pose",
        state,
        replace(frames, before=exposure + readout),
        min(0.02, readout or 0.02),
    )
    builder.Connect(start, camera.GetInputPort("start_pose"))


def AddSensors(
    builder: DiagramBuilder,
    sensors: dict[str, SensorConfig],
    world: World,
    scenario: Scenario,
    state: OutputPort,
) -> tuple[dict[str, System], dict[str, OutputPort]]:
    """Adds sensors under their names; `ConnectObservation` must follow for each.

    Returns:
        The sensors by name, and their outputs, `p` of the sensor `s` as `s_p`.
    """
    added, measured = {}, {}
    for name, config in sensors.items():
        sensor = SENSORS.entry_for(config).build(config, world, scenario)
        what = f"the result of building the sensor {name!r}"
        require(isinstance(sensor, System), what, "a Drake system", type(sensor).__name__)
        added[name] = builder.AddNamedSystem(name, sensor)
        _connect_start_pose(builder, name, sensor, config, state, FrameTimes.late(0.0))
        for index in range(sensor.num_output_ports()):
            port = sensor.get_output_port(index)
            measured[f"{name}_{port.get_name()}"] = port
    return added, measured


def MakeCamera(scenario: Scenario, world: World) -> SplatCamera:
    """Makes the scenario's camera of the world's Gaussians."""
    config = sample_scenario(scenario).camera
    return SplatCamera(
        world.baked,
        camera_info(config),
        camera_mount(config),
        min_depth=config.z_near,
        max_depth=config.z_far,
        near=config.clipping_near,
        far=config.clipping_far,
        background=world.background,
        latency=config.output_delay,
    )


def camera_info(config: CameraConfig) -> CameraInfo:
    """Returns the intrinsics of a camera."""
    focal, center = (config.focal_x(), config.focal_y()), config.principal_point()
    return CameraInfo(config.width, config.height, *focal, *center)


def camera_mount(config: CameraConfig) -> RigidTransform:
    """Returns X_BC, the pose of a camera in the vehicle's body frame."""
    return config.X_PB.GetDeterministicValue() @ config.X_BC.GetDeterministicValue()
