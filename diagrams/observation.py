"""What a policy observes: its camera, what is between the camera and the policy, and sensors."""

from dataclasses import replace

from pydrake.systems.framework import DiagramBuilder, OutputPort, System

from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.sensors import SENSORS, SensorConfig, make_camera
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.sensing.color_noise import ColorNoise
from splatpilot.systems.sensing.delayed_pose import DelayedPose
from splatpilot.systems.sensing.depth_noise import DepthNoise
from splatpilot.systems.sensing.frame_times import FrameTimes
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.sensing.time_of_flight import sensor_of
from splatpilot.systems.sensing.time_of_flight_grid import TimeOfFlightGrid

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
        builder.Connect(images["depth_image_32f"], grid.depth_image_32f_input_port())
        images["depth_grid"] = grid.depth_grid_output_port()
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
    builder.Connect(state, start.state_input_port())
    builder.Connect(start.pose_output_port(), camera.GetInputPort("start_pose"))


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
