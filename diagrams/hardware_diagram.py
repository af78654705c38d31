"""The pilot of the flight diagram behind messages: the vehicle is somewhere else."""

import numpy as np
from lcm import LCM
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort, System
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.diagrams.hardware_config import HardwareConfig
from splatpilot.diagrams.observation import camera_of, decision_period, images_of
from splatpilot.diagrams.pilot import AddPilot, ConnectObservation, Pilot, make_policy
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.messaging.arrival_triggered import ArrivalTriggered, can_be_triggered
from splatpilot.systems.messaging.bridge_status import BridgeStatus
from splatpilot.systems.messaging.codecs import (
    Codec,
    CommandCodec,
    DepthGridCodec,
    HypothesesCodec,
    MotionCaptureCodec,
    StateCodec,
    StatusCodec,
    VehicleStatusCodec,
    VelocitySetpointCodec,
)
from splatpilot.systems.messaging.failsafe import Failsafe
from splatpilot.systems.messaging.image_codec import ColorImageCodec, DepthImageCodec
from splatpilot.systems.messaging.message_publisher import MessagePublisher
from splatpilot.systems.messaging.message_subscriber import MessageSubscriber
from splatpilot.systems.messaging.time_of_flight_receiver import TimeOfFlightReceiver
from splatpilot.systems.messaging.unix_clock import UnixClock
from splatpilot.systems.policies.hypotheses import num_hypotheses_in
from splatpilot.systems.policies.velocity_setpoint import VelocitySetpoint
from splatpilot.systems.sensing.time_of_flight import sensor_of
from splatpilot.systems.vehicle.quadrotor_dynamics import hover_state
from splatpilot.systems.vehicle.state_prediction import StatePredictor


def BuildHardwareDiagram(
    scenario: Scenario,
    world: World,
    lcm: LCM,
    config: HardwareConfig | None = None,
    *,
    policy: System | None = None,
    controller: System | None = None,
) -> Diagram:
    """
    Builds the diagram that flies a vehicle by messages: that of `BuildFlightDiagram` with
    subscribers in the place of plant and camera. It runs with the wall clock, see
    `run_in_real_time`.

    Systems, by name: those of `AddPilot`; `clock`; the subscribers `state_subscriber` and one
    `{image}_subscriber` for each image that the policy sees, or `depth_grid_receiver` for the
    stream of a time-of-flight sensor; `vehicle_status_subscriber`, which tells when the bridge is
    in charge; `state_predictor`, which brings the state up to date;
    `velocity_setpoint`, `failsafe`, through which all goes that is sent to the vehicle, `status`;
    where motion capture must see a body `motion_capture_pose_subscriber`; and one
    `{port}_publisher` for each of `command`, `velocity_setpoint`, `status`, and `hypotheses` where
    the policy has them. Until messages have come, states and images are arbitrary but finite.

    .. pydrake_system::

        name: hardware
        input_ports:
        - overruns
        - lag
        output_ports:
        - state
        - command
        - hypotheses
        - color_image
        - depth_image_32f
        - clearance
        - gradient
        - in_collision
        - field_state
        - velocity_setpoint
        - status
        - in_charge

    The ports are those of `BuildFlightDiagram`, the images those that the policy sees; `status` and
    `overruns` are those of `BridgeStatus`, `command`, `velocity_setpoint`, `in_charge` and `lag`
    those of `Failsafe`.

    Args:
        scenario: who flies, and where to. Its vehicle is what is known of the one that flies.
        world: what is flown in, as far as that is known.
        lcm: where messages travel.
        config: how often, how old they may be, and within what limits.
        policy, controller: see `BuildFlightDiagram`.

    Raises:
        ValueError: for a configuration out of range or that no policy has, a system without the
            ports it needs, sensors, and worlds in which something moves.
    """
    config = config or HardwareConfig()
    config.validate()
    require_messages_for(scenario, world)
    builder = DiagramBuilder()
    clock = UnixClock()
    builder.AddNamedSystem("clock", clock)

    def add_subscriber(codec: Codec) -> MessageSubscriber:
        initial = {"state": hover_state(np.zeros(3)), "depth_grid": np.zeros(codec.size)}
        subscriber = MessageSubscriber(lcm, codec, config.tick, initial.get(codec.port))
        builder.AddNamedSystem(f"{codec.port}_subscriber", subscriber)
        builder.Connect(clock.get_output_port(), subscriber.unix_time_input_port())
        return subscriber

    def add_publisher(
        codec: Codec,
        source: OutputPort,
        period: float,
        enabled: OutputPort | None = None,
        decided: OutputPort | None = None,
    ) -> None:
        publisher = MessagePublisher(lcm, codec, period, config.tick if decided else None)
        builder.AddNamedSystem(f"{codec.port}_publisher", publisher)
        builder.Connect(source, publisher.GetInputPort(codec.port))
        builder.Connect(clock.get_output_port(), publisher.unix_time_input_port())
        if enabled is not None:
            builder.Connect(enabled, publisher.enabled_input_port())
        if decided is not None:
            builder.Connect(decided, publisher.decided_input_port())

    received: dict[str, MessageSubscriber | TimeOfFlightReceiver] = {
        "state": add_subscriber(StateCodec())
    }
    predictor = StatePredictor(config.failsafe.max_age)  # As long as states are flown by.
    builder.AddNamedSystem("state_predictor", predictor)
    builder.Connect(received["state"].GetOutputPort("state"), predictor.measured_state_input_port())
    builder.Connect(received["state"].age_output_port(), predictor.age_input_port())
    state = predictor.state_output_port()
    policy = policy or make_policy(scenario, world)
    decided, decision = None, decision_period(scenario, policy)
    codecs = image_codecs(scenario, policy)
    if can_be_triggered(policy):
        policy = ArrivalTriggered(policy, config.tick)
        decided = policy.decided_output_port()
    pilot = AddPilot(builder, scenario, world, state, policy, controller, guarded=True)
    for codec in codecs:
        if codec.port == "depth_grid" and config.time_of_flight is not None:
            receiver = TimeOfFlightReceiver(config.time_of_flight, config.tick)
            builder.AddNamedSystem("depth_grid_receiver", receiver)
            received[codec.port] = receiver
        else:
            received[codec.port] = add_subscriber(codec)
    observed = {"state": state}
    observed |= {name: received[name].GetOutputPort(name) for name in list(received)[1:]}

    status = BridgeStatus(list(received)[1:])
    builder.AddNamedSystem("status", status)
    # A policy that sees nothing decides by states.
    oldest = status.observation_age_output_port()
    age = {"observation_age": oldest if codecs else received["state"].age_output_port()}
    ConnectObservation(builder, observed | age, pilot.policy)
    failsafe = Failsafe(
        config.failsafe,
        scenario.controller,
        scenario.vehicle,
        world.distance_field.lower_W,
        world.distance_field.upper_W,
        world.distance_field,
    )
    builder.AddNamedSystem("failsafe", failsafe)
    for signal, subscriber in received.items():
        for what in ("age", "gaps", "rejected"):
            port = status.GetInputPort(f"{signal}_{what}")
            builder.Connect(subscriber.GetOutputPort(what), port)
    builder.ExportInput(status.overruns_input_port(), "overruns")
    builder.ExportInput(failsafe.lag_input_port(), "lag")

    wanted = _AddVelocitySetpoint(builder, scenario, state, pilot).velocity_setpoint_output_port()
    collision = builder.GetSubsystemByName("collision")
    for source, name in (
        (state, "state"),
        (received["state"].GetOutputPort("state"), "measured_state"),
        (received["state"].age_output_port(), "state_age"),
        (status.observation_age_output_port(), "observation_age"),
        (wanted, "velocity_setpoint"),
        (pilot.controller.GetOutputPort("command"), "command"),
        (collision.GetOutputPort("clearance"), "clearance"),
        (collision.GetOutputPort("gradient"), "gradient"),
    ):
        builder.Connect(source, failsafe.GetInputPort(name))
    vehicle_status = add_subscriber(VehicleStatusCodec())
    builder.Connect(
        vehicle_status.GetOutputPort("vehicle_status"), failsafe.vehicle_status_input_port()
    )
    builder.Connect(vehicle_status.age_output_port(), failsafe.vehicle_status_age_input_port())
    if pilot.policy.HasOutputPort("failed"):
        builder.Connect(pilot.policy.GetOutputPort("failed"), failsafe.policy_failed_input_port())
    if config.body:
        body = add_subscriber(MotionCaptureCodec(config.body))
        builder.Connect(body.age_output_port(), failsafe.body_age_input_port())
    builder.Connect(failsafe.mode_output_port(), status.mode_input_port())
    command, setpoint = failsafe.command_output_port(), failsafe.velocity_setpoint_output_port()
    known, period = failsafe.state_is_known_output_port(), scenario.controller.period
    add_publisher(CommandCodec(), command, period, known)
    is_ready = failsafe.is_ready_output_port()
    add_publisher(VelocitySetpointCodec(), setpoint, period, is_ready, decided)
    add_publisher(StatusCodec(), status.status_output_port(), 1 / config.status_rate)
    if pilot.policy.HasOutputPort("hypotheses"):
        plans = pilot.policy.GetOutputPort("hypotheses")
        codec = HypothesesCodec(num_hypotheses_in(plans.size()))
        add_publisher(codec, plans, decision, decided=decided)

    for name, port in observed.items():
        builder.ExportOutput(port, name)
    builder.ExportOutput(command, "command")
    builder.ExportOutput(setpoint, "velocity_setpoint")
    builder.ExportOutput(status.status_output_port(), "status")
    builder.ExportOutput(failsafe.in_charge_output_port(), "in_charge")
    diagram = builder.Build()
    diagram.set_name("hardware")
    return diagram


def image_codecs(scenario: Scenario, policy: System) -> list[Codec]:
    """How the images travel that a policy sees."""
    camera = camera_of(scenario, policy)
    size, sensor = (camera.width, camera.height), sensor_of(camera)
    codecs = {
        "depth_image_32f": DepthImageCodec(ImageDepth32F(*size), "policy_camera"),
        "color_image": ColorImageCodec(ImageRgba8U(*size), "policy_camera"),
        "depth_grid": DepthGridCodec(
            sensor.columns, sensor.rows, sensor.max_range, "policy_camera"
        ),
    }
    return [codecs[name] for name in images_of(policy)]


def require_messages_for(scenario: Scenario, world: World) -> None:
    """Raises ValueError for what a scenario or its world has that no message carries."""
    sensors = getattr(scenario.policy, "sensors", {}) | scenario.sensors
    if sensors:
        raise ValueError(
            f"no message carries what the sensors {', '.join(sensors)} measure; leave them out"
        )
    if world.moving:
        raise ValueError(
            f"in {world.name} something moves, and no message says where it is; fly in another "
            "world"
        )


def _AddVelocitySetpoint(
    builder: DiagramBuilder, scenario: Scenario, state: OutputPort, pilot: Pilot
) -> VelocitySetpoint:
    setpoint = VelocitySetpoint(scenario.controller)
    builder.AddNamedSystem("velocity_setpoint", setpoint)
    builder.Connect(state, setpoint.state_input_port())
    builder.Connect(pilot.decision, setpoint.GetInputPort(pilot.decision.get_name()))
    if pilot.policy.HasOutputPort("heading"):
        builder.Connect(pilot.policy.GetOutputPort("heading"), setpoint.heading_input_port())
    return setpoint
