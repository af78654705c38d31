"""Vehicle of PX4, with the messages of the simulated one."""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from ipaddress import IPv4Address
from pathlib import Path

import numpy as np
from lcm import LCM
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Demultiplexer

from splatpilot.diagrams.hardware.real_time import MessagePorts, run_in_real_time
from splatpilot.diagrams.hardware.vehicle import STATUS_PERIOD
from splatpilot.systems.common.drake import vector_output
from splatpilot.systems.common.validation import Config, bounded, require, require_field
from splatpilot.systems.messaging import codecs
from splatpilot.systems.messaging.lcm_ports import DEFAULT_URL, open_lcm
from splatpilot.systems.messaging.receiver import Inbox, UdpConfig, UdpInbox
from splatpilot.systems.px4.commander import Px4Commander, Px4CommanderConfig
from splatpilot.systems.px4.mavlink import OFFBOARD, Mavlink
from splatpilot.systems.px4.motion_capture import MotionCaptureConfig, MotionCaptureReceiver
from splatpilot.systems.px4.telemetry import HEARTBEAT_TIMEOUT, Px4Telemetry
from splatpilot.systems.px4.ulog import LogInbox
from splatpilot.systems.vehicle.quadrotor import GRAVITY

REMINDER = 10.0  # [s] of silence between messages that there is no heartbeat.


@dataclass
class Px4Config(Config):
    """Transport of messages, and requests to PX4."""

    # LCM's URL, of the bridge.
    url: str = DEFAULT_URL
    # Address at which PX4's packets arrive.
    udp: UdpConfig = field(default_factory=lambda: UdpConfig(port=14540))
    # Address of PX4.
    vehicle_host: str = "127.0.0.1"
    # Port at which PX4 listens.
    vehicle_port: int = 14580
    # MAVLink's number of the vehicle.
    system: int = bounded(1, "[1, 255]")
    # [s] Time between looks for messages.
    tick: float = bounded(0.005, "(0, inf) s")
    # Body in motion capture whose pose is sent on to PX4; none if empty.
    body: str = ""
    # OptiTrack's stream of that body; LCM's MOTION_CAPTURE_POSE if left out.
    motion_capture: MotionCaptureConfig | None = None
    commander: Px4CommanderConfig = field(default_factory=Px4CommanderConfig)

    def check(self) -> None:
        UdpConfig(self.vehicle_port, self.vehicle_host).validate()
        named = bool(self.body) or self.motion_capture is None
        require_field(self, "body", named, "a name, which motion_capture needs")
        host, senders = self.vehicle_host, self.udp.senders
        require(host in senders, "udp.senders", f"a list with vehicle_host, {host}", senders)
        is_reached = IPv4Address(host).is_loopback or not IPv4Address(self.udp.host).is_loopback
        condition = "0.0.0.0 or an address that the vehicle reaches"
        require(is_reached, "udp.host", condition, self.udp.host)


def BuildPx4Diagram(
    config: Px4Config, lcm: LCM, inbox: Inbox, now: Callable[[], float] | None = None
) -> Diagram:
    """Builds the diagram between the bridge's messages and PX4. It replaces `BuildVehicleDiagram`,
    except for images, which sensors send themselves.

    .. pydrake_system::

        name: px4
        output_ports: [state, state_age, heartbeat_age, armed, mode, rejected, ended]

    `ended` is that of `Px4Commander`, the others those of `Px4Telemetry`; for `now` see `Receiver`.
    """
    config.validate()
    builder = DiagramBuilder()
    ports = MessagePorts(builder, lcm, config.tick)
    mavlink, address = Mavlink(config.system), (config.vehicle_host, config.vehicle_port)

    # State and status, from PX4 to the bridge.
    telemetry = Px4Telemetry(inbox, mavlink, address, config.tick, now)
    ports.add("telemetry", telemetry)
    state, age = telemetry.GetOutputPort("state"), telemetry.GetOutputPort("age")
    ports.publish_measurement("state", codecs.StateCodec(), state, age)
    vehicle_status = telemetry.GetOutputPort("vehicle_status")
    ports.publish(codecs.VehicleStatusCodec(), vehicle_status, STATUS_PERIOD)

    # Setpoints and mode, from the bridge to PX4.
    by_velocity = config.commander.setpoints == "velocity"
    codec = codecs.VelocitySetpointCodec() if by_velocity else codecs.CommandCodec()
    setpoint = ports.subscribe(codec, name="setpoint")
    status = ports.subscribe(codecs.StatusCodec()).GetOutputPort("status")
    mode = ports.add("status_mode", Demultiplexer([1, codecs.StatusCodec.size - 1]), u0=status)

    # Motion capture, to PX4 and, if it is not from there, to the bridge.
    pose = pose_age = None
    if config.body:
        body = codecs.MotionCaptureCodec(config.body)
        if config.motion_capture is None:
            camera = ports.subscribe(body, name="motion_capture")
        else:
            camera = MotionCaptureReceiver(config.motion_capture, config.tick, now)
            ports.add("motion_capture_receiver", camera)
        pose, pose_age = camera.GetOutputPort(body.port), camera.GetOutputPort("age")
        if config.motion_capture is not None:
            ports.publish_measurement("motion_capture", body, pose, pose_age)

    commander = Px4Commander(config.commander, inbox, mavlink, address, GRAVITY, tick=config.tick)
    names = "heartbeat_age", "armed", "mode", "granted"
    ports.add(
        "commander",
        commander,
        setpoint=setpoint.GetOutputPort(codec.port),
        setpoint_age=setpoint.GetOutputPort("age"),
        bridge_mode=mode.get_output_port(0),
        motion_capture_pose=pose,
        motion_capture_age=pose_age,
        **{name: telemetry.GetOutputPort(name) for name in names},
    )

    for name in ("state", "age", "heartbeat_age", "armed", "mode", "rejected"):
        builder.ExportOutput(telemetry.GetOutputPort(name), "state_age" if name == "age" else name)
    builder.ExportOutput(commander.GetOutputPort("ended"), "ended")
    diagram = builder.Build()
    diagram.set_name("px4")
    return diagram


def run(*, config: Px4Config, duration: float = np.inf, log: Path | None = None) -> None:
    """Connects the bridge and PX4, for `duration` [s], or until it is interrupted; prints changes
    of PX4's mode, and every ten seconds how long there has been no heartbeat. Replays a `log` of
    PX4 in real time instead, if given, and prints `replay_report`."""
    config.validate()
    lcm, epoch, commander = open_lcm(config.url), time.time() - time.monotonic(), config.commander
    inbox = LogInbox(log, config.system, time.monotonic) if log else UdpInbox(config.udp)
    with contextlib.closing(inbox):
        diagram = BuildPx4Diagram(config, lcm, inbox, now=lambda: epoch + time.monotonic())
        simulator = Simulator(diagram)
        root = simulator.get_context()
        address = str(log) if log else f"{config.udp.host}:{inbox.port}"
        print(f"PX4's packets come to {address}.", flush=True)
        for name, is_ours in (("Offboard mode", commander.engage), ("Arming", commander.arm)):
            print(f"{name} is {'requested' if is_ours else 'left to the pilot'}.", flush=True)
        before, reminders, ages = "not heard", 0, []

        def say(text: str) -> None:
            with contextlib.suppress(OSError):  # A closed pipe would end the flight.
                print(text, flush=True)

        def over(now: float) -> bool:
            nonlocal before, reminders
            names = "heartbeat_age", "armed", "mode", "ended"
            age, armed, mode, ended = (vector_output(diagram, name, root) for name in names)
            report = "not heard"
            if age[0] <= HEARTBEAT_TIMEOUT:
                offboard = "in" if mode[0] == OFFBOARD[0] else "not in"
                report = f"heard, {'armed' if armed[0] else 'disarmed'}, {offboard} offboard mode"
            if ended[0]:
                report += "; setpoints have ended, restart this command to fly again"
            if report != before:
                say(f"{now:8.2f} s: PX4 is {report}")
                before = report
            silences = int(min(age[0], now) / REMINDER)
            if silences > reminders:
                silence = f"{silences * REMINDER:g} s at {address}"
                say(f"{now:8.2f} s: no heartbeat for {silence}")
            reminders = silences
            if isinstance(inbox, LogInbox):
                ages.append(vector_output(diagram, "state_age", root)[0])
                return inbox.is_over
            return now >= duration

        run_in_real_time(simulator, diagram, config.tick, over)
        if isinstance(inbox, LogInbox):
            print(replay_report(inbox, ages, vector_output(diagram, "rejected", root)[0]))


def replay_report(inbox: LogInbox, ages: list[float], rejected: float) -> str:
    """Reports on a replayed log: ages of states [s], numbers of rejected messages and of those that
    were sent to PX4, and the difference of velocities and derivatives of positions."""
    known = np.array(ages)[np.isfinite(ages)]
    age = "no state" if known.size == 0 else f"median {np.median(known):.3f}, max {max(known):.3f}"
    sent = ", ".join(f"{name} {count}" for name, count in sorted(inbox.sent.items()))
    error = " ".join(f"{value:.3f}" for value in inbox.velocity_error)
    return (
        f"age of the state [s]: {age}\nrejected messages: {rejected:.0f}\nsent: {sent}\n"
        f"RMS of velocity minus derivative of position, north east down [m/s]: {error}"
    )
