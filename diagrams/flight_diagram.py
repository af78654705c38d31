"""The closed loop: a vehicle that flies through what its camera sees."""

from typing import cast

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
from pydrake.systems.sensors import CameraInfo

from splatpilot.diagrams.meshcat import AddMeshcat
from splatpilot.diagrams.observation import (
    AddObservation,
    AddSensors,
    decision_period,
    sensors_of,
)
from splatpilot.diagrams.policies import POLICIES
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_collision import EsdfCollision
from splatpilot.systems.policies.hypotheses import num_hypotheses_in
from splatpilot.systems.policies.hypothesis_selector import HypothesisSelector
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.flatness_controller import FlatnessController
from splatpilot.systems.vehicle.quadrotor_plant import QuadrotorPlant
from splatpilot.systems.vehicle.state_to_pose import StateToPose
from splatpilot.systems.visualization.video_recorder import VideoRecorder

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
    """
    Builds the diagram of one flight.

    Systems, by name: `plant`, `pose`, `collision`, `goal`, `policy`, `controller`, and the loggers
    `state_log`, `command_log`; with a camera `camera`; with a policy that sees `policy_camera`,
    with one that returns hypotheses `selector` and `hypotheses_log`; the sensors under their names;
    with Meshcat also `flight_visualizer` and `camera_visualizer`, with video `video`.

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

    The port `hypotheses` is there if the policy has it, the images if there is a camera. Each
    output `p` of a sensor `s` is there as `s_p`.

    Args:
        scenario: who flies, how, from where to where; see `sample_initial_state` for its start.
        world: what is flown in.
        meshcat: draws the flight there when given.
        video: records the camera's images at its rate, for `VideoRecorder.save` to write.
        camera: whether the scenario's camera is there; Meshcat and videos need it, flights do not.
        policy: flies instead of the scenario's. Any system with one of the outputs `hypotheses`
            (see `splatpilot.systems.policies.hypotheses`), `acceleration` (3) and `waypoint` (3),
            and perhaps `heading` (1), where to look. Its inputs are any of `state` (13), `goal`
            (3), `depth_image_32f` and `color_image` of a camera of its own (its attribute `camera`,
            an `OnboardCamera`), and the outputs of sensors.
        plant: flies instead of `QuadrotorPlant`: any system with the input `command` (4), the
            output `state` (13), and that state as its continuous state.
        controller: flies instead of `FlatnessController`: any system with the input `state`, that
            for the policy's output, and the output `command`.

    Raises:
        ValueError: for a configuration that no policy or sensor has, a system without the ports it
            needs, and Meshcat or video without the camera.
    """
    if not camera and (video or meshcat is not None):
        raise ValueError(
            f"camera is False, but {'video' if video else 'meshcat'} shows its images; leave "
            "camera out"
        )
    builder = DiagramBuilder()
    sensors = sensors_of(scenario, policy)
    if policy is None:
        policy = POLICIES.kind_of(scenario.policy).build(scenario.policy, world, scenario.vehicle)

    plant = cast(System, plant or QuadrotorPlant(scenario.vehicle))
    controller = controller or FlatnessController(scenario.controller, scenario.vehicle)

    builder.AddNamedSystem("plant", plant)
    balls = world.moving.balls if world.moving else None
    pose, collision = StateToPose(), EsdfCollision(world.distance_field, balls)
    builder.AddNamedSystem("pose", pose)
    builder.AddNamedSystem("collision", collision)
    goal = builder.AddNamedSystem("goal", ConstantVectorSource(goal_of(scenario, world)))
    builder.AddNamedSystem("policy", policy)
    builder.AddNamedSystem("controller", controller)
    _require_ports("plant", plant, inputs=["command"], outputs=["state"])
    _require_ports("controller", controller, inputs=["state"], outputs=["command"])

    state = plant.GetOutputPort("state")
    builder.Connect(state, pose.state_input_port())
    builder.Connect(state, collision.state_input_port())
    _ConnectDecision(builder, scenario, state, policy, controller)
    builder.Connect(state, controller.GetInputPort("state"))
    builder.Connect(controller.GetOutputPort("command"), plant.GetInputPort("command"))

    observed = {"state": state, "goal": goal.get_output_port()}
    observed |= AddObservation(builder, scenario, world, state, pose.pose_output_port(), policy)
    measured = AddSensors(builder, sensors, world, state, pose.pose_output_port())
    _ConnectObservation(builder, observed | measured, policy)

    exported = {
        plant: ["state"],
        controller: ["command"],
        collision: ["clearance", "in_collision", "field_state"],
    }
    if policy.HasOutputPort("hypotheses"):
        exported[policy] = ["hypotheses"]
    if camera:
        onboard = builder.AddNamedSystem("camera", MakeCamera(scenario, world))
        builder.Connect(pose.pose_output_port(), onboard.GetInputPort("body_pose"))
        exported[onboard] = ["color_image", "depth_image_32f", "depth_image_16u"]
    for system, names in exported.items():
        for name in names:
            builder.ExportOutput(system.GetOutputPort(name), name)
    for name, port in measured.items():
        builder.ExportOutput(port, name)

    for system, name in ((plant, "state"), (controller, "command")):
        LogVectorOutput(system.GetOutputPort(name), builder, LOG_PERIOD).set_name(f"{name}_log")
    if policy.HasOutputPort("hypotheses"):
        period = decision_period(scenario, policy)
        log = LogVectorOutput(policy.GetOutputPort("hypotheses"), builder, period)
        log.set_name("hypotheses_log")

    if meshcat is not None:
        AddMeshcat(builder, scenario, world, goal_of(scenario, world), meshcat)

    if video:
        onboard = cast(SplatCamera, builder.GetSubsystemByName("camera"))
        VideoRecorder.AddToBuilder(builder, onboard, scenario.camera.fps)

    diagram = builder.Build()
    diagram.set_name("flight")
    return diagram


def MakeCamera(scenario: Scenario, world: World) -> SplatCamera:
    """The scenario's camera, looking at the world's Gaussians."""
    config = scenario.camera
    center_x, center_y = config.principal_point()
    return SplatCamera(
        world.baked,
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
        moving=world.moving.gaussians if world.moving else None,
    )


def _require_ports(what: str, system: System, inputs: list[str], outputs: list[str]) -> None:
    lacking = [name for name in inputs if not system.HasInputPort(name)]
    lacking += [name for name in outputs if not system.HasOutputPort(name)]
    if lacking:
        raise ValueError(
            f"the {what} {type(system).__name__} has no port {lacking[0]!r}; it needs the inputs "
            f"{inputs} and the outputs {outputs}"
        )


def _ConnectObservation(
    builder: DiagramBuilder, observed: dict[str, OutputPort], policy: System
) -> None:
    """Leads to each input of the policy what bears its name."""
    for index in range(policy.num_input_ports()):
        port = policy.get_input_port(index)
        if port.get_name() not in observed:
            raise ValueError(
                f"nothing gives the input {port.get_name()!r} of the policy "
                f"{type(policy).__name__}; there are {', '.join(observed)}, and the outputs of "
                "sensors that the scenario names"
            )
        builder.Connect(observed[port.get_name()], port)


def _ConnectDecision(
    builder: DiagramBuilder,
    scenario: Scenario,
    state: OutputPort,
    policy: System,
    controller: System,
) -> None:
    """Leads what the policy decides to the controller's port of that kind."""
    if policy.HasOutputPort("hypotheses"):
        hypotheses = policy.GetOutputPort("hypotheses")
        count = num_hypotheses_in(hypotheses.size())
        selector = HypothesisSelector(count, scenario.controller.lookahead)
        builder.AddNamedSystem("selector", selector)
        builder.Connect(hypotheses, selector.hypotheses_input_port())
        builder.Connect(state, selector.state_input_port())
        builder.Connect(selector.waypoint_output_port(), controller.GetInputPort("waypoint"))
    else:
        kind = "acceleration" if policy.HasOutputPort("acceleration") else "waypoint"
        if not policy.HasOutputPort(kind):
            raise ValueError(
                f"the policy {type(policy).__name__} has none of the outputs hypotheses, "
                "acceleration and waypoint; give it one"
            )
        _require_ports("controller", controller, inputs=["state", kind], outputs=["command"])
        builder.Connect(policy.GetOutputPort(kind), controller.GetInputPort(kind))
    if policy.HasOutputPort("heading"):
        builder.Connect(policy.GetOutputPort("heading"), controller.GetInputPort("heading"))


def goal_of(scenario: Scenario, world: World) -> np.ndarray:
    """The goal p_WG (3,) [m]: the scenario's, or the world's where the scenario leaves it open."""
    return np.asarray(world.p_WG if scenario.goal is None else scenario.goal, dtype=float)
