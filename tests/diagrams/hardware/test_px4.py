"""The bridge flies a vehicle of PX4: over real MAVLink, with a stand-in for PX4."""

import contextlib
import dataclasses
import functools
import re
import socket

import lcm
import numpy as np
import pytest
from harness import Harness, natnet_frame
from px4_stand_in import BOOT, LAND, LOITER, OFFBOARD, POSITION, Px4StandIn
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem
from ulog_writer import write_log

from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware import px4
from splatpilot.diagrams.hardware.bridge import BuildHardwareDiagram, HardwareConfig
from splatpilot.diagrams.hardware.px4 import BuildPx4Diagram, Px4Config, replay_report
from splatpilot.systems.common.drake import vector_output
from splatpilot.systems.messaging.codecs import MotionCaptureCodec
from splatpilot.systems.messaging.failsafe import FailsafeConfig
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.messaging.lcm_ports import MessagePublisher
from splatpilot.systems.messaging.receiver import UdpConfig, UdpInbox
from splatpilot.systems.px4.commander import Px4CommanderConfig
from splatpilot.systems.px4.motion_capture import MotionCaptureConfig
from splatpilot.systems.px4.ulog import LogInbox
from splatpilot.systems.vehicle.state import QuadrotorState

START, GOAL = [1.0, 2.0, 2.0], [9.0, 2.0, 2.0]
EPOCH = 1_800_000_000.0  # [s] Unix time when a test begins.
ENGAGED = Px4CommanderConfig(engage=True, arm=True, streaming=0.1)


class Steps:
    """Simulations of diagrams in step; the test advances them."""

    def __init__(self, **diagrams):
        self.diagrams, self.alive, self.now = diagrams, set(diagrams), 0.0
        self.simulators = {name: Simulator(diagram) for name, diagram in diagrams.items()}
        for name, diagram in diagrams.items():
            root = self.simulators[name].get_mutable_context()
            diagram.GetSubsystemByName("clock").set_epoch(root, EPOCH)

    def advance(self, duration: float) -> None:
        for _ in range(round(duration / 0.01)):
            self.now += 0.01
            self.step()

    def step(self) -> None:
        for name in sorted(self.alive):
            self.simulators[name].AdvanceTo(self.now)

    def out(self, port: str, diagram: str = "bridge") -> np.ndarray:
        root = self.simulators[diagram].get_context()
        return vector_output(self.diagrams[diagram], port, root)

    def mode(self) -> tuple[float, float]:
        return tuple(self.out("status")[:2])


class Chain(Steps):
    """Bridge, PX4's messages and the stand-in."""

    def __init__(
        self, world, version="1.18", commander=ENGAGED, body="", policy=None, hardware=None, sees=""
    ):
        self.px4, self.inbox = Px4StandIn(version, START), UdpInbox(UdpConfig(port=0))
        self.px4.peer, self.lcm = ("127.0.0.1", self.inbox.port), lcm.LCM("memq://")
        scenario = Scenario(policy=policy_named("straight", 1.0), start=START, goal=GOAL)
        config = Px4Config(vehicle_port=self.px4.port, commander=commander, body=body, tick=0.01)
        if sees:
            config.motion_capture = MotionCaptureConfig(UdpConfig(port=0), 3, version=[4, 0])
        hardware = dataclasses.replace(hardware or HardwareConfig(), tick=0.01)
        bridge = BuildHardwareDiagram(scenario, world, self.lcm, hardware, policy=policy)
        super().__init__(bridge=bridge, link=BuildPx4Diagram(config, self.lcm, self.inbox))
        self.sees, self.cameras = sees, socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def step(self) -> None:
        if self.sees:  # Cameras, whose y is up, see PX4's vehicle or nothing.
            (x, y, z), q = self.px4.state[:3], self.px4.state[6:10]
            pose = [x, z, -y], [q[1], q[3], -q[2], q[0]]
            frame = natnet_frame(round(100 * self.now), 3, *pose, self.sees == "body")
            receiver = self.diagrams["link"].GetSubsystemByName("motion_capture_receiver")
            self.cameras.sendto(frame, ("127.0.0.1", receiver.port))
        super().step()
        self.px4.step(self.now)


@pytest.fixture
def chain(post_world):
    with contextlib.ExitStack() as stack:

        def make(*args, **kwargs) -> Chain:
            made = Chain(post_world, *args, **kwargs)
            for closed in (made.px4.socket, made.cameras, made.inbox):
                stack.callback(closed.close)
            return made

        yield make


def take_off(flight: Chain, duration: float = 2.0) -> Chain:
    flight.advance(duration)
    assert flight.px4.mode == OFFBOARD and flight.px4.armed
    return flight


@pytest.mark.parametrize(
    ("version", "setpoints", "streaming", "denied"),
    [("1.16", "velocity", 1.1, 0), ("1.16", "velocity", 0.5, 1), ("1.18", "body_rates", 0.1, 0)],
)
def test_px4_flies_along_the_policys_velocity(chain, version, setpoints, streaming, denied):
    commander = dataclasses.replace(ENGAGED, setpoints=setpoints, streaming=streaming)
    flight = take_off(chain(version, commander), 3.0)
    flight.advance(1.0)
    assert not flight.px4.refused
    assert [accepted for _, accepted in flight.px4.answers].count(False) == denied
    p, v = flight.px4.state[:3], flight.px4.state[3:6]
    assert p[0] > START[0] + 1.0
    np.testing.assert_allclose(p[1:], START[1:], atol=0.1)
    np.testing.assert_allclose(v, [1.0, 0.0, 0.0], atol=0.1)


def test_nothing_arms_or_flies_by_default(chain):
    flight = chain(commander=Px4CommanderConfig())
    flight.advance(2.0)
    assert (flight.px4.answers, flight.px4.mode, flight.px4.armed) == ([], POSITION, False)
    assert flight.px4.heard.count("SET_POSITION_TARGET_LOCAL_NED") > 50


def test_if_the_bridge_dies_the_vehicle_holds(chain):
    flight = take_off(chain())
    flight.alive.remove("bridge")
    flight.advance(0.4)
    assert (flight.px4.mode, np.linalg.norm(flight.px4.velocity)) == (OFFBOARD, 0.0)
    flight.advance(1.6)
    assert flight.px4.mode == LOITER
    assert np.linalg.norm(flight.px4.state[3:6]) < 0.1
    flight.alive.add("bridge")
    flight.advance(1.2)
    assert flight.px4.mode == LOITER


@pytest.mark.parametrize(
    ("setpoints", "silent"), [("velocity", 0.25), ("velocity", 0.6), ("body_rates", 0.35)]
)
def test_a_pilot_who_takes_over_keeps_the_vehicle(chain, setpoints, silent):
    flight = take_off(chain(commander=dataclasses.replace(ENGAGED, setpoints=setpoints)))
    flight.advance(0.05)
    requests = len(flight.px4.answers)
    flight.alive.remove("bridge")
    flight.advance(silent)
    assert flight.px4.mode == OFFBOARD
    flight.px4.mode = POSITION
    flight.advance(1.2)
    flight.alive.add("bridge")
    flight.advance(1.2)
    assert flight.px4.mode == POSITION
    assert len(flight.px4.answers) == requests


STATES = {"LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"}


@pytest.mark.parametrize(
    ("muted", "pilot", "mode"),
    [
        (STATES, None, LAND),
        (STATES | {"HEARTBEAT", "TIMESYNC"}, None, OFFBOARD),
        (STATES, POSITION, POSITION),
    ],
)
def test_if_px4_falls_silent_the_bridge_stops_and_lands_until_a_pilot_takes_over(
    chain, muted, pilot, mode
):
    flight = take_off(chain(hardware=HardwareConfig(failsafe=FailsafeConfig(patience=1.0))))
    flight.px4.muted = muted
    flight.advance(0.7)
    assert flight.mode() == (status.HOLDING, status.STATE_OLD)
    assert np.linalg.norm(flight.px4.velocity) == 0.0
    while flight.mode()[0] != status.LANDING:
        flight.advance(0.01)
    flight.advance(0.3)
    assert flight.px4.mode == OFFBOARD
    requests = len(flight.px4.answers)
    flight.px4.mode = pilot or OFFBOARD
    flight.advance(1.5)
    assert flight.px4.mode == mode
    if pilot:
        assert len(flight.px4.answers) == requests
    else:
        np.testing.assert_allclose(flight.px4.state[3:6], [0.0, 0.0, -0.5], atol=0.1)


@pytest.mark.parametrize(("setpoints", "delay"), [("velocity", 0.1), ("body_rates", 0.04)])
def test_states_that_are_late_are_brought_up_to_date(chain, setpoints, delay):
    commander = dataclasses.replace(ENGAGED, setpoints=setpoints)
    flight = chain(policy=Circle(2.0, "waypoint"), commander=commander)
    flight.px4.delay = delay
    flight.advance(4.0)
    for _ in range(50):
        flight.advance(0.01)
        assert np.linalg.norm(flight.px4.state[3:6]) == pytest.approx(2.0, abs=0.2)
        assert np.linalg.norm(flight.out("state")[:3] - flight.px4.state[:3]) < 0.05
        assert flight.out("status")[2] > delay


def test_if_motion_capture_loses_the_body_the_bridge_stops(chain):
    hardware = HardwareConfig(body="starling")
    flight = take_off(chain(body="starling", hardware=hardware, sees="body"))
    assert flight.mode()[0] == status.FLYING
    sent = len(flight.px4.odometry)
    assert sent == pytest.approx(100, abs=3)
    flight.sees = "nothing"
    flight.advance(0.26)
    assert flight.mode()[0] == status.FLYING
    flight.advance(0.06)
    assert flight.mode() == (status.HOLDING, status.BODY_LOST)
    flight.advance(0.02)
    assert np.linalg.norm(flight.px4.velocity) == 0.0
    flight.advance(1.0)
    assert np.linalg.norm(flight.px4.state[3:6]) < 0.1
    assert len(flight.px4.odometry) <= sent + 1
    assert np.isfinite([[m.x, m.y, m.z, *m.q] for m in flight.px4.odometry]).all()


def test_px4_learns_our_clock_and_when_cameras_exposed(chain):
    flight = chain(body="starling", sees="body")
    flight.advance(1.0)
    assert np.abs(np.array(flight.px4.offsets) + BOOT + EPOCH).max() < 0.01
    exposed = np.diff([m.time_usec for m in flight.px4.odometry])
    assert (exposed >= 15_000).all()
    newest = 1e-6 * flight.px4.odometry[-1].time_usec - EPOCH
    assert 0.01 <= flight.now - newest <= 0.01 + 0.04


def test_motion_capture_of_lcm_is_sent_on(chain):
    flight = chain(body="starling")
    publisher = Harness(MessagePublisher(flight.lcm, MotionCaptureCodec("starling"), 1.0))
    flight.advance(0.1)
    assert not flight.px4.odometry
    publisher.give(motion_capture_pose=[1.0, 2, 3, 1, 0, 0, 0], unix_time=EPOCH + flight.now)
    publisher.system.ForcedPublish(publisher.context)
    flight.advance(0.4)
    (odometry,) = flight.px4.odometry
    assert (odometry.x, odometry.y, odometry.z) == (1.0, -2.0, -3.0)
    assert odometry.time_usec == pytest.approx(1e6 * (EPOCH + 0.1), abs=2)


class Circle(LeafSystem):
    """A policy that flies around the post."""

    def __init__(self, speed: float, decision: str):
        super().__init__()
        self.speed = speed
        self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorOutputPort(decision, 3, self._calc)

    def _calc(self, context, output) -> None:
        p_WB = self.get_input_port().Eval(context)[:3]
        from_post = p_WB - [5.0, 0.0, p_WB[2]]
        distance = np.linalg.norm(from_post)
        out_W = from_post / distance
        velocity = self.speed * np.cross(out_W, [0.0, 0.0, 1.0]) + (2.0 - distance) * out_W
        velocity[2] = 2.0 - p_WB[2]
        is_waypoint = self.HasOutputPort("waypoint")
        output.set_value(p_WB + 0.4 * velocity if is_waypoint else velocity)


@pytest.mark.parametrize(
    ("decision", "speed", "max_speed"), [("waypoint", 0.8, 6.0), ("velocity", 1.6, 0.8)]
)
def test_over_velocities_the_camera_looks_along_a_curve(chain, decision, speed, max_speed):
    hardware = HardwareConfig(failsafe=FailsafeConfig(limits=FlightLimits(max_speed=max_speed)))
    flight = chain(policy=Circle(speed, decision), hardware=hardware)
    flight.advance(4.0)
    for _ in range(5):
        flight.advance(0.3)
        state = QuadrotorState.of(flight.px4.state)
        along = np.arctan2(state.v_WB[1], state.v_WB[0])
        assert np.linalg.norm(state.v_WB[:2]) == pytest.approx(0.8, abs=0.1)
        assert np.cos(along - state.heading) > np.cos(np.radians(10.0))


def test_the_process_prints_its_limits_and_missing_heartbeats(udp_url, capsys, monkeypatch):
    monkeypatch.setattr(px4, "REMINDER", 0.1)
    px4.run(config=Px4Config(url=udp_url, udp=UdpConfig(port=0)), duration=0.35)
    printed = capsys.readouterr().out
    assert all(f"{what} is left to the pilot." in printed for what in ("Offboard mode", "Arming"))
    reminders = re.findall(r"no heartbeat for (\S+) s at 127\.0\.0\.1:\d+$", printed, re.M)
    assert reminders == ["0.1", "0.2", "0.3"]


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("--arm", "arm must be false without engage"),
        ("--set motion_capture={}", "body must be a name, which motion_capture needs"),
        ("--set system=0", "system must be in [1, 255], got 0"),
        ("--set vehicle_host=127.0.1", "host must be an IPv4 address, as 127.0.0.1, got 127.0.1"),
        ("--set vehicle_host=192.168.8.1", "udp.senders must be a list with vehicle_host, 192."),
        (
            "--set vehicle_host=192.168.8.1 --set udp.senders=[192.168.8.1]",
            "udp.host must be 0.0.0.0 or an address that the vehicle reaches, got 127.0.0.1",
        ),
        ("--lcm-url tcp://there", "must begin with udpm://"),
        ("--replay flight.ulg", "flight.ulg must be a ULog"),
    ],
)
def test_invalid_input_is_an_error_before_anything_is_sent(
    words, why, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flight.ulg").write_bytes(b"no log")
    assert main(["hardware", "px4", *words.split()]) == 1
    assert why in capfd.readouterr().err


VELOCITY = (0.5, 0.0, 0.0)


class Replay(Steps):
    """Bridge and PX4's messages, of a log."""

    def __init__(self, path, world, velocity, **kwargs):
        write_log(path, velocity, **kwargs)
        self.inbox, memory = LogInbox(path, 1, lambda: self.now), lcm.LCM("memq://")
        scenario = Scenario(policy=policy_named("straight", 1.0), goal=GOAL)
        bridge = BuildHardwareDiagram(scenario, world, memory)
        super().__init__(bridge=bridge, link=BuildPx4Diagram(Px4Config(), memory, self.inbox))


@pytest.fixture
def replay(tmp_path, post_world):
    return functools.partial(Replay, tmp_path / "flight.ulg", post_world)


def test_the_state_of_a_log_reaches_the_bridge_whose_setpoints_are_counted(replay):
    flight = replay(VELOCITY)
    flight.advance(2.5)
    state = flight.out("state")
    # The first message of a type may come up to a period after PX4 sent it.
    np.testing.assert_allclose(state[:3], [2.25, 2.0, 2.0], atol=0.02)
    np.testing.assert_allclose(state[3:10], [0.5, 0, 0, 1, 0, 0, 0], atol=0.01)
    assert flight.mode()[0] == status.FLYING
    assert tuple(flight.out("mode", "link")) == (6.0, 0.0) and flight.out("armed", "link")
    assert 0.0 <= flight.out("state_age", "link")[0] <= 0.13
    assert flight.inbox.sent["SET_POSITION_TARGET_LOCAL_NED"] > 100
    assert not flight.inbox.is_over
    flight.advance(0.6)
    assert flight.inbox.is_over and flight.out("rejected", "link")[0] == 0
    report = replay_report(flight.inbox, [np.inf, 0.02, 0.1], 0.0)
    assert "median 0.060, max 0.100" in report and "0.000 0.000 0.000" in report


def test_velocities_that_do_not_fit_the_positions_are_a_jump(replay):
    flight = replay((-0.5, 0.0, 0.0))
    np.testing.assert_allclose(flight.inbox.velocity_error, [1.0, 0.0, 0.0], atol=1e-3)
    flight.advance(2.5)
    assert flight.mode() == (status.HOLDING, status.STATE_JUMPED)


def test_invalid_positions_are_not_sent_and_other_modes_are_not_offboard(replay):
    flight = replay(VELOCITY, nav_state=2, valid=lambda time: time < 1.0)
    flight.advance(2.0)
    assert flight.mode() == (status.HOLDING, status.STATE_OLD)
    assert flight.out("mode", "link")[0] not in (0.0, 6.0)
