"""The flight diagram, cut in two between which messages travel."""

import dataclasses
import gc
import socket
import struct
import weakref

import lcm
import numpy as np
import pytest
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import LeafSystem

from splatpilot.diagrams.flight.flight import fly, sample_initial_state
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware.bridge import BuildHardwareDiagram, HardwareConfig
from splatpilot.diagrams.hardware.vehicle import BuildVehicleDiagram
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.messaging.failsafe import FailsafeConfig
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.generated import lcmt_bridge_status, lcmt_trajectory_hypotheses
from splatpilot.systems.messaging.lcm_ports import PUBLISH_OFFSET
from splatpilot.systems.messaging.tof_receiver import (
    TimeOfFlightReceiver,
    TimeOfFlightStream,
    UdpConfig,
)
from splatpilot.systems.policies.base import LearnedPolicyConfig
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.systems.sensing.onboard_camera import OnboardCamera

TICK = HardwareConfig().tick


class Halves:
    """Vehicle and pilot, each a diagram, the pilot's time 4 ms behind; the test advances both."""

    def __init__(self, scenario: Scenario, world, vehicle: Scenario | None = None, **pilot):
        self.lcm = lcm.LCM("memq://")
        config = pilot.get("config")
        self.vehicle = BuildVehicleDiagram(vehicle or scenario, world, self.lcm, config)
        self.hardware = BuildHardwareDiagram(scenario, world, self.lcm, **pilot)
        self.simulators = [Simulator(self.vehicle), Simulator(self.hardware)]
        ApplySimulatorConfig(scenario.simulator, self.simulators[0])
        self.vehicle_root, self.root = (s.get_mutable_context() for s in self.simulators)
        plant = self.vehicle.GetSubsystemByName("plant")
        start = sample_initial_state(scenario, world)
        plant.GetMyMutableContextFromRoot(self.vehicle_root).SetContinuousState(start)
        clock = self.hardware.GetSubsystemByName("clock")
        clock.set_epoch(clock.GetMyMutableContextFromRoot(self.root), 2 * TICK)
        self.tick = 0

    def advance_to(self, time: float, vehicle: bool = True) -> None:
        while self.tick * TICK <= time + 1e-9:
            now = self.tick * TICK + 2 * PUBLISH_OFFSET
            if vehicle:
                self.simulators[0].AdvanceTo(now)
            self.simulators[1].AdvanceTo(max(now - 2 * TICK, 2 * PUBLISH_OFFSET))
            self.tick += 1

    def state(self) -> np.ndarray:
        return self.vehicle.GetOutputPort("state").Eval(self.vehicle_root)

    def status(self) -> np.ndarray:
        return self.hardware.GetOutputPort("status").Eval(self.root)


@pytest.fixture(scope="module")
def forest():
    """Trunks on a ground that is drawn, which policies that see were trained to fly over."""
    return make_world(ForestConfig(length=12.0, width=8.0, height=4.0), 0)


@pytest.mark.parametrize("name", ["planner", "reactive", "depthnav", "diffaero", "diffaero_tof"])
def test_the_two_halves_fly_as_the_whole(forest, name):
    scenario = Scenario(timeout=3.0, policy=policy_named(name))
    whole = fly(BuildFlightDiagram(scenario, forest, camera=False), scenario, forest)
    limits = FlightLimits(max_speed=20.0, max_tilt=1.5, deceleration=100.0, min_clearance=0.0)
    config = HardwareConfig(failsafe=FailsafeConfig(limits=limits))
    halves = Halves(scenario, forest, config=config)
    halves.advance_to(3.0)
    np.testing.assert_allclose(halves.state()[:3], whole.states[-1, :3], atol=0.1)
    assert np.linalg.norm(whole.states[-1, :3] - whole.states[0, :3]) > 2.0
    mode, _, state_age, _, gaps, rejected, overruns = halves.status()
    assert mode == lcmt_bridge_status.FLYING
    assert 0.0 <= state_age <= 0.02
    assert (gaps, rejected, overruns) == (0, 0, 0)


def test_ports_are_those_of_the_flight_diagram(post_world):
    scenario = Scenario(policy=policy_named("planner"))
    flight = BuildFlightDiagram(scenario, post_world, camera=False)
    hardware = BuildHardwareDiagram(scenario, post_world, lcm.LCM("memq://"))
    for index in range(flight.num_output_ports()):
        port = flight.get_output_port(index)
        assert hardware.GetOutputPort(port.get_name()).size() == port.size()


def test_commands_stop_where_the_vehicle_falls_silent(post_world):
    halves = Halves(Scenario(policy=policy_named("straight")), post_world)
    heard = []
    halves.lcm.subscribe("BODY_RATE_COMMAND", lambda _, data: heard.append(data))
    halves.advance_to(0.5)
    assert halves.status()[0] == lcmt_bridge_status.FLYING
    halves.advance_to(0.9, vehicle=False)
    halted = [lcmt_bridge_status.HOLDING, lcmt_bridge_status.STATE_OLD]
    np.testing.assert_array_equal(halves.status()[:2], halted)
    setpoint = halves.hardware.GetOutputPort("velocity_setpoint").Eval(halves.root)
    np.testing.assert_array_equal(setpoint[:3], np.zeros(3))
    before = len(heard)
    halves.advance_to(2.0, vehicle=False)
    assert len(heard) == before > 25
    assert halves.status()[2] == pytest.approx(1.5, abs=0.03)
    halves.advance_to(2.8)
    assert halves.status()[0] == lcmt_bridge_status.FLYING
    assert len(heard) > before


def test_before_the_first_state_nothing_is_commanded(post_world):
    hardware = BuildHardwareDiagram(Scenario(), post_world, lcm.LCM("memq://"))
    status = hardware.GetOutputPort("status").Eval(hardware.CreateDefaultContext())
    np.testing.assert_array_equal(status, [lcmt_bridge_status.WAITING, 0, np.inf, 0, 0, 0, 0])


def test_a_vehicle_that_hears_no_more_holds_and_then_lands(post_world):
    halves = Halves(Scenario(policy=policy_named("straight")), post_world)
    halves.simulators[0].AdvanceTo(0.3)
    np.testing.assert_allclose(halves.state()[3:6], np.zeros(3), atol=1e-6)
    halves.tick = round(0.3 / TICK)
    halves.advance_to(1.5)
    assert halves.state()[3] > 1.0
    halves.simulators[0].AdvanceTo(5.5)
    p = halves.state()[:3].copy()
    assert np.linalg.norm(halves.state()[3:6]) < 0.05
    assert p[2] == pytest.approx(2.0, abs=0.1)
    halves.simulators[0].AdvanceTo(9.0)
    assert halves.state()[2] == pytest.approx(p[2] - 0.5 * (2.4 - 0.4), abs=0.1)
    np.testing.assert_allclose(halves.state()[:2], p[:2], atol=0.1)


class Mad(LeafSystem):
    """A policy that wants what the test says, whatever that is."""

    def __init__(self, port: str):
        super().__init__()
        self.wants = np.zeros(3)
        self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorOutputPort(port, 3, self._calc)
        self.DeclarePeriodicDiscreteUpdateEvent(0.1, 0.0, lambda context, state: None)

    def _calc(self, context, output) -> None:
        output.set_value(self.wants)


@pytest.mark.parametrize("port", ["acceleration", "velocity", "waypoint"])
def test_a_policy_that_says_nonsense_ends_no_flight(post_world, port):
    policy = Mad(port)
    halves = Halves(Scenario(policy=policy_named("straight")), post_world, policy=policy)
    halves.advance_to(0.1)
    policy.wants = np.array([np.nan, 0.0, np.inf])
    halves.advance_to(1.0)
    why = [lcmt_bridge_status.HOLDING, lcmt_bridge_status.NOT_FINITE]
    np.testing.assert_array_equal(halves.status()[:2], why)
    assert np.linalg.norm(halves.state()[3:6]) < 0.3
    policy.wants = np.array([0.3, 0.0, 0.0]) + (halves.state()[:3] if port == "waypoint" else 0.0)
    halves.advance_to(1.8)
    assert halves.status()[0] == lcmt_bridge_status.FLYING


class Broken(Mad):
    """A policy that raises an exception while the test says so."""

    raises = False

    def _calc(self, context, output) -> None:
        if self.raises:
            raise RuntimeError("the network ran out of memory")
        super()._calc(context, output)


def test_a_policy_that_raises_ends_no_flight(post_world, caplog):
    policy = Broken("velocity")
    policy.wants = np.array([0.3, 0.0, 0.0])
    halves = Halves(Scenario(policy=policy_named("straight")), post_world, policy=policy)
    halves.advance_to(0.3)
    policy.raises = True
    halves.advance_to(1.0)
    why = [lcmt_bridge_status.HOLDING, lcmt_bridge_status.POLICY_FAILED]
    np.testing.assert_array_equal(halves.status()[:2], why)
    assert [record.exc_text.count("RuntimeError: the net") for record in caplog.records] == [1]
    policy.raises = False
    halves.advance_to(1.8)
    assert halves.status()[0] == lcmt_bridge_status.FLYING


class Heading(LeafSystem):
    """A policy that wants to stand, and to look where the test says."""

    def __init__(self, heading: float):
        super().__init__()
        self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorOutputPort("velocity", 3, lambda context, output: output.SetZero())
        looks = self.DeclareDiscreteState([heading])
        self.DeclareStateOutputPort("heading", looks)
        self.DeclarePeriodicDiscreteUpdateEvent(0.1, 0.0, lambda context, state: None)


@pytest.mark.parametrize(
    ("heading", "reason"),
    [
        (np.inf, lcmt_bridge_status.NOT_FINITE),
        (-np.inf, lcmt_bridge_status.NOT_FINITE),
        (np.nan, lcmt_bridge_status.NONE),
    ],
)
def test_a_heading_that_is_no_angle_ends_no_flight(post_world, heading, reason):
    policy = Heading(heading)
    halves = Halves(Scenario(policy=policy_named("straight")), post_world, policy=policy)
    halves.advance_to(0.3)
    assert halves.status()[1] == reason


@pytest.mark.parametrize("seen", [True, False])
def test_a_body_that_motion_capture_does_not_see_is_not_flown(post_world, seen):
    config = HardwareConfig(body="starling")
    halves = Halves(Scenario(policy=policy_named("straight")), post_world, config=config)
    if not seen:
        sender = halves.vehicle.GetSubsystemByName("motion_capture_pose_publisher")
        context = sender.GetMyMutableContextFromRoot(halves.vehicle_root)
        sender.GetInputPort("enabled").FixValue(context, [0.0])
    halves.advance_to(1.0)
    if not seen:
        assert halves.status()[0] == lcmt_bridge_status.WAITING
        return
    assert halves.status()[0] == lcmt_bridge_status.FLYING
    sender = halves.vehicle.GetSubsystemByName("motion_capture_pose_publisher")
    context = sender.GetMyMutableContextFromRoot(halves.vehicle_root)
    sender.GetInputPort("enabled").FixValue(context, [0.0])
    halves.advance_to(1.4)
    why = [lcmt_bridge_status.HOLDING, lcmt_bridge_status.BODY_LOST]
    np.testing.assert_array_equal(halves.status()[:2], why)


def test_the_vehicle_says_that_it_is_flown_by_the_bridge(post_world):
    halves = Halves(Scenario(policy=policy_named("straight")), post_world)
    in_charge = halves.hardware.GetOutputPort("in_charge")
    assert in_charge.Eval(halves.root)[0] == 0
    halves.advance_to(0.3)
    assert in_charge.Eval(halves.root)[0] == 1


@pytest.mark.parametrize("streamed", [False, True])
def test_a_policy_flies_by_the_grid_of_a_sensor(post_world, tmp_path, streamed):
    policy = tmp_path / "weights.npz"
    random = np.random.default_rng(0)
    shapes = DIFFAERO_NETWORK.weight_shapes().items()
    weights = {key: random.normal(scale=0.1, size=shape) for key, shape in shapes}
    PolicyCheckpoint("diffaero_tof", DIFFAERO_NETWORK, weights, {}).save(policy)
    stream = TimeOfFlightStream(UdpConfig(port=0)) if streamed else None
    scenario = Scenario(policy=policy_named(str(policy)))
    halves = Halves(scenario, post_world, config=HardwareConfig(time_of_flight=stream))
    grid = halves.hardware.GetOutputPort("depth_grid")
    if streamed:
        halves.advance_to(0.1)
        assert halves.status()[0] == lcmt_bridge_status.WAITING
        receiver = halves.hardware.GetSubsystemByName("depth_grid_receiver")
        assert isinstance(receiver, TimeOfFlightReceiver)
        packet = struct.pack("<IIQ144f", 0x544F4632, 1, 1, *[0.25] * 144)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
            sensor.sendto(packet, ("127.0.0.1", receiver.port))
        halves.advance_to(0.3)
        np.testing.assert_array_equal(grid.Eval(halves.root), np.full(144, 0.25))
    else:
        halves.advance_to(0.3)
        sent = halves.vehicle.GetSubsystemByName("time_of_flight_grid")
        expected = sent.get_output_port().Eval(sent.GetMyContextFromRoot(halves.vehicle_root))
        np.testing.assert_allclose(grid.Eval(halves.root), expected, atol=0.02)
        assert expected.max() > 0.1
    assert halves.status()[0] == lcmt_bridge_status.FLYING
    pilot = halves.hardware.GetSubsystemByName("policy")
    wanted = pilot.GetOutputPort("velocity").Eval(pilot.GetMyContextFromRoot(halves.root))
    setpoint = halves.hardware.GetOutputPort("velocity_setpoint").Eval(halves.root)
    np.testing.assert_allclose(setpoint[:3], wanted, atol=1e-12)
    assert np.linalg.norm(wanted) > 0.01


def test_plans_travel(post_world):
    halves = Halves(Scenario(policy=policy_named("planner")), post_world)
    heard = []
    decode = lcmt_trajectory_hypotheses.decode
    halves.lcm.subscribe("TRAJECTORY_HYPOTHESES", lambda _, data: heard.append(decode(data)))
    halves.advance_to(0.5)
    while halves.lcm.handle_timeout(0):
        pass
    plan = halves.hardware.GetOutputPort("hypotheses").Eval(halves.root)
    assert heard[-1].plan_utime == pytest.approx((plan[0] + 2 * TICK) * 1e6, abs=1)
    np.testing.assert_array_equal(np.ravel(heard[-1].waypoints_P), plan[8 : 8 + 90])


@pytest.mark.parametrize("setpoints", ["velocity", "body_rates"])
def test_velocity_setpoint_leads_where_the_policy_wants(post_world, setpoints):
    scenario = Scenario(policy=policy_named("straight", speed=1.5))
    halves = Halves(scenario, post_world, config=HardwareConfig(setpoints=setpoints))
    halves.advance_to(1.2)
    np.testing.assert_allclose(halves.state()[3:6], [1.5, 0, 0], atol=0.15)
    setpoint = halves.hardware.GetOutputPort("velocity_setpoint").Eval(halves.root)
    np.testing.assert_allclose(setpoint[:3], [1.5, 0, 0], atol=0.05)


@pytest.mark.parametrize("setpoints", ["velocity", "body_rates"])
@pytest.mark.parametrize("speed", [2.0, 6.0])
def test_a_known_obstacle_is_not_flown_into(post_world, setpoints, speed):
    scenario = Scenario(policy=policy_named("straight", speed), start_radius=0.0)
    halves = Halves(scenario, post_world, config=HardwareConfig(setpoints=setpoints))
    clearance, closest = halves.vehicle.GetOutputPort("clearance"), np.inf
    for step in range(150):
        halves.advance_to(0.02 * step)
        closest = min(closest, clearance.Eval(halves.vehicle_root)[0])
    limited = [lcmt_bridge_status.FLYING, lcmt_bridge_status.LIMITED_CLEARANCE]
    np.testing.assert_array_equal(halves.status()[:2], limited)
    assert 0.099 < closest < 0.2


def test_what_no_message_carries_is_refused(post_world):
    transport = lcm.LCM("memq://")
    with pytest.raises(ValueError, match="no messages of the sensors down"):
        BuildHardwareDiagram(Scenario(sensors={"down": OnboardCamera()}), post_world, transport)
    moving = dataclasses.replace(post_world, moving=object())
    for build in (BuildHardwareDiagram, BuildVehicleDiagram):
        with pytest.raises(ValueError, match="moving obstacles in post"):
            build(Scenario(), moving, transport)
    with pytest.raises(ValueError, match=r"tick must be in .* got 0.0"):
        BuildHardwareDiagram(Scenario(), post_world, transport, HardwareConfig(tick=0.0))


def test_images_of_another_size_are_refused_by_the_other_half(post_world):
    camera = OnboardCamera(width=32, height=18)
    policy = policy_named("diffaero")
    assert isinstance(policy, LearnedPolicyConfig)
    other = Scenario(policy=dataclasses.replace(policy, camera=camera))
    halves = Halves(Scenario(policy=policy), post_world, vehicle=other)
    heard = []
    halves.lcm.subscribe("BODY_RATE_COMMAND", lambda _, data: heard.append(data))
    halves.advance_to(0.3)
    mode, _, state_age, image_age, _, rejected, _ = halves.status()
    assert (mode, image_age, rejected) == (lcmt_bridge_status.WAITING, np.inf, 5)
    assert state_age < 0.03
    assert not heard


def test_both_halves_are_freed(post_world):
    halves = Halves(Scenario(policy=policy_named("diffaero")), post_world)
    transport, freed = halves.lcm, [weakref.ref(d) for d in (halves.vehicle, halves.hardware)]
    halves.advance_to(0.1)
    del halves
    gc.collect()
    assert [reference() for reference in freed] == [None, None]
    assert transport is not None
