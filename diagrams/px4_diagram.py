"""A vehicle that PX4 flies, behind the messages of the simulated one."""

from collections.abc import Callable

from lcm import LCM
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import Demultiplexer

from splatpilot.diagrams.px4_config import Px4Config
from splatpilot.diagrams.vehicle_diagram import STATUS_PERIOD
from splatpilot.systems.messaging.codecs import (
    Codec,
    CommandCodec,
    MotionCaptureCodec,
    StateCodec,
    StatusCodec,
    VehicleStatusCodec,
    VelocitySetpointCodec,
)
from splatpilot.systems.messaging.message_publisher import MeasurementPublisher, MessagePublisher
from splatpilot.systems.messaging.message_subscriber import MessageSubscriber
from splatpilot.systems.messaging.udp_inbox import UdpInbox
from splatpilot.systems.messaging.unix_clock import UnixClock
from splatpilot.systems.px4.mavlink import Mavlink
from splatpilot.systems.px4.motion_capture_receiver import MotionCaptureReceiver
from splatpilot.systems.px4.px4_commander import Px4Commander
from splatpilot.systems.px4.px4_telemetry import Px4Telemetry
from splatpilot.systems.vehicle.quadrotor_dynamics import GRAVITY


def BuildPx4Diagram(
    config: Px4Config, lcm: LCM, inbox: UdpInbox, now: Callable[[], float] | None = None
) -> Diagram:
    """
    Builds the diagram that stands between the bridge's messages and PX4: in the place of
    `BuildVehicleDiagram`, but for images, which sensors send themselves.

    Systems, by name: `clock`, `telemetry`, `commander`, `state_publisher`,
    `vehicle_status_publisher`, and the subscribers
    `setpoint_subscriber`, `status_subscriber` and, where there is motion capture,
    `motion_capture_subscriber`, or `motion_capture_receiver` and `motion_capture_publisher`.

    .. pydrake_system::

        name: px4
        output_ports:
        - state
        - state_age
        - heartbeat_age
        - armed
        - mode

    The ports are those of `Px4Telemetry`.

    Args:
        config: how.
        lcm: where the bridge is.
        inbox: where PX4 is.
        now: tells the Unix time [s] in a process that runs with the wall clock.

    Raises:
        ValueError: for a configuration out of range.
        ModuleNotFoundError: where pymavlink is not installed.
    """
    config.validate()
    builder = DiagramBuilder()
    mavlink, clock = Mavlink(config.system), UnixClock()
    address = config.vehicle_host, config.vehicle_port
    telemetry = Px4Telemetry(inbox, mavlink, address, config.tick, now)
    commander = Px4Commander(config.commander, inbox, mavlink, address, GRAVITY, tick=config.tick)
    publisher = MeasurementPublisher(lcm, StateCodec(), config.tick)
    for name, system in (
        ("clock", clock),
        ("telemetry", telemetry),
        ("commander", commander),
        ("state_publisher", publisher),
    ):
        builder.AddNamedSystem(name, system)

    builder.Connect(clock.get_output_port(), telemetry.unix_time_input_port())

    def add_subscriber(name: str, codec: Codec) -> tuple[OutputPort, OutputPort]:
        subscriber = MessageSubscriber(lcm, codec, config.tick)
        builder.AddNamedSystem(f"{name}_subscriber", subscriber)
        builder.Connect(clock.get_output_port(), subscriber.unix_time_input_port())
        return subscriber.GetOutputPort(codec.port), subscriber.age_output_port()

    velocity = config.commander.setpoints == "velocity"
    setpoint, age = add_subscriber(
        "setpoint", VelocitySetpointCodec() if velocity else CommandCodec()
    )
    status, _ = add_subscriber("status", StatusCodec())
    first = Demultiplexer([1, StatusCodec.size - 1])
    builder.AddNamedSystem("status_mode", first)
    builder.Connect(status, first.get_input_port())
    for source, name in (
        (setpoint, "setpoint"),
        (age, "setpoint_age"),
        (first.get_output_port(0), "bridge_mode"),
        *(
            (telemetry.GetOutputPort(name), name)
            for name in ("heartbeat_age", "armed", "mode", "granted")
        ),
        (clock.get_output_port(), "unix_time"),
    ):
        builder.Connect(source, commander.GetInputPort(name))
    if config.body:
        codec = MotionCaptureCodec(config.body)
        if config.motion_capture is None:
            pose, age = add_subscriber("motion_capture", codec)
        else:
            eye = MotionCaptureReceiver(config.motion_capture, config.tick, now)
            builder.AddNamedSystem("motion_capture_receiver", eye)
            pose, age = eye.motion_capture_pose_output_port(), eye.age_output_port()
            sender = MeasurementPublisher(lcm, codec, config.tick)
            builder.AddNamedSystem("motion_capture_publisher", sender)
            builder.Connect(pose, sender.GetInputPort(codec.port))
            builder.Connect(age, sender.age_input_port())
            builder.Connect(clock.get_output_port(), sender.unix_time_input_port())
            builder.Connect(clock.get_output_port(), eye.unix_time_input_port())
        builder.Connect(pose, commander.motion_capture_pose_input_port())
        builder.Connect(age, commander.motion_capture_age_input_port())

    vehicle_status = MessagePublisher(lcm, VehicleStatusCodec(), STATUS_PERIOD)
    builder.AddNamedSystem("vehicle_status_publisher", vehicle_status)
    builder.Connect(telemetry.vehicle_status_output_port(), vehicle_status.get_input_port(0))
    builder.Connect(clock.get_output_port(), vehicle_status.unix_time_input_port())
    builder.Connect(telemetry.state_output_port(), publisher.GetInputPort("state"))
    builder.Connect(telemetry.age_output_port(), publisher.age_input_port())
    builder.Connect(clock.get_output_port(), publisher.unix_time_input_port())
    for port, name in (
        ("state", "state"),
        ("age", "state_age"),
        ("heartbeat_age", "heartbeat_age"),
        ("armed", "armed"),
        ("mode", "mode"),
    ):
        builder.ExportOutput(telemetry.GetOutputPort(port), name)
    diagram = builder.Build()
    diagram.set_name("px4")
    return diagram
