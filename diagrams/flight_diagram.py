"""The closed loop: a vehicle that flies through what its camera sees."""

from typing import cast

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
from pydrake.systems.sensors import CameraInfo

from flysplat.diagrams.scenario import Scenario
from flysplat.diagrams.worlds.world import World
from flysplat.systems.collision.esdf_collision import EsdfCollision
from flysplat.systems.policies.hypothesis_selector import HypothesisSelector
from flysplat.systems.policies.privileged_planner import PrivilegedPlanner
from flysplat.systems.splats.baked_scene import BakedScene
from flysplat.systems.splats.splat_camera import SplatCamera
from flysplat.systems.vehicle.flatness_controller import FlatnessController
from flysplat.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from flysplat.systems.vehicle.quadrotor_plant import QuadrotorPlant
from flysplat.systems.vehicle.state_to_pose import StateToPose
from flysplat.systems.visualization.camera_visualizer import CameraVisualizer
from flysplat.systems.visualization.drawing import (
    draw_distance_slice,
    draw_gaussians,
    draw_goal,
    draw_vehicle,
)
from flysplat.systems.visualization.flight_visualizer import FlightVisualizer
from flysplat.systems.visualization.video_recorder import VideoRecorder

LOG_PERIOD = 0.02  # [s]


def BuildFlightDiagram(
    scenario: Scenario, world: World, meshcat: Meshcat | None = None, video: bool = False
) -> Diagram:
    """
    Builds the diagram of one flight.

    Systems, by name: `plant`, `pose`, `camera`, `collision`, `goal`, `policy`, `selector`,
    `controller`, and the loggers `state_log`, `command_log`, `hypotheses_log`; with Meshcat also
    `flight_visualizer` and `camera_visualizer`, with video `video`.

    .. pydrake_system::

        name: flight
        output_ports:
        - state
        - command
        - hypotheses
        - color_image
        - depth_image_32f
        - depth_image_16u
        - clearance
        - in_collision
        - field_state

    Args:
        scenario: who flies, how, from where to where; see `sample_initial_state` for its start.
        world: what is flown in.
        meshcat: draws the flight there when given.
        video: records the camera's images at its rate, for `VideoRecorder.save` to write.
    """
    builder = DiagramBuilder()

    plant = builder.AddNamedSystem("plant", QuadrotorPlant(scenario.vehicle))
    pose = builder.AddNamedSystem("pose", StateToPose())
    camera = builder.AddNamedSystem("camera", MakeCamera(scenario, world))
    collision = builder.AddNamedSystem("collision", EsdfCollision(world.distance_field))
    goal = builder.AddNamedSystem("goal", ConstantVectorSource(goal_of(scenario, world)))
    policy = builder.AddNamedSystem(
        "policy", PrivilegedPlanner(world.esdf, scenario.policy, scenario.vehicle)
    )
    selector = builder.AddNamedSystem(
        "selector",
        HypothesisSelector(scenario.policy.lattice.num_hypotheses, scenario.controller.lookahead),
    )
    controller = builder.AddNamedSystem(
        "controller", FlatnessController(scenario.controller, scenario.vehicle)
    )

    state = plant.GetOutputPort("state")
    builder.Connect(state, pose.GetInputPort("state"))
    builder.Connect(pose.GetOutputPort("pose"), camera.GetInputPort("body_pose"))
    builder.Connect(state, collision.GetInputPort("state"))
    builder.Connect(state, policy.GetInputPort("state"))
    builder.Connect(goal.get_output_port(), policy.GetInputPort("goal"))
    builder.Connect(policy.GetOutputPort("hypotheses"), selector.GetInputPort("hypotheses"))
    builder.Connect(state, selector.GetInputPort("state"))
    builder.Connect(selector.GetOutputPort("waypoint"), controller.GetInputPort("waypoint"))
    builder.Connect(state, controller.GetInputPort("state"))
    builder.Connect(controller.GetOutputPort("command"), plant.GetInputPort("command"))

    exported = {
        plant: ["state"],
        controller: ["command"],
        policy: ["hypotheses"],
        camera: ["color_image", "depth_image_32f", "depth_image_16u"],
        collision: ["clearance", "in_collision", "field_state"],
    }
    for system, names in exported.items():
        for name in names:
            builder.ExportOutput(system.GetOutputPort(name), name)

    for system, name in ((plant, "state"), (controller, "command")):
        LogVectorOutput(system.GetOutputPort(name), builder, LOG_PERIOD).set_name(f"{name}_log")
    LogVectorOutput(policy.GetOutputPort("hypotheses"), builder, 1 / scenario.policy.rate).set_name(
        "hypotheses_log"
    )

    if meshcat is not None:
        _AddMeshcat(builder, scenario, world, meshcat)

    if video:
        config = scenario.camera
        recorder = builder.AddNamedSystem(
            "video", VideoRecorder(config.width, config.height, config.fps)
        )
        for name in ("color_image", "depth_image_16u"):
            builder.Connect(camera.GetOutputPort(name), recorder.GetInputPort(name))

    diagram = builder.Build()
    diagram.set_name("flight")
    return diagram


def MakeCamera(scenario: Scenario, world: World) -> SplatCamera:
    """The scenario's camera, looking at the world's Gaussians."""
    config = scenario.camera
    center_x, center_y = config.principal_point()
    return SplatCamera(
        BakedScene(world.gaussians),
        CameraInfo(
            width=config.width,
            height=config.height,
            focal_x=config.focal_x(),
            focal_y=config.focal_y(),
            center_x=center_x,
            center_y=center_y,
        ),
        config.X_PB.GetDeterministicValue() @ config.X_BC.GetDeterministicValue(),
        min_depth=config.z_near,
        max_depth=config.z_far,
        near=config.clipping_near,
        far=config.clipping_far,
        background=world.background,
    )


def goal_of(scenario: Scenario, world: World) -> np.ndarray:
    """The goal p_WG (3,) [m]: the scenario's, or the world's where the scenario leaves it open."""
    return np.asarray(world.p_WG if scenario.goal is None else scenario.goal, dtype=float)


def _AddMeshcat(
    builder: DiagramBuilder, scenario: Scenario, world: World, meshcat: Meshcat
) -> None:
    """Draws what stands still, and adds the systems that draw what moves."""
    field = world.distance_field
    p_WG = goal_of(scenario, world)
    margin = np.array([5.0, 5.0, 3.0])  # [m] of surroundings that are drawn too.
    for end in ("top_color", "bottom_color"):
        meshcat.SetProperty("/Background", end, list(world.background))
    draw_gaussians(
        meshcat, "/flysplat/scene", world.gaussians, field.lower_W - margin, field.upper_W + margin
    )
    draw_goal(meshcat, "/flysplat/goal", p_WG, scenario.goal_radius)
    draw_vehicle(meshcat, "/flysplat/vehicle", VEHICLE_RADIUS)
    draw_distance_slice(meshcat, "/flysplat/distance_slice", field, float(p_WG[2]))
    meshcat.SetProperty("/flysplat/distance_slice", "visible", False)

    systems = {system.get_name(): system for system in builder.GetMutableSystems()}
    plant, policy = systems["plant"], systems["policy"]
    camera = cast(SplatCamera, systems["camera"])
    flight = builder.AddNamedSystem(
        "flight_visualizer", FlightVisualizer(meshcat, scenario.policy.lattice.num_hypotheses)
    )
    builder.Connect(plant.GetOutputPort("state"), flight.GetInputPort("state"))
    builder.Connect(policy.GetOutputPort("hypotheses"), flight.GetInputPort("hypotheses"))
    picture = builder.AddNamedSystem(
        "camera_visualizer",
        CameraVisualizer(
            meshcat, camera.camera_info(), camera.X_BC(), period=1 / scenario.camera.fps
        ),
    )
    builder.Connect(camera.GetOutputPort("color_image"), picture.GetInputPort("color_image"))
