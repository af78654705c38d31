"""AddFlight and BuildFlightDiagram: the closed loop of vehicle, sensors, policy and controller."""

import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams, SceneGraph
from pydrake.systems.framework import (
    Diagram,
    DiagramBuilder,
    OutputPort,
    System,
)
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.diagrams.flight.blocks import (
    AddDelayedPose,
    AddMovingBodies,
    AddObservation,
    AddPolicyAndController,
    AddPoseAndCollision,
    AddSensors,
    AddWind,
    ConnectObservation,
    ConnectOrExport,
    DecisionInput,
    ExportCollision,
    MakeCamera,
    add_system,
    decision_period,
    make_policy,
    onboard_sensors,
    policy_images,
    require_ports,
)
from splatpilot.diagrams.flight.monitor import AddFlightMonitor, FlightMonitor
from splatpilot.diagrams.flight.scenario import (
    Scenario,
    goal_position,
    sample_initial_state,
    sample_scenario,
    start_position,
)
from splatpilot.diagrams.flight.sensors import ESTIMATORS
from splatpilot.diagrams.worlds.appearance import randomize_appearance
from splatpilot.diagrams.worlds.moving_spheres import add_moving_spheres
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.common.drake import connect, vector_output
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import require, require_type
from splatpilot.systems.policies.teleop import Teleop
from splatpilot.systems.sensing.latency import FrameTimes
from splatpilot.systems.splats.background import Background, mean_color
from splatpilot.systems.splats.moving_bodies import MovingBodies
from splatpilot.systems.splats.render_engine import ObstacleGeometry, SplatRenderEngine
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.quadrotor import QuadrotorPlant
from splatpilot.systems.vehicle.quadrotor_geometry import QuadrotorGeometry, quadrotor_gaussians
from splatpilot.systems.visualization.flight_visualizer import DRAWINGS, FlightVisualizer
from splatpilot.systems.visualization.meshcat_drawing import (
    CameraVisualizer,
    MovingBodiesVisualizer,
    draw_box,
    draw_distance_slice,
    draw_frustum,
    draw_gaussians,
    draw_goal,
    vehicle_path,
)
from splatpilot.systems.visualization.rerun_sink import RerunSink
from splatpilot.systems.visualization.video import VideoRecorder


def empty_meshcat(background: Background) -> Meshcat:
    """Returns a Meshcat with the color of the background, and without grid and axes."""
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    for end in ("top_color", "bottom_color"):
        meshcat.SetProperty("/Background/<object>", end, list(mean_color(background)))
    return meshcat


def open_meshcat(scenario: Scenario, world: World, meshcat: Meshcat | None = None) -> Meshcat:
    """Returns a Meshcat, by default a new one with the background of the world, with goal and
    distance field, seen from above the start."""
    meshcat = meshcat or empty_meshcat(world.background)
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


class FlightParts(NamedTuple):
    """Systems and ports of a flight, see `AddFlight`.

    Args:
        name: Name of the flight.
        scenario: Scenario, with values drawn from its distributions.
        world: World, with the scenario's moving obstacles and appearance.
        plant: Vehicle.
        estimator: Source of the state that policy and controller know.
        policy: Policy.
        controller: Controller; None if the policy decides the command.
        collision: `EsdfCollision`.
        camera: Scenario's camera; policies see `policy_camera`.
        geometry: Vehicle in the SceneGraph.
        monitor: Ends the flight.
        state: (13), the true state.
        pose: The true X_WB.
        goal: p_WG (3) [m].
        decision: Of the policy: `hypotheses` or one of `DECISIONS`.
        command: To the vehicle (4): thrust [m/s^2], body rates [rad/s].
        observation: Inputs of the policy by name.
        measured: Outputs of sensors by name.
        systems: All that the flight added.
    """

    name: str
    scenario: Scenario
    world: World
    plant: System
    estimator: System | None
    policy: System
    controller: System | None
    collision: System
    camera: SplatCamera | None
    geometry: QuadrotorGeometry | None
    monitor: FlightMonitor
    state: OutputPort
    pose: OutputPort
    goal: OutputPort
    decision: OutputPort
    command: OutputPort
    observation: dict[str, OutputPort]
    measured: dict[str, OutputPort]
    systems: list[System]


def AddFlight(
    builder: DiagramBuilder,
    scenario: Scenario,
    world: World,
    *,
    name: str = "flight",
    policy: Any = None,
    plant: System | None = None,
    controller: System | None = None,
    estimator: System | None = None,
    camera: bool = True,
    scene_graph: SceneGraph | None = None,
    others: Sequence[FlightParts] = (),
    logs: bool = True,
) -> FlightParts:
    """Adds the closed loop of one vehicle to a builder.

    Systems: `plant`, `pose`, `collision`, `goal`, `policy`, `controller`, `camera`, `monitor`,
    `policy_camera`, which renders what the policy sees, the sensors under their names, `selector`
    for hypotheses, `velocity_tracker` for velocities, and `moving` if anything moves. Names of a
    flight that is not named `flight` begin with its name: `two_plant`. Values are drawn from the
    scenario's distributions by its seed.

    Systems that are given may be in the builder already, with connected inputs. Open inputs of a
    given plant or controller are exported, as `plant_wind`.

    Args:
        name: of the flight; "flight" adds no prefix to the names of systems.
        policy: replaces the scenario's: a configuration, a system, or one of `DECISIONS`.

            A system has one of the outputs `hypotheses` (see
            `splatpilot.systems.policies.hypotheses`), `command` (4: thrust [m/s^2], body rates
            [rad/s]), `acceleration`, `velocity` and `waypoint` (3 each), and optionally `heading`
            (1). Its inputs are any of `state` (13), `goal` (3), `depth_image_32f`, `color_image`
            and `depth_grid` of its own camera (its attribute `camera`, an `OnboardCamera`), the
            outputs of sensors, and `moving` of `MovingBodies`, without a value if nothing moves.

            A decision, such as "velocity", and a `DecisionInput` become an exported input of the
            decision's name.
        plant: replaces `QuadrotorPlant`: any system with the input `command` (4) and the output
            `state` (13). Its default Context has the initial state, see `sample_initial_state`.
        controller: replaces `FlatnessController`: any system with the input `state`, that for the
            policy's output, and the output `command`.
        estimator: replaces the scenario's; makes the `state` (13) for policy and controller. Its
            inputs are any of `state` and `body_pose`, the true ones, `command`, `goal`, the
            policy's images and the outputs of sensors.
        camera: adds the scenario's camera.
        scene_graph: gets the vehicle, see `QuadrotorGeometry`, and the world as the renderer
            `splats` if it has none of that name, see `AddSplatWorld`.
        others: flights in this builder whose vehicles and this one see and hit each other.
        logs: adds the logs that `fly` reads.

    Raises:
        InfeasibleFlightError: see `sample_initial_state`; also for vehicles that start in contact.
    """
    require_type(scenario, Scenario, "scenario")
    require_type(world, World, "world")
    before = builder.GetSystems()
    prefix = _prefix(name)
    if isinstance(policy, str):
        policy = DecisionInput(policy)
    elif not (policy is None or isinstance(policy, System)):
        scenario, policy = replace(scenario, policy=policy), None
    scenario = sample_scenario(scenario)
    scenario.validate()
    if scenario.appearance > 0:
        world = randomize_appearance(world, scenario.appearance, scenario.seed)
    if scenario.moving:
        world = add_moving_spheres(world, scenario.moving)

    # Vehicle.
    is_given = plant is not None
    plant = plant or QuadrotorPlant(scenario.vehicle, sample_initial_state(scenario, world))
    assert plant is not None
    add_system(builder, "plant", plant)
    require_ports("plant", plant, inputs=["command"], outputs=["state"])
    state = plant.GetOutputPort("state")
    AddWind(builder, scenario, plant)
    pose, collision = AddPoseAndCollision(builder, world, state, scenario.vehicle.radius)
    source = ConstantVectorSource(goal_position(scenario, world))
    goal = builder.AddNamedSystem("goal", source).get_output_port()
    estimate, estimator_sensors = state, {}
    if estimator is None:
        make = ESTIMATORS.entry_for(scenario.estimator).build
        estimator = make(scenario.estimator, world, scenario)
        estimator_sensors = getattr(scenario.estimator, "sensors", {})
    if estimator is not None:
        add_system(builder, "estimator", estimator)
        require_ports("estimator", estimator, inputs=[], outputs=["state"])
        estimate = estimator.GetOutputPort("state")

    # Policy and controller.
    sensors = onboard_sensors(scenario, policy) | estimator_sensors
    policy = policy or make_policy(scenario, world)
    autonomy = AddPolicyAndController(
        builder, scenario, estimate, policy, controller, delay=scenario.decision_delay
    )
    connect(builder, autonomy.command, plant.GetInputPort("command"))

    # Sensors.
    is_external = isinstance(policy, DecisionInput)
    if is_external:
        builder.ExportInput(policy.get_input_port(), f"{prefix}{autonomy.target.get_name()}")
    added, measured = AddSensors(builder, sensors, world, scenario, state)
    names = policy_images(policy, *added.values(), *([estimator] if estimator else []))
    if is_external:
        names = list({"color_image": 0, "depth_image_32f": 0} | dict.fromkeys(names))
    images = AddObservation(builder, scenario, world, state, pose, policy, names)
    observation = {"state": estimate, "goal": goal} | images | measured
    ConnectObservation(builder, "policy", policy, observation)
    truth = {"state": state, "body_pose": pose, "command": autonomy.command}
    if plant.HasOutputPort("acceleration"):
        truth["acceleration"] = plant.GetOutputPort("acceleration")
    for sensor_name, sensor in added.items():
        ConnectObservation(builder, f"sensor {sensor_name!r}", sensor, observation | truth)
    if estimator is not None:
        ConnectObservation(builder, "estimator", estimator, observation | truth)
    if is_given:
        ConnectOrExport(builder, plant, {}, f"{prefix}plant")
    if controller is not None:
        ConnectOrExport(builder, controller, observation, f"{prefix}controller")
    onboard = None
    if camera:
        onboard = MakeCamera(scenario, world)
        builder.AddNamedSystem("camera", onboard)
        seen_from, delay = pose, scenario.camera.output_delay
        if delay > 0.0:
            frames = FrameTimes.late(delay)
            seen_from = AddDelayedPose(builder, "camera_delayed_pose", state, frames)
        builder.Connect(seen_from, onboard.GetInputPort("body_pose"))

    # End and logs.
    plans = policy.GetOutputPort("hypotheses") if policy.HasOutputPort("hypotheses") else None
    monitor = AddFlightMonitor(
        builder,
        scenario,
        world,
        state,
        autonomy.command,
        goal=goal,
        collision=collision,
        hypotheses=plans,
        plan_period=decision_period(scenario, policy),
        logs=logs,
    )
    systems = [each for each in builder.GetSystems() if all(each is not old for old in before)]
    for system in systems:
        system.set_name(f"{prefix}{system.get_name()}")
    geometry = None
    if scene_graph is not None:
        if not scene_graph.HasRenderer("splats"):
            AddSplatWorld(builder, scene_graph, world)
        geometry = QuadrotorGeometry.AddToBuilder(
            builder,
            state,
            scene_graph,
            name=f"{prefix}quadrotor",
            radius=scenario.vehicle.radius,
        )
        systems.append(geometry)
    names = [system.get_name() for system in builder.GetSystems()]
    common = max(names, key=names.count)
    count = names.count(common)
    require(count == 1, "names of systems", "different", f"{count} of {common!r}", _RENAME)
    parts = FlightParts(
        name=name,
        scenario=scenario,
        world=world,
        plant=plant,
        estimator=estimator,
        policy=policy,
        controller=autonomy.controller,
        collision=collision,
        camera=onboard,
        geometry=geometry,
        monitor=monitor,
        state=state,
        pose=pose,
        goal=goal,
        decision=plans or autonomy.target,
        command=autonomy.command,
        observation=observation,
        measured=measured,
        systems=systems,
    )
    if world.moving is not None:
        _moving_bodies(builder, parts)
    for other in others:
        _require_apart(parts, other)
        for seeing, seen in ((parts, other), (other, parts)):
            radius = seen.scenario.vehicle.radius
            drawn = quadrotor_gaussians(radius)
            AddMovingBody(builder, seeing, seen.name, drawn, radius, seen.pose)
    return parts


def AddMovingBody(
    builder: DiagramBuilder,
    parts: FlightParts,
    name: str,
    gaussians: GaussianScene,
    radius: float,
    X_WO: OutputPort,
) -> None:
    """Adds a body that cameras, sensors and planner of a flight see, and its vehicle hits.

    Args:
        parts: of the flight, as `AddFlight` returns them.
        name, gaussians, radius: see `MovingBodies.DeclareBody`.
        X_WO: port of the body's pose (RigidTransform).
    """
    port = _moving_bodies(builder, parts).DeclareBody(name, gaussians, radius)
    builder.Connect(X_WO, port)


def _moving_bodies(builder: DiagramBuilder, parts: FlightParts) -> MovingBodies:
    """Returns the system `moving` of a flight; adds it if it is missing."""
    if (moving := _find(builder, parts, "moving")) is not None:
        return cast(MovingBodies, moving)
    name = _prefix(parts.name) + "moving"
    return AddMovingBodies(builder, parts.world, [*parts.systems, parts.policy], name)


def _prefix(flight: str) -> str:
    return "" if flight == "flight" else f"{flight}_"


def _find(builder: DiagramBuilder, parts: FlightParts, name: str) -> System | None:
    """Returns the system of a flight that `AddFlight` lists by this name, None without any."""
    name = _prefix(parts.name) + name
    return builder.GetSubsystemByName(name) if builder.HasSubsystemNamed(name) else None


def _require_apart(parts: FlightParts, other: FlightParts) -> None:
    """Raises InfeasibleFlightError if two vehicles start in contact."""
    one, two = (
        vector_output(plant, "state", plant.CreateDefaultContext())[:3]
        for plant in (parts.plant, other.plant)
    )
    distance = float(np.linalg.norm(one - two))
    apart = parts.scenario.vehicle.radius + other.scenario.vehicle.radius
    if distance <= apart:
        raise InfeasibleFlightError(
            f"the distance between the starts of {parts.name} and {other.name} must be > "
            f"{apart:g} m, got {distance:.2f} m; set start of one scenario"
        )


_RENAME = "rename the sensor or your own system, or give AddFlight another name"


def AddSplatWorld(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    world: World,
    renderer_name: str = "splats",
) -> None:
    """Adds a renderer of the world's Gaussians, sky and moving obstacles to a SceneGraph.

    Cameras of the renderer show the SceneGraph's shapes among the Gaussians, see
    `SplatRenderEngine`. The world is static for contacts and distances of the SceneGraph.
    """
    engine = SplatRenderEngine(world.baked, background=world.background)
    scene_graph.AddRenderer(renderer_name, engine)
    if world.moving is not None:
        name = f"{renderer_name}_obstacles"
        ObstacleGeometry.AddToBuilder(builder, scene_graph, world.moving, name)


def ExportFlight(builder: DiagramBuilder, parts: FlightParts) -> None:
    """Exports the ports of a flight as `BuildFlightDiagram` names them."""
    outputs = {"state": parts.state, "command": parts.command}
    outputs["outcome"] = parts.monitor.get_output_port()
    if parts.decision.get_name() == "hypotheses":
        outputs["hypotheses"] = parts.decision
    if parts.camera is not None:
        for name in ("color_image", "depth_image_32f", "depth_image_16u"):
            outputs[name] = parts.camera.GetOutputPort(name)
    if parts.estimator is not None:
        outputs["estimated_state"] = parts.observation["state"]
    outputs |= {f"observation_{name}": port for name, port in parts.observation.items()}
    for name, port in (outputs | parts.measured).items():
        builder.ExportOutput(port, name)
    ExportCollision(builder, parts.collision)
    ConnectOrExport(builder, parts.plant, {}, "plant")


def BuildFlightDiagram(
    scenario: Scenario,
    world: World,
    meshcat: Meshcat | None = None,
    video: bool = False,
    camera: bool = True,
    *,
    policy: Any = None,
    plant: System | None = None,
    controller: System | None = None,
    estimator: System | None = None,
    draw: Collection[str] = (),
    rerun: Path | None = None,
) -> Diagram:
    """Builds the diagram of one flight of `AddFlight`.

    Its default Context is the scenario's start, see `sample_initial_state`.

    .. pydrake_system::

        name: flight
        output_ports: [state, command, outcome, hypotheses, color_image, depth_image_32f,
            depth_image_16u, clearance, barrier, gradient, in_collision, field_state,
            estimated_state]

    The port `hypotheses` is of policies that have it, the images are of the scenario's camera. Each
    output `p` of a sensor `s` is `s_p`, and what the policy can observe as `p` is `observation_p`.

    Args:
        meshcat: draws the flight; see `open_meshcat`.
        video: records the camera's images at its rate, for `VideoRecorder.save`.
        camera: adds the scenario's camera; Meshcat and videos need it, flights do not.
        policy, plant, controller, estimator: see `AddFlight`.
        draw: see `AddMeshcat`.
        rerun: file of the system `rerun`, a `RerunSink`.

    Raises:
        InfeasibleFlightError: see `AddFlight`.
    """
    valid = camera or not (video or meshcat is not None)
    require(valid, "camera", "True with meshcat or video, which show its images", camera)
    builder = DiagramBuilder()
    parts = AddFlight(
        builder,
        scenario,
        world,
        policy=policy,
        plant=plant,
        controller=controller,
        estimator=estimator,
        camera=camera,
    )
    ExportFlight(builder, parts)
    if meshcat is not None:
        AddMeshcat(builder, parts, meshcat, draw)
    if rerun is not None:
        AddRerun(builder, parts, rerun)
    if video and parts.camera is not None:
        VideoRecorder.AddToBuilder(builder, parts.camera, scenario.camera.fps)
    try:
        diagram = builder.Build()
    except RuntimeError as error:
        if "algebraic loop" not in str(error):
            raise
        ports = re.findall(r"\((\w+)\) of System ::(\S+)", str(error))
        loop = " -> ".join(f"{system}.{port}" for port, system in ports)
        raise ValueError(
            f"the systems must not depend on their own outputs at the same instant, got {loop}; "
            "declare the prerequisites of outputs, or hold one in a discrete state"
        ) from None
    diagram.set_name("flight")
    return diagram


def check_drawings(draw: Collection[str]) -> None:
    """Raises ValueError for a name that `AddMeshcat` does not draw."""
    known = [*DRAWINGS, "axes", "depth", "frustum", "limits"]
    for name in draw:
        require(name in known, "draw", f"names of {', '.join(known)}", name)


def AddMeshcat(
    builder: DiagramBuilder, parts: FlightParts, meshcat: Meshcat, draw: Collection[str] = ()
) -> None:
    """Draws a world, and adds visualizers of vehicle, plans and camera, and controls of `Teleop`.
    Bodies of `AddMovingBody` are drawn if they were added before.

    Args:
        parts: of a flight in the builder, as `AddFlight` returns them.
        draw: names of `DRAWINGS`; "axes" of the body; "depth" of the camera, as points; "frustum"
            of the policy's camera; "limits" of the world.
    """
    check_drawings(draw)
    condition = "True, for Meshcat shows its images"
    require(parts.camera is not None, "camera of AddFlight", condition, False)
    assert parts.camera is not None  # for type checkers
    world, folder = parts.world, vehicle_path(parts.plant, "plant")
    field = world.distance_field
    margin = np.array([5.0, 5.0, 3.0])  # [m] of surroundings
    draw_gaussians(
        meshcat,
        "/splatpilot/scene",
        world.gaussians,
        field.lower_W - margin,
        field.upper_W + margin,
    )
    if "limits" in draw:
        draw_box(meshcat, "/splatpilot/limits", field.lower_W, field.upper_W)
    if "frustum" in draw:
        seen = cast(SplatCamera | None, _find(builder, parts, "policy_camera"))
        condition = "without frustum for a policy without images"
        require(seen is not None, "draw", condition, "frustum")
        assert seen is not None  # for type checkers
        path = f"{folder}/vehicle/policy_camera"
        draw_frustum(meshcat, path, seen.camera_info(), seen.X_BC())
    if isinstance(parts.policy, Teleop):
        parts.policy.add_controls(meshcat)

    plans = parts.decision if parts.decision.get_name() == "hypotheses" else None
    outputs = ("distance", "gradient", "barrier")
    sources = {name: parts.collision.GetOutputPort(name) for name in outputs}
    sources |= {"command": parts.command, parts.decision.get_name(): parts.decision}
    if (selector := _find(builder, parts, "selector")) is not None:
        sources["waypoint"] = selector.GetOutputPort("waypoint")
    valid = "waypoint" in sources or "waypoint" not in draw
    require(valid, "draw", "without waypoint for a policy that decides none", "waypoint")
    vehicle = [name for name in draw if name not in ("depth", "frustum", "limits")]
    FlightVisualizer.AddToBuilder(
        builder,
        parts.state,
        meshcat,
        plans,
        draw=vehicle,
        sources=sources,
        radius=parts.scenario.vehicle.radius,
    )
    if (moving := _find(builder, parts, "moving")) is not None:
        visualizer = MovingBodiesVisualizer(meshcat, f"{folder}/moving")
        builder.AddNamedSystem(f"{moving.get_name()}_visualizer", visualizer)
        builder.Connect(moving.get_output_port(), visualizer.get_input_port())
    fps = parts.scenario.camera.fps
    CameraVisualizer.AddToBuilder(
        builder, parts.camera, meshcat, period=1 / fps, depth="depth" in draw
    )


def AddRerun(builder: DiagramBuilder, parts: FlightParts, path: Path) -> RerunSink:
    """Records a flight for the viewer Rerun."""
    ports = {"state": parts.state, "command": parts.command}
    ports["clearance"] = parts.collision.GetOutputPort("clearance")
    ports["outcome"] = parts.monitor.get_output_port()
    if parts.decision.get_name() == "hypotheses":
        ports["hypotheses"] = parts.decision
    return RerunSink.AddToBuilder(
        builder,
        path,
        ports,
        gaussians=parts.world.gaussians,
        goal=goal_position(parts.scenario, parts.world),
        radius=parts.scenario.vehicle.radius,
        camera=parts.camera,
        period=1 / parts.scenario.camera.fps,
    )
