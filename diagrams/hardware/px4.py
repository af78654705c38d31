"""A vehicle that PX4 flies, behind the messages of the simulated one."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from lcm import LCM
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import Demultiplexer

from splatpilot.diagrams.hardware.real_time import run_in_real_time
from splatpilot.diagrams.hardware.vehicle import STATUS_PERIOD
from splatpilot.systems.messaging.bridge_status import UnixClock
from splatpilot.systems.messaging.codecs import (
    Codec,
    CommandCodec,
    MotionCaptureCodec,
    StateCodec,
    StatusCodec,
    VehicleStatusCodec,
    VelocitySetpointCodec,
)
from splatpilot.systems.messaging.lcm_ports import (
    DEFAULT_URL,
    MeasurementPublisher,
    MessagePublisher,
    MessageSubscriber,
    open_lcm,
)
from splatpilot.systems.messaging.receiver import UdpConfig, UdpInbox
from splatpilot.systems.px4.commander import Px4Commander, Px4CommanderConfig
from splatpilot.systems.px4.mavlink import OFFBOARD, Mavlink
from splatpilot.systems.px4.motion_capture import MotionCaptureConfig, MotionCaptureReceiver
from splatpilot.systems.px4.telemetry import HEARTBEAT_TIMEOUT, Px4Telemetry
from splatpilot.systems.vehicle.quadrotor import GRAVITY


@dataclass
class Px4Config:
    """Where messages travel, and what PX4 is asked for."""

    # LCM's URL, where the bridge is.
    url: str = DEFAULT_URL
    # Where PX4's packets come to.
    udp: UdpConfig = field(default_factory=lambda: UdpConfig(port=14540))
    # Address of PX4.
    vehicle_host: str = "127.0.0.1"
    # Port at which PX4 listens.
    vehicle_port: int = 14580
    # MAVLink's number of the vehicle.
    system: int = 1
    # [s] Time between looks at what has come.
    tick: float = 0.005
    # The body in motion capture whose pose is sent on to PX4; none where empty.
    body: str = ""
    # OptiTrack's stream, which is sent on as that body; LCM's MOTION_CAPTURE_POSE where left out.
    motion_capture: MotionCaptureConfig | None = None
    commander: Px4CommanderConfig = field(default_factory=Px4CommanderConfig)

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        self.udp.validate("px4.udp")
        UdpConfig(self.vehicle_port, self.vehicle_host).validate("px4.vehicle")
        if not 1 <= self.system <= 255:
            raise ValueError(f"px4.system is {self.system}; it must be 1 to 255")
        if not 0.0 < self.tick < math.inf:
            raise ValueError(
                f"px4.tick must be finite and > 0 s, got {self.tick}; by default it is "
                f"{Px4Config.tick}"
            )
        self.commander.validate()
        if self.motion_capture is not None:
            self.motion_capture.validate()
            if not self.body:
                raise ValueError("px4.motion_capture has no px4.body; name the body for the bridge")


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

    builder.Connect(clock.get_output_port(), telemetry.GetInputPort("unix_time"))

    def add_subscriber(name: str, codec: Codec) -> tuple[OutputPort, OutputPort]:
        subscriber = MessageSubscriber(lcm, codec, config.tick)
        builder.AddNamedSystem(f"{name}_subscriber", subscriber)
        builder.Connect(clock.get_output_port(), subscriber.GetInputPort("unix_time"))
        return subscriber.GetOutputPort(codec.port), subscriber.GetOutputPort("age")

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
            pose, age = eye.GetOutputPort("motion_capture_pose"), eye.GetOutputPort("age")
            sender = MeasurementPublisher(lcm, codec, config.tick)
            builder.AddNamedSystem("motion_capture_publisher", sender)
            builder.Connect(pose, sender.GetInputPort(codec.port))
            builder.Connect(age, sender.GetInputPort("age"))
            builder.Connect(clock.get_output_port(), sender.GetInputPort("unix_time"))
            builder.Connect(clock.get_output_port(), eye.GetInputPort("unix_time"))
        builder.Connect(pose, commander.GetInputPort("motion_capture_pose"))
        builder.Connect(age, commander.GetInputPort("motion_capture_age"))

    vehicle_status = MessagePublisher(lcm, VehicleStatusCodec(), STATUS_PERIOD)
    builder.AddNamedSystem("vehicle_status_publisher", vehicle_status)
    builder.Connect(telemetry.GetOutputPort("vehicle_status"), vehicle_status.get_input_port(0))
    builder.Connect(clock.get_output_port(), vehicle_status.GetInputPort("unix_time"))
    builder.Connect(telemetry.GetOutputPort("state"), publisher.GetInputPort("state"))
    builder.Connect(telemetry.GetOutputPort("age"), publisher.GetInputPort("age"))
    builder.Connect(clock.get_output_port(), publisher.GetInputPort("unix_time"))
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


REMINDER = 10.0
"""[s] of silence after each of which it says that there is no heartbeat."""


def run(*, config: Px4Config, duration: float = np.inf) -> None:
    """
    Stands between the bridge and PX4, for `duration` [s], or until it is interrupted.

    It says when PX4 is heard, armed, and in offboard mode, and when it is not any more; and every
    ten seconds how long there has been no heartbeat.

    Raises:
        ValueError: for a configuration out of range.
        OSError: if LCM does not work or the port is in use.
        ModuleNotFoundError: where pymavlink is not installed.
    """
    config.validate()
    lcm, inbox = open_lcm(config.url), UdpInbox(config.udp)
    try:
        epoch = time.time() - time.monotonic()
        diagram = BuildPx4Diagram(config, lcm, inbox, now=lambda: epoch + time.monotonic())
        simulator = Simulator(diagram)
        root = simulator.get_context()
        asked = config.commander
        print(f"PX4's packets come to {config.udp.host}:{inbox.port}.", flush=True)
        for what, is_asked in (("Offboard mode", asked.engage), ("Arming", asked.arm)):
            print(f"{what} is {'asked for' if is_asked else 'left to the pilot'}.", flush=True)
        before, reminders = (False, False, False), 0

        def over(now: float) -> bool:
            nonlocal before, reminders
            age, armed, mode = (
                np.asarray(diagram.GetOutputPort(name).Eval(root))
                for name in ("heartbeat_age", "armed", "mode")
            )
            is_so = bool(age[0] <= HEARTBEAT_TIMEOUT), bool(armed[0]), mode[0] == OFFBOARD[0]
            if is_so != before:
                heard, armed_so, offboard = is_so
                what = (
                    f"heard, {'armed' if armed_so else 'disarmed'}, "
                    f"{'in' if offboard else 'not in'} offboard mode"
                )
                print(f"{now:8.2f} s: PX4 is {what if heard else 'not heard'}", flush=True)
                before = is_so
            silences = int(min(age[0], now) / REMINDER)
            if silences > reminders:
                print(
                    f"{now:8.2f} s: no heartbeat for {silences * REMINDER:g} s at "
                    f"{config.udp.host}:{inbox.port}",
                    flush=True,
                )
            reminders = silences
            return now >= duration

        run_in_real_time(simulator, diagram, config.tick, over)
    finally:
        inbox.close()
