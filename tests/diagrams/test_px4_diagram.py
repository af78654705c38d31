"""The bridge flies what PX4 flies: over real MAVLink, with a stand-in for PX4."""

import dataclasses

import lcm
import numpy as np
import pytest
from px4_stand_in import LAND, LOITER, OFFBOARD, POSITION, Px4StandIn
from pydrake.systems.analysis import Simulator

from splatpilot.diagrams.hardware_diagram import BuildHardwareDiagram
from splatpilot.diagrams.policies import policy_named
from splatpilot.diagrams.px4_config import Px4Config
from splatpilot.diagrams.px4_diagram import BuildPx4Diagram
from splatpilot.diagrams.scenario import Scenario
from splatpilot.systems.messaging.codecs import MotionCaptureCodec
from splatpilot.systems.messaging.generated import lcmt_bridge_status
from splatpilot.systems.messaging.message_publisher import MessagePublisher
from splatpilot.systems.messaging.udp_inbox import UdpConfig, UdpInbox
from splatpilot.systems.px4.px4_commander import Px4CommanderConfig

START, GOAL = [1.0, 2.0, 2.0], [9.0, 2.0, 2.0]
ENGAGED = Px4CommanderConfig(engage=True, arm=True)


class Chain:
    """Bridge, PX4's messages and the stand-in, in step; the test says how far."""

    def __init__(self, world, version: str = "1.16", commander=ENGAGED, body: str = ""):
        self.px4 = Px4StandIn(version, START)
        self.inbox = UdpInbox(UdpConfig(port=0))
        self.px4.peer = ("127.0.0.1", self.inbox.port)
        self.lcm = lcm.LCM("memq://")
        scenario = Scenario(policy=policy_named("straight", 1.0), start=START, goal=GOAL)
        config = Px4Config(vehicle_port=self.px4.port, commander=commander, body=body)
        self.bridge = BuildHardwareDiagram(scenario, world, self.lcm)
        self.link = BuildPx4Diagram(config, self.lcm, self.inbox)
        self.simulators = {"bridge": Simulator(self.bridge), "link": Simulator(self.link)}
        self.alive = {"bridge", "link"}
        self.now = 0.0

    def advance(self, duration: float) -> None:
        until = self.now + duration
        while self.now < until - 1e-9:
            self.now += 0.01
            for name in sorted(self.alive):
                self.simulators[name].AdvanceTo(self.now)
            self.px4.step(self.now)

    def status(self) -> np.ndarray:
        root = self.simulators["bridge"].get_context()
        return self.bridge.GetOutputPort("status").Eval(root)


@pytest.fixture
def chain(post_world):
    made = []

    def make(*args, **kwargs) -> Chain:
        made.append(Chain(post_world, *args, **kwargs))
        return made[-1]

    yield make
    for each in made:
        each.px4.socket.close()
        each.inbox.close()


@pytest.mark.parametrize("version", ["1.16", "1.18"])
@pytest.mark.parametrize("setpoints", ["velocity", "body_rates"])
def test_px4_flies_where_the_policy_wants(chain, version, setpoints):
    """Asked for explicitly, offboard mode and arming are granted by the rules of either version,
    and the vehicle flies towards the goal, by velocities and by body rates."""
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
    """Without being told so, the link streams setpoints and asks for nothing, however long."""
    flight = chain(commander=Px4CommanderConfig())
    flight.advance(5.0)
    assert not flight.px4.answers
    assert (flight.px4.mode, flight.px4.armed) == (POSITION, False)
    assert flight.px4.heard.count("SET_POSITION_TARGET_LOCAL_NED") > 100
    np.testing.assert_array_equal(flight.px4.state[:3], START)


def test_a_stream_that_is_too_young_is_asked_with_again(chain):
    """PX4 1.16 wants a second of setpoints: asked after half of one it refuses, and the link asks
    again until it grants; 1.18 grants at once."""
    hasty = dataclasses.replace(ENGAGED, streaming=0.5)
    for version, refusals in (("1.16", 1), ("1.18", 0)):
        flight = chain(version, hasty)
        flight.advance(4.0)
        assert [accepted for _, accepted in flight.px4.answers].count(False) == refusals
        assert flight.px4.mode == OFFBOARD


def test_where_the_bridge_dies_the_vehicle_holds(chain):
    """When setpoints cease the link leaves offboard mode for hold, before PX4 has to, and does not
    enter it again when they come back."""
    flight = chain()
    flight.advance(6.0)
    flight.alive.remove("bridge")
    flight.advance(0.8)
    assert flight.px4.mode == LOITER
    flight.advance(2.0)
    assert np.linalg.norm(flight.px4.state[3:6]) < 0.1
    flight.alive.add("bridge")
    flight.advance(4.0)
    assert flight.px4.mode == LOITER


def test_where_the_link_dies_px4_holds_by_itself(chain):
    """The stand-in's own failsafe takes over after COM_OF_LOSS_T, as PX4's does."""
    flight = chain()
    flight.advance(6.0)
    flight.alive.clear()
    flight.advance(0.8)
    assert flight.px4.mode == OFFBOARD
    flight.advance(2.0)
    assert flight.px4.mode == LOITER
    assert np.linalg.norm(flight.px4.state[3:6]) < 0.1


def test_a_pilot_who_takes_over_is_not_fought(chain):
    """When a pilot leaves offboard mode nothing is asked for any more, whatever ceases."""
    flight = chain()
    flight.advance(6.0)
    asked = len(flight.px4.answers)
    flight.px4.mode = POSITION
    flight.advance(2.0)
    flight.alive.remove("bridge")
    flight.advance(2.0)
    assert flight.px4.mode == POSITION
    assert len(flight.px4.answers) == asked


def test_where_px4_falls_silent_the_bridge_stops(chain):
    """Without telemetry the bridge notices that the state is old, has PX4 stop, and when that
    lasts, land."""
    flight = chain()
    flight.advance(6.0)
    told, flight.px4._tell = flight.px4._tell, lambda now: None
    flight.advance(1.0)
    why = [lcmt_bridge_status.HOLDING, lcmt_bridge_status.STATE_OLD]
    np.testing.assert_array_equal(flight.status()[:2], why)
    assert np.linalg.norm(flight.px4.velocity) == 0.0
    flight.advance(5.0)
    assert flight.px4.mode == LAND
    flight.px4._tell = told


def test_motion_capture_is_sent_on(chain):
    """The pose of the body in motion capture goes to PX4 as ODOMETRY, north east down."""
    flight = chain(body="starling")
    codec = MotionCaptureCodec("starling")
    publisher = MessagePublisher(flight.lcm, codec, 1.0)
    context = publisher.CreateDefaultContext()
    publisher.GetInputPort(codec.port).FixValue(context, np.array([1.0, 2, 3, 1, 0, 0, 0]))
    flight.advance(0.1)
    assert flight.px4.odometry is None
    publisher.unix_time_input_port().FixValue(context, [flight.now])
    publisher.ForcedPublish(context)
    flight.advance(0.1)
    odometry = flight.px4.odometry
    assert (odometry.x, odometry.y, odometry.z) == (1.0, -2.0, -3.0)
    assert odometry.time_usec == pytest.approx(0.1e6, abs=2)


def test_a_vehicle_below_its_fence_is_armed_and_takes_off_into_it(chain):
    flight = chain()
    flight.px4.state[2] = -0.3
    flight.advance(3.0)
    assert (flight.px4.mode, flight.px4.armed) == (OFFBOARD, True)
    flight.advance(5.0)
    assert flight.status()[0] == lcmt_bridge_status.FLYING
    assert flight.px4.state[2] > 0.35
