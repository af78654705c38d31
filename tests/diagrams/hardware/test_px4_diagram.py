"""The bridge flies what PX4 flies: over real MAVLink, with a stand-in for PX4."""

import dataclasses
import socket

import lcm
import numpy as np
import pytest
from natnet_frame import natnet_frame
from px4_stand_in import BOOT, LAND, LOITER, OFFBOARD, POSITION, Px4StandIn
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem
from pymavlink.dialects.v20 import common as dialect

from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware.bridge import BuildHardwareDiagram, HardwareConfig
from splatpilot.diagrams.hardware.px4 import BuildPx4Diagram, Px4Config
from splatpilot.systems.messaging.codecs import MotionCaptureCodec
from splatpilot.systems.messaging.failsafe import FailsafeConfig
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.generated import lcmt_bridge_status
from splatpilot.systems.messaging.lcm_ports import MessagePublisher
from splatpilot.systems.messaging.receiver import UdpConfig, UdpInbox
from splatpilot.systems.px4.commander import Px4CommanderConfig
from splatpilot.systems.px4.motion_capture import MotionCaptureConfig
from splatpilot.systems.vehicle.state import QuadrotorState

START, GOAL = [1.0, 2.0, 2.0], [9.0, 2.0, 2.0]
EPOCH = 1_800_000_000.0  # [s] Unix time when a test begins.
ENGAGED = Px4CommanderConfig(engage=True, arm=True)


class Chain:
    """Bridge, PX4's messages and the stand-in, in step; the test says how far."""

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
        self.bridge = BuildHardwareDiagram(scenario, world, self.lcm, hardware, policy=policy)
        self.link = BuildPx4Diagram(config, self.lcm, self.inbox)
        self.simulators = {"bridge": Simulator(self.bridge), "link": Simulator(self.link)}
        for simulator in self.simulators.values():
            clock = simulator.get_system().GetSubsystemByName("clock")
            root = simulator.get_mutable_context()
            clock.set_epoch(root, EPOCH)
        self.alive = {"bridge", "link"}
        self.now = 0.0
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

    def status(self) -> np.ndarray:
        root = self.simulators["bridge"].get_context()
        return self.bridge.GetOutputPort("status").Eval(root)

    def state(self) -> np.ndarray:
        """Where the bridge predicts that the vehicle is."""
        root = self.simulators["bridge"].get_context()
        return self.bridge.GetOutputPort("state").Eval(root)


@pytest.fixture
def chain(post_world):
    made = []

    def make(*args, **kwargs) -> Chain:
        made.append(Chain(post_world, *args, **kwargs))
        return made[-1]

    yield make
    for each in made:
        each.px4.socket.close()
        each.cameras.close()
        each.inbox.close()


@pytest.mark.parametrize("version", ["1.16", "1.18"])
@pytest.mark.parametrize("setpoints", ["velocity", "body_rates"])
def test_px4_flies_where_the_policy_wants(chain, version, setpoints):
    flight = chain(version, dataclasses.replace(ENGAGED, setpoints=setpoints))
    flight.advance(7.0)
    assert (flight.px4.mode, flight.px4.armed) == (OFFBOARD, True)
    assert not flight.px4.refused
    assert all(accepted for _, accepted in flight.px4.answers)
    p, v = flight.px4.state[:3], flight.px4.state[3:6]
    assert p[0] > START[0] + 2.0
    np.testing.assert_allclose(p[1:], START[1:], atol=0.1)
    np.testing.assert_allclose(v, [1.0, 0.0, 0.0], atol=0.1)


def test_nothing_arms_or_flies_by_default(chain):
    flight = chain(commander=Px4CommanderConfig())
    flight.advance(5.0)
    assert not flight.px4.answers
    assert (flight.px4.mode, flight.px4.armed) == (POSITION, False)
    assert flight.px4.heard.count("SET_POSITION_TARGET_LOCAL_NED") > 100
    np.testing.assert_array_equal(flight.px4.state[:3], START)


def test_a_stream_that_is_too_young_is_asked_with_again(chain):
    hasty = dataclasses.replace(ENGAGED, streaming=0.5)
    for version, refusals in (("1.16", 1), ("1.18", 0)):
        flight = chain(version, hasty)
        flight.advance(4.0)
        assert [accepted for _, accepted in flight.px4.answers].count(False) == refusals
        assert flight.px4.mode == OFFBOARD


def test_where_the_bridge_dies_the_vehicle_holds(chain):
    flight = chain()
    flight.advance(6.0)
    flight.alive.remove("bridge")
    flight.advance(0.4)
    assert (flight.px4.mode, np.linalg.norm(flight.px4.velocity)) == (OFFBOARD, 0.0)
    flight.advance(0.8)
    assert flight.px4.mode == LOITER
    flight.advance(2.0)
    assert np.linalg.norm(flight.px4.state[3:6]) < 0.1
    flight.alive.add("bridge")
    flight.advance(4.0)
    assert flight.px4.mode == LOITER


def test_where_the_link_dies_px4_holds_by_itself(chain):
    flight = chain()
    flight.advance(6.0)
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
    flight.advance(6.05)
    asked = len(flight.px4.answers)
    flight.alive.remove("bridge")
    flight.advance(silent)
    assert flight.px4.mode == OFFBOARD
    flight.px4.mode = POSITION
    flight.advance(3.0)
    flight.alive.add("bridge")
    flight.advance(2.0)
    assert flight.px4.mode == POSITION
    assert len(flight.px4.answers) == asked


def test_a_pilot_who_leaves_offboard_mode_at_once_keeps_the_vehicle(chain):
    flight = chain()
    while (dialect.MAV_CMD_DO_SET_MODE, True) not in flight.px4.answers:
        flight.advance(0.01)
    flight.px4.mode = POSITION
    flight.advance(4.0)
    assert flight.px4.mode == POSITION
    assert flight.px4.answers == [(dialect.MAV_CMD_DO_SET_MODE, True)]


def test_a_pilot_who_takes_over_from_a_landing_keeps_the_vehicle(chain):
    flight = chain()
    flight.advance(5.0)
    flight.px4.muted = STATES
    while flight.status()[0] != lcmt_bridge_status.LANDING:
        flight.advance(0.01)
    flight.advance(0.3)
    assert flight.px4.mode == OFFBOARD
    asked = len(flight.px4.answers)
    flight.px4.mode = POSITION
    flight.advance(3.0)
    assert flight.px4.mode == POSITION
    assert len(flight.px4.answers) == asked


STATES = {"LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"}


@pytest.mark.parametrize(
    ("muted", "mode"), [(STATES, LAND), (STATES | {"HEARTBEAT", "TIMESYNC"}, OFFBOARD)]
)
def test_where_px4_falls_silent_the_bridge_stops_and_lands(chain, muted, mode):
    flight = chain()
    flight.advance(6.0)
    flight.px4.muted = muted
    flight.advance(1.0)
    why = [lcmt_bridge_status.HOLDING, lcmt_bridge_status.STATE_OLD]
    np.testing.assert_array_equal(flight.status()[:2], why)
    assert np.linalg.norm(flight.px4.velocity) == 0.0
    flight.advance(6.0)
    assert flight.px4.mode == mode
    np.testing.assert_allclose(flight.px4.state[3:6], [0.0, 0.0, -0.5], atol=0.1)


@pytest.mark.parametrize(("setpoints", "delay"), [("velocity", 0.1), ("body_rates", 0.06)])
def test_states_that_are_late_are_brought_up_to_date(chain, setpoints, delay):
    flight = chain(
        policy=Circle(2.0, "waypoint"), commander=dataclasses.replace(ENGAGED, setpoints=setpoints)
    )
    flight.px4.delay = delay
    flight.advance(5.0)
    for _ in range(200):
        flight.advance(0.01)
        assert np.linalg.norm(flight.px4.state[3:6]) == pytest.approx(2.0, abs=0.2)
        assert np.linalg.norm(flight.state()[:3] - flight.px4.state[:3]) < 0.05
        assert flight.status()[2] > delay


@pytest.mark.parametrize("sees", [None, {"body": 8}, {"body": 3, "tracked": False}])
def test_where_motion_capture_dies_the_bridge_stops(chain, sees):
    flight = chain(body="starling", hardware=HardwareConfig(body="starling"), motion_capture=True)
    flight.advance(6.0)
    assert flight.status()[0] == lcmt_bridge_status.FLYING
    sent = len(flight.px4.odometry)
    assert sent == pytest.approx(300, abs=3)
    flight.sees = sees
    flight.advance(0.26)
    assert flight.status()[0] == lcmt_bridge_status.FLYING
    flight.advance(0.06)
    why = [lcmt_bridge_status.HOLDING, lcmt_bridge_status.BODY_LOST]
    np.testing.assert_array_equal(flight.status()[:2], why)
    flight.advance(0.02)
    assert np.linalg.norm(flight.px4.velocity) == 0.0
    flight.advance(2.0)
    assert np.linalg.norm(flight.px4.state[3:6]) < 0.1
    assert len(flight.px4.odometry) <= sent + 1
    assert np.isfinite([[m.x, m.y, m.z, *m.q] for m in flight.px4.odometry]).all()


def test_px4_learns_our_clock_and_when_cameras_exposed(chain):
    flight = chain(body="starling", motion_capture=True)
    flight.advance(3.0)
    assert np.abs(np.array(flight.px4.offsets) + BOOT + EPOCH).max() < 0.01
    exposed = np.diff([m.time_usec for m in flight.px4.odometry])
    assert (exposed >= 15_000).all()
    newest = 1e-6 * flight.px4.odometry[-1].time_usec - EPOCH
    assert 0.01 <= flight.now - newest <= 0.01 + 0.04


def test_motion_capture_is_sent_on(chain):
    flight = chain(body="starling")
    codec = MotionCaptureCodec("starling")
    publisher = MessagePublisher(flight.lcm, codec, 1.0)
    context = publisher.CreateDefaultContext()
    publisher.GetInputPort(codec.port).FixValue(context, np.array([1.0, 2, 3, 1, 0, 0, 0]))
    flight.advance(0.1)
    assert not flight.px4.odometry
    publisher.GetInputPort("unix_time").FixValue(context, [EPOCH + flight.now])
    publisher.ForcedPublish(context)
    flight.advance(0.1)
    flight.advance(0.3)
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
    for _ in range(40):
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
    flight.advance(5.0)
    assert flight.status()[0] == lcmt_bridge_status.FLYING
    assert flight.px4.state[2] > 0.35
