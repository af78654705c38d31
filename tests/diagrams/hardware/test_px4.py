"""The bridge flies a vehicle of PX4: over real MAVLink, with a stand-in for PX4."""

import contextlib
import dataclasses
import re
import socket

import lcm
import numpy as np
import pytest
from natnet_frame import natnet_frame
from px4_stand_in import BOOT, LAND, LOITER, OFFBOARD, POSITION, Px4StandIn
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem
from pymavlink.dialects.v20 import common as dialect

from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware import px4
from splatpilot.diagrams.hardware.bridge import BuildHardwareDiagram, HardwareConfig
from splatpilot.diagrams.hardware.px4 import BuildPx4Diagram, Px4Config
from splatpilot.systems.common.drake import vector_output
from splatpilot.systems.messaging.codecs import MotionCaptureCodec
from splatpilot.systems.messaging.failsafe import FailsafeConfig
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.messaging.lcm_ports import MessagePublisher
from splatpilot.systems.messaging.receiver import UdpConfig, UdpInbox
from splatpilot.systems.px4.commander import Px4CommanderConfig
from splatpilot.systems.px4.motion_capture import MotionCaptureConfig
from splatpilot.systems.vehicle.state import QuadrotorState

START, GOAL = [1.0, 2.0, 2.0], [9.0, 2.0, 2.0]
EPOCH = 1_800_000_000.0  # [s] Unix time when a test begins.
ENGAGED = Px4CommanderConfig(engage=True, arm=True, streaming=1.1)


class Chain:
    """Bridge, PX4's messages and the stand-in, in step; the test advances them."""

    def __init__(
        self,
        world,
        version: str = "1.16",
        commander=ENGAGED,
        body: str = "",
        policy=None,
        hardware: HardwareConfig | None = None,
        motion_capture: bool = False,
    ):
        self.px4 = Px4StandIn(version, START)
        self.inbox = UdpInbox(UdpConfig(port=0))
        self.px4.peer = ("127.0.0.1", self.inbox.port)
        self.lcm = lcm.LCM("memq://")
        scenario = Scenario(policy=policy_named("straight", 1.0), start=START, goal=GOAL)
        config = Px4Config(vehicle_port=self.px4.port, commander=commander, body=body)
        if motion_capture:
            udp = UdpConfig(port=0)
            config.motion_capture = MotionCaptureConfig(udp, body_id=3, version=[4, 0])
        hardware = dataclasses.replace(hardware or HardwareConfig(), tick=0.005)
        self.bridge = BuildHardwareDiagram(scenario, world, self.lcm, hardware, policy=policy)
        self.link = BuildPx4Diagram(config, self.lcm, self.inbox)
        self.simulators = {"bridge": Simulator(self.bridge), "link": Simulator(self.link)}
        for simulator in self.simulators.values():
            clock = simulator.get_system().GetSubsystemByName("clock")
            clock.set_epoch(simulator.get_mutable_context(), EPOCH)
        self.alive, self.now = {"bridge", "link"}, 0.0
        self.sees = dict(body=3) if motion_capture else None
        self.cameras = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def advance(self, duration: float) -> None:
        until = self.now + duration
        while self.now < until - 1e-9:
            self.now += 0.01
            if self.sees is not None:
                self._see(**self.sees)
            for name in sorted(self.alive):
                self.simulators[name].AdvanceTo(self.now)
            self.px4.step(self.now)

    def _see(self, body: int, tracked: bool = True) -> None:
        """Sends a frame of 100 Hz in which cameras, whose y is up, see PX4's vehicle."""
        (x, y, z), q = self.px4.state[:3], self.px4.state[6:10]
        frame = natnet_frame(
            round(100 * self.now), body, [x, z, -y], [q[1], q[3], -q[2], q[0]], tracked
        )
        receiver = self.link.GetSubsystemByName("motion_capture_receiver")
        self.cameras.sendto(frame, ("127.0.0.1", receiver.port))

    def mode(self) -> tuple[float, float]:
        return tuple(self.out("status")[:2])

    def out(self, name: str) -> np.ndarray:
        """An output of the bridge."""
        return vector_output(self.bridge, name, self.simulators["bridge"].get_context())


@pytest.fixture
def chain(post_world):
    with contextlib.ExitStack() as stack:

        def make(*args, **kwargs) -> Chain:
            made = Chain(post_world, *args, **kwargs)
            for closed in (made.px4.socket, made.cameras, made.inbox):
                stack.callback(closed.close)
            return made

        yield make


@pytest.fixture
def flight(chain) -> Chain:
    """A flight in offboard mode."""
    flight = chain()
    flight.advance(4.0)
    assert flight.px4.mode == OFFBOARD and flight.px4.armed
    return flight


@pytest.mark.parametrize(
    ("version", "setpoints"), [("1.16", "velocity"), ("1.18", "velocity"), ("1.18", "body_rates")]
)
def test_px4_flies_along_the_policys_velocity(chain, version, setpoints):
    flight = chain(version, dataclasses.replace(ENGAGED, setpoints=setpoints))
    flight.advance(5.0)
    assert (flight.px4.mode, flight.px4.armed) == (OFFBOARD, True)
    assert not flight.px4.refused
    assert all(accepted for _, accepted in flight.px4.answers)
    p, v = flight.px4.state[:3], flight.px4.state[3:6]
    assert p[0] > START[0] + 1.0
    np.testing.assert_allclose(p[1:], START[1:], atol=0.1)
    np.testing.assert_allclose(v, [1.0, 0.0, 0.0], atol=0.1)


def test_nothing_arms_or_flies_by_default(chain):
    flight = chain(commander=Px4CommanderConfig())
    flight.advance(4.0)
    assert not flight.px4.answers
    assert (flight.px4.mode, flight.px4.armed) == (POSITION, False)
    assert flight.px4.heard.count("SET_POSITION_TARGET_LOCAL_NED") > 100
    np.testing.assert_array_equal(flight.px4.state[:3], START)


@pytest.mark.parametrize(("version", "refusals"), [("1.16", 1), ("1.18", 0)])
def test_a_request_that_px4_denies_is_repeated(chain, version, refusals):
    flight = chain(version, dataclasses.replace(ENGAGED, streaming=0.5))
    flight.advance(3.0)
    assert [accepted for _, accepted in flight.px4.answers].count(False) == refusals
    assert flight.px4.mode == OFFBOARD


def test_if_the_bridge_dies_the_vehicle_holds(flight):
    flight.alive.remove("bridge")
    flight.advance(0.4)
    assert (flight.px4.mode, np.linalg.norm(flight.px4.velocity)) == (OFFBOARD, 0.0)
    flight.advance(1.2)
    assert flight.px4.mode == LOITER
    flight.advance(1.5)
    assert np.linalg.norm(flight.px4.state[3:6]) < 0.1
    flight.alive.add("bridge")
    flight.advance(2.0)
    assert flight.px4.mode == LOITER


def test_if_the_link_dies_px4_holds_by_itself(flight):
    flight.alive.clear()
    flight.advance(0.8)
    assert flight.px4.mode == OFFBOARD
    flight.advance(2.0)
    assert flight.px4.mode == LOITER
    assert np.linalg.norm(flight.px4.state[3:6]) < 0.1


@pytest.mark.parametrize(
    ("setpoints", "silent"),
    [("velocity", 0.05), ("velocity", 0.25), ("velocity", 0.6), ("body_rates", 0.35)],
)
def test_a_pilot_who_takes_over_keeps_the_vehicle(chain, setpoints, silent):
    flight = chain(commander=dataclasses.replace(ENGAGED, setpoints=setpoints))
    flight.advance(4.05)
    requests = len(flight.px4.answers)
    flight.alive.remove("bridge")
    flight.advance(silent)
    assert flight.px4.mode == OFFBOARD
    flight.px4.mode = POSITION
    flight.advance(1.5)
    flight.alive.add("bridge")
    flight.advance(1.5)
    assert flight.px4.mode == POSITION
    assert len(flight.px4.answers) == requests


def test_a_pilot_who_leaves_offboard_mode_at_once_keeps_the_vehicle(chain):
    flight = chain()
    while (dialect.MAV_CMD_DO_SET_MODE, True) not in flight.px4.answers:
        flight.advance(0.01)
    flight.px4.mode = POSITION
    flight.advance(3.0)
    assert flight.px4.mode == POSITION
    assert flight.px4.answers == [(dialect.MAV_CMD_DO_SET_MODE, True)]


STATES = {"LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"}
HASTY = HardwareConfig(failsafe=FailsafeConfig(patience=2.0))


def test_a_pilot_who_takes_over_from_a_landing_keeps_the_vehicle(chain):
    flight = chain(hardware=HASTY)
    flight.advance(4.0)
    flight.px4.muted = STATES
    while flight.mode()[0] != status.LANDING:
        flight.advance(0.01)
    flight.advance(0.3)
    assert flight.px4.mode == OFFBOARD
    requests = len(flight.px4.answers)
    flight.px4.mode = POSITION
    flight.advance(2.5)
    assert flight.px4.mode == POSITION
    assert len(flight.px4.answers) == requests


@pytest.mark.parametrize(
    ("muted", "mode"), [(STATES, LAND), (STATES | {"HEARTBEAT", "TIMESYNC"}, OFFBOARD)]
)
def test_if_px4_falls_silent_the_bridge_stops_and_lands(chain, muted, mode):
    flight = chain(hardware=HASTY)
    flight.advance(4.0)
    flight.px4.muted = muted
    flight.advance(1.0)
    assert flight.mode() == (status.HOLDING, status.STATE_OLD)
    assert np.linalg.norm(flight.px4.velocity) == 0.0
    flight.advance(3.0)
    assert flight.px4.mode == mode
    np.testing.assert_allclose(flight.px4.state[3:6], [0.0, 0.0, -0.5], atol=0.1)


@pytest.mark.parametrize(("setpoints", "delay"), [("velocity", 0.1), ("body_rates", 0.06)])
def test_states_that_are_late_are_brought_up_to_date(chain, setpoints, delay):
    commander = dataclasses.replace(ENGAGED, setpoints=setpoints)
    flight = chain(policy=Circle(2.0, "waypoint"), commander=commander)
    flight.px4.delay = delay
    flight.advance(5.0)
    for _ in range(100):
        flight.advance(0.01)
        assert np.linalg.norm(flight.px4.state[3:6]) == pytest.approx(2.0, abs=0.2)
        assert np.linalg.norm(flight.out("state")[:3] - flight.px4.state[:3]) < 0.05
        assert flight.out("status")[2] > delay


@pytest.mark.parametrize("sees", [None, {"body": 8}, {"body": 3, "tracked": False}])
def test_if_motion_capture_loses_the_body_the_bridge_stops(chain, sees):
    flight = chain(body="starling", hardware=HardwareConfig(body="starling"), motion_capture=True)
    flight.advance(4.0)
    assert flight.mode()[0] == status.FLYING
    sent = len(flight.px4.odometry)
    assert sent == pytest.approx(200, abs=3)
    flight.sees = sees
    flight.advance(0.26)
    assert flight.mode()[0] == status.FLYING
    flight.advance(0.06)
    assert flight.mode() == (status.HOLDING, status.BODY_LOST)
    flight.advance(0.02)
    assert np.linalg.norm(flight.px4.velocity) == 0.0
    flight.advance(2.0)
    assert np.linalg.norm(flight.px4.state[3:6]) < 0.1
    assert len(flight.px4.odometry) <= sent + 1
    assert np.isfinite([[m.x, m.y, m.z, *m.q] for m in flight.px4.odometry]).all()


def test_px4_learns_our_clock_and_when_cameras_exposed(chain):
    flight = chain(body="starling", motion_capture=True)
    flight.advance(2.0)
    assert np.abs(np.array(flight.px4.offsets) + BOOT + EPOCH).max() < 0.01
    exposed = np.diff([m.time_usec for m in flight.px4.odometry])
    assert (exposed >= 15_000).all()
    newest = 1e-6 * flight.px4.odometry[-1].time_usec - EPOCH
    assert 0.01 <= flight.now - newest <= 0.01 + 0.04


def test_motion_capture_of_lcm_is_sent_on(chain):
    flight = chain(body="starling")
    codec = MotionCaptureCodec("starling")
    publisher = MessagePublisher(flight.lcm, codec, 1.0)
    context = publisher.CreateDefaultContext()
    publisher.GetInputPort(codec.port).FixValue(context, np.array([1.0, 2, 3, 1, 0, 0, 0]))
    flight.advance(0.1)
    assert not flight.px4.odometry
    publisher.GetInputPort("unix_time").FixValue(context, [EPOCH + flight.now])
    publisher.ForcedPublish(context)
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
    flight.advance(5.0)
    for _ in range(20):
        flight.advance(0.2)
        state = QuadrotorState.of(flight.px4.state)
        along = np.arctan2(state.v_WB[1], state.v_WB[0])
        assert np.linalg.norm(state.v_WB[:2]) == pytest.approx(0.8, abs=0.1)
        assert np.cos(along - state.heading) > np.cos(np.radians(10.0))


def test_a_vehicle_below_its_fence_is_armed_and_takes_off_into_it(chain):
    flight = chain()
    flight.px4.state[2] = -0.3
    flight.advance(3.0)
    assert (flight.px4.mode, flight.px4.armed) == (OFFBOARD, True)
    flight.advance(4.0)
    assert flight.mode()[0] == status.FLYING
    assert flight.px4.state[2] > 0.35


def test_the_process_prints_its_limits_and_missing_heartbeats(udp_url, capsys, monkeypatch):
    monkeypatch.setattr(px4, "REMINDER", 0.1)
    px4.run(config=Px4Config(url=udp_url, udp=UdpConfig(port=0)), duration=0.35)
    printed = capsys.readouterr().out
    assert "Offboard mode is left to the pilot." in printed
    assert "Arming is left to the pilot." in printed
    reminders = re.findall(r"no heartbeat for (\S+) s at 127\.0\.0\.1:\d+$", printed, re.M)
    assert reminders == ["0.1", "0.2", "0.3"]


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--arm"], "arm must be false without engage"),
        (["--set", "motion_capture={}"], "body must be a name, which motion_capture needs"),
        (["--set", "udp.senders=[drone]"], "senders must be an IPv4 address"),
        (["--set", "system=0"], "system must be in [1, 255], got 0"),
        (["--lcm-url", "tcp://there"], "must begin with udpm://"),
    ],
)
def test_invalid_input_is_an_error_before_anything_is_sent(words, why, capsys):
    assert main(["hardware", "px4", *words]) == 1
    assert why in capsys.readouterr().err


def test_a_port_that_is_taken_is_an_error(udp_url):
    inbox = UdpInbox(UdpConfig(port=0))
    with contextlib.closing(inbox), pytest.raises(OSError, match="Address already in use"):
        px4.run(config=Px4Config(url=udp_url, udp=UdpConfig(port=inbox.port)))
