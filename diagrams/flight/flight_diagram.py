"""BuildFlightDiagram: the closed loop of vehicle, camera, policy and controller."""

from typing import cast

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from pydrake.systems.primitives import LogVectorOutput
from pydrake.systems.sensors import CameraConfig, CameraInfo

from splatpilot.diagrams.flight.blocks import (
    AddObservation,
    AddPolicyAndController,
    AddSensors,
    ConnectObservation,
    decision_period,
    goal_position,
    onboard_sensors,
    require_ports,
    start_position,
)
from splatpilot.diagrams.flight.flight import sample_initial_state
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.appearance import randomize_appearance
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.background import Background, mean_color
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorPlant
from splatpilot.systems.visualization.flight_visualizer import FlightVisualizer
from splatpilot.systems.visualization.meshcat_drawing import (
    CameraVisualizer,
    MovingSpheresVisualizer,
    draw_distance_slice,
    draw_gaussians,
    draw_goal,
    draw_vehicle,
)
from splatpilot.systems.visualization.video import VideoRecorder


def empty_meshcat(background: Background) -> Meshcat:
    """Returns a Meshcat with the color of the background, and without grid and axes."""
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    for end in ("top_color", "bottom_color"):
        meshcat.SetProperty("/Background/<object>", end, list(mean_color(background)))
    return meshcat


def open_meshcat(scenario: Scenario, world: World) -> Meshcat:
    """Returns a Meshcat with goal, distance field and background, seen from above the start."""
    meshcat = empty_meshcat(world.background)
    p_WG = goal_position(scenario, world)
    draw_goal(meshcat, "/splatpilot/goal", p_WG, scenario.goal_radius)
    draw_distance_slice(meshcat, "/splatpilot/distance_slice", world.distance_field, float(p_WG[2]))
    meshcat.SetProperty("/splatpilot/distance_slice", "visible", False)

    p_WS = start_position(scenario, world)
    p_SG_W = p_WG - p_WS
    distance = max(float(np.linalg.norm(p_SG_W)), 1e-6)
    eye = p_WS - 0.2 * p_SG_W + [0.0, 0.0, 3.0 + 0.35 * distance]
    meshcat.SetCameraPose(eye, p_WS + 0.4 * p_SG_W)
    return meshcat


def AddMeshcat(builder: DiagramBuilder, scenario: Scenario, world: World, meshcat: Meshcat) -> None:
    """Draws the Gaussians and the vehicle; adds visualizers of `plant`, `policy` and `camera`."""
    field = world.distance_field
    margin = np.array([5.0, 5.0, 3.0])  # [m] of surroundings
    draw_gaussians(
        meshcat,
        "/splatpilot/scene",
        world.gaussians,
        field.lower_W - margin,
        field.upper_W + margin,
    )
    draw_vehicle(meshcat, "/splatpilot/vehicle", VEHICLE_RADIUS)

    plant, policy = (builder.GetSubsystemByName(name) for name in ("plant", "policy"))
    plans = policy.HasOutputPort("hypotheses")
    FlightVisualizer.AddToBuilder(
        builder,
        plant.GetOutputPort("state"),
        meshcat,
        policy.GetOutputPort("hypotheses") if plans else None,
    )
    if world.moving:
        MovingSpheresVisualizer.AddToBuilder(builder, world.moving.spheres, meshcat)
    camera = cast(SplatCamera, builder.GetSubsystemByName("camera"))
    CameraVisualizer.AddToBuilder(builder, camera, meshcat, period=1 / scenario.camera.fps)


LOG_PERIOD = 0.02  # [s]


def BuildFlightDiagram(
    scenario: Scenario,
    world: World,
    meshcat: Meshcat | None = None,
    video: bool = False,
    camera: bool = True,
    *,
    policy: System | None = None,
    plant: System | None = None,
    controller: System | None = None,
) -> Diagram:
    """Builds the diagram of one flight.

    Its default Context is the scenario's start, see `sample_initial_state`; so is the one of
    SetRandomContext, since Drake does not let systems in Python sample their states. For random
    flights see `random_flights`.

    Systems, by name: `plant`, those of `AddPolicyAndController` and `AddObservation`, the sensors
    under their names, `camera`, and the loggers `state_log`, `command_log` and `hypotheses_log`;
    with Meshcat also `flight_visualizer` and `camera_visualizer`, with video `video`.

    .. pydrake_system::

        name: flight
        output_ports: [state, command, hypotheses, color_image, depth_image_32f, depth_image_16u,
            clearance, gradient, in_collision, field_state]

    The port `hypotheses` is of policies that have it, the images are of the scenario's camera. Each
    output `p` of a sensor `s` is `s_p`.

    Args:
        meshcat: draws the flight; see `open_meshcat`.
        video: records the camera's images at its rate, for `VideoRecorder.save`.
        camera: adds the scenario's camera; Meshcat and videos need it, flights do not.
        policy: replaces the scenario's. Any system with one of the outputs `hypotheses`
            (see `splatpilot.systems.policies.hypotheses`), `acceleration`, `velocity` and
            `waypoint` (3 each), and optionally `heading` (1). Its inputs are any of `state` (13),
            `goal` (3), `depth_image_32f`, `color_image` and `depth_grid` of its own camera (its
            attribute `camera`, an `OnboardCamera`), and the outputs of sensors.
        plant: replaces `QuadrotorPlant`: any system with the input `command` (4), the output
            `state` (13), and that state as its continuous state, which `fly` sets to the start.
        controller: replaces `FlatnessController`: any system with the input `state`, that for the
            policy's output, and the output `command`.

    Raises:
        InfeasibleFlightError: see `sample_initial_state`.
        ValueError: for an invalid configuration, a system without the ports it needs, and Meshcat
            or video without the camera.
    """
    valid = camera or not (video or meshcat is not None)
    require(valid, "camera", "True with meshcat or video, which show its images", camera)
    scenario.validate()
    world = randomize_appearance(world, scenario.appearance, scenario.seed)
    builder = DiagramBuilder()

    # Vehicle.
    if plant is None:
        start = sample_initial_state(scenario, world)
        plant = cast(System, QuadrotorPlant(scenario.vehicle, start))
    builder.AddNamedSystem("plant", plant)
    require_ports("plant", plant, inputs=["command"], outputs=["state"])
    state = plant.GetOutputPort("state")
    builder.ExportOutput(state, "state")

    # Policy and controller.
    sensors = onboard_sensors(scenario, policy)
    policy, controller, pose, _ = AddPolicyAndController(
        builder, scenario, world, state, policy, controller
    )
    builder.Connect(controller.GetOutputPort("command"), plant.GetInputPort("command"))

    # Sensors.
    images = AddObservation(builder, scenario, world, state, pose, policy)
    measured = AddSensors(builder, sensors, world, state, pose)
    ConnectObservation(builder, {"state": state} | images | measured, policy)
    for name, port in measured.items():
        builder.ExportOutput(port, name)

    # Camera, video and Meshcat.
    if camera:
        onboard = MakeCamera(scenario, world)
        builder.AddNamedSystem("camera", onboard)
        builder.Connect(pose, onboard.GetInputPort("body_pose"))
        for name in ("color_image", "depth_image_32f", "depth_image_16u"):
            builder.ExportOutput(onboard.GetOutputPort(name), name)
        if meshcat is not None:
            AddMeshcat(builder, scenario, world, meshcat)
        if video:
            VideoRecorder.AddToBuilder(builder, onboard, scenario.camera.fps)

    # Logs.
    logs = [(plant, "state", LOG_PERIOD), (controller, "command", LOG_PERIOD)]
    if policy.HasOutputPort("hypotheses"):
        logs.append((policy, "hypotheses", decision_period(scenario, policy)))
    for system, name, period in logs:
        LogVectorOutput(system.GetOutputPort(name), builder, period).set_name(f"{name}_log")
    diagram = builder.Build()
    diagram.set_name("flight")
    return diagram


def MakeCamera(scenario: Scenario, world: World) -> SplatCamera:
    """Makes the scenario's camera of the world's Gaussians."""
    config = scenario.camera
    return SplatCamera(
        world.baked,
        camera_info(config),
        camera_mount(config),
        min_depth=config.z_near,
        max_depth=config.z_far,
        near=config.clipping_near,
        far=config.clipping_far,
        background=world.background,
        moving=world.moving.gaussians if world.moving else None,
    )


def camera_info(config: CameraConfig) -> CameraInfo:
    """Returns the intrinsics of a camera."""
    center_x, center_y = config.principal_point()
    return CameraInfo(
        width=config.width,
        height=config.height,
        focal_x=config.focal_x(),
        focal_y=config.focal_y(),
        center_x=center_x,
        center_y=center_y,
    )


def camera_mount(config: CameraConfig) -> RigidTransform:
    """Returns X_BC, the pose of a camera in the vehicle's body frame."""
    return config.X_PB.GetDeterministicValue() @ config.X_BC.GetDeterministicValue()
