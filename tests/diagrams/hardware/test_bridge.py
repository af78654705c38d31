import dataclasses
import gc
import json
import socket
import struct
import subprocess
import sys
import weakref
from pathlib import Path

import lcm
import numpy as np
import pytest
from halves import TICK, Halves
from harness import Harness
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.simulation import fly
from splatpilot.diagrams.hardware import bridge
from splatpilot.diagrams.hardware.bridge import BuildHardwareDiagram, HardwareConfig
from splatpilot.diagrams.hardware.vehicle import BuildVehicleDiagram
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.drake import vector_output
from splatpilot.systems.messaging.codecs import StateCodec, VehicleStatusCodec
from splatpilot.systems.messaging.failsafe import FailsafeConfig
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.messaging.generated import lcmt_quadrotor_state, lcmt_trajectory_hypotheses
from splatpilot.systems.messaging.lcm_ports import MessagePublisher
from splatpilot.systems.messaging.receiver import TimeOfFlightStream, UdpConfig
from splatpilot.systems.policies.base import LearnedPolicyConfig
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor import hover_state

SPLATPILOT = Path(sys.executable).with_name("splatpilot")
STRAIGHT = Scenario(policy=policy_named("straight"))


@pytest.fixture(scope="module")
def forest():
    """A world with a ground that is drawn, which policies that see were trained to fly over."""
    return make_world(ForestConfig(length=12.0, width=8.0, height=4.0), 0)


@pytest.mark.parametrize("name", ["planner", "diffaero", "diffaero_tof"])
def test_the_two_halves_fly_as_the_whole(forest, name):
    scenario = Scenario(timeout=1.0, policy=policy_named(name))
    whole = fly(BuildFlightDiagram(scenario, forest, camera=False))
    limits = FlightLimits(max_speed=20.0, max_tilt=1.5, deceleration=100.0, min_clearance=0.0)
    halves = Halves(scenario, forest, failsafe=FailsafeConfig(limits=limits), tick=0.0025)
    halves.advance_to(1.0)
    np.testing.assert_allclose(halves.state()[:3], whole.states[-1, :3], atol=0.1)
    assert np.linalg.norm(whole.states[-1, :3] - whole.states[0, :3]) > 0.4
    mode, _, state_age, _, *counts = halves.out("status")
    assert (mode, *counts) == (status.FLYING, 0, 0, 0) and 0.0 <= state_age <= 0.02


def test_ports_are_those_of_the_flight_diagram(post_world):
    flight = BuildFlightDiagram(Scenario(), post_world, camera=False)
    hardware = BuildHardwareDiagram(Scenario(), post_world, lcm.LCM("memq://"))
    for port in (flight.get_output_port(index) for index in range(flight.num_output_ports())):
        if port.get_name() != "outcome" and not port.get_name().startswith("observation_"):
            assert hardware.GetOutputPort(port.get_name()).size() == port.size()


def test_commands_stop_when_the_vehicle_falls_silent(post_world):
    halves = Halves(STRAIGHT, post_world)
    halves.advance_to(0.3)
    assert halves.mode()[0] == status.FLYING
    halves.advance_to(0.7, vehicle=False)
    assert halves.mode() == (status.HOLDING, status.STATE_OLD)
    np.testing.assert_array_equal(halves.out("velocity_setpoint")[:3], np.zeros(3))
    before = len(halves.heard)
    halves.advance_to(1.1, vehicle=False)
    assert len(halves.heard) == before > 15
    assert halves.out("status")[2] == pytest.approx(0.8, abs=0.03)
    halves.advance_to(1.8)
    assert halves.mode()[0] == status.FLYING
    assert len(halves.heard) > before


class Erratic(LeafSystem):
    """A policy whose target and exceptions the test sets."""

    def __init__(self, port: str, updates: bool, heading: float = np.nan):
        super().__init__()
        self.target, self.raises = np.zeros(3), False
        self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorOutputPort(port, 3, self._calc)
        if updates:
            self.DeclareStateOutputPort("heading", self.DeclareDiscreteState([heading]))
            self.DeclarePeriodicDiscreteUpdateEvent(0.1, 0.0, lambda context, state: None)

    def _calc(self, context, output) -> None:
        if self.raises:
            raise RuntimeError("the network ran out of memory")
        output.set_value(self.target)


@pytest.mark.parametrize(
    ("port", "raises", "updates"),
    [
        *((port, False, True) for port in ("acceleration", "velocity", "waypoint")),
        *(("velocity", True, updates) for updates in (True, False)),
    ],
)
def test_a_policy_that_fails_ends_no_flight(post_world, caplog, port, raises, updates):
    policy = Erratic(port, updates)
    policy.target = valid = np.array([2.0, 0, 2.0] if port == "waypoint" else [0.3, 0, 0])
    halves = Halves(STRAIGHT, post_world, policy=policy)
    halves.advance_to(0.1)
    assert halves.mode()[1] == status.NONE
    policy.raises, policy.target = raises, np.array([np.nan, 0.0, np.inf])
    halves.advance_to(0.5)
    reason = status.POLICY_FAILED if raises else status.NOT_FINITE
    assert halves.mode() == (status.HOLDING, reason)
    assert np.linalg.norm(halves.state()[3:6]) < 0.3
    assert [r.exc_text.count("RuntimeError: the net") for r in caplog.records] == [1] * raises
    policy.raises, policy.target = False, valid
    halves.advance_to(1.2)
    assert halves.mode()[0] == status.FLYING


def test_an_infinite_heading_ends_no_flight(post_world):
    halves = Halves(STRAIGHT, post_world, policy=Erratic("velocity", True, heading=np.inf))
    halves.advance_to(0.3)
    assert halves.mode() == (status.HOLDING, status.NOT_FINITE)


def test_a_body_that_motion_capture_does_not_see_is_not_flown(post_world):
    halves = Halves(STRAIGHT, post_world, body="starling")
    sender = halves.vehicle.GetSubsystemByName("motion_capture_pose_publisher")
    context = sender.GetMyMutableContextFromRoot(halves.vehicle_root)
    for sees, until, mode in (
        (0.0, 0.4, (status.WAITING, status.NONE)),
        (1.0, 0.8, (status.FLYING, status.NONE)),
        (0.0, 1.2, (status.HOLDING, status.BODY_LOST)),
    ):
        sender.GetInputPort("enabled").FixValue(context, [sees])
        halves.advance_to(until)
        assert halves.mode() == mode


def test_a_policy_flies_by_the_grid_of_a_sensor(post_world, tmp_path):
    path, random = tmp_path / "weights.npz", np.random.default_rng(0)
    shapes = DIFFAERO_NETWORK.weight_shapes().items()
    weights = {key: random.normal(scale=0.1, size=shape) for key, shape in shapes}
    PolicyCheckpoint("diffaero_tof", DIFFAERO_NETWORK, weights, {}).save(path)
    scenario = Scenario(policy=policy_named(str(path)))
    stream = TimeOfFlightStream(UdpConfig(port=0))
    halves = Halves(scenario, post_world, time_of_flight=stream)
    halves.advance_to(0.1)
    assert halves.mode()[0] == status.WAITING
    port = halves.hardware.GetSubsystemByName("depth_grid_receiver").port
    packet = struct.pack("<IIQ144f", 0x544F4632, 1, 1, *[0.25] * 144)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
        sensor.sendto(packet, ("127.0.0.1", port))
    halves.advance_to(0.3)
    np.testing.assert_array_equal(halves.out("depth_grid"), np.full(144, 0.25))
    assert halves.mode()[0] == status.FLYING
    policy = halves.hardware.GetSubsystemByName("policy")
    desired = policy.GetOutputPort("velocity").Eval(policy.GetMyContextFromRoot(halves.root))
    np.testing.assert_allclose(halves.out("velocity_setpoint")[:3], desired, atol=1e-12)
    assert np.linalg.norm(desired) > 0.01


def test_plans_are_sent(post_world):
    halves = Halves(Scenario(policy=policy_named("planner")), post_world)
    heard, decode = [], lcmt_trajectory_hypotheses.decode
    halves.lcm.subscribe("TRAJECTORY_HYPOTHESES", lambda _, data: heard.append(decode(data)))
    halves.advance_to(0.2)
    while halves.lcm.handle_timeout(0):
        pass
    plan = halves.out("hypotheses")
    assert heard[-1].plan_utime == pytest.approx((plan[0] + 2 * TICK) * 1e6, abs=1)
    np.testing.assert_array_equal(np.ravel(heard[-1].waypoints_P), plan[8 : 8 + 90])


@pytest.mark.parametrize(("setpoints", "speed"), [("velocity", 2.0), ("body_rates", 6.0)])
def test_a_known_obstacle_is_not_flown_into(post_world, setpoints, speed):
    scenario = Scenario(policy=policy_named("straight", speed), start_radius=0.0)
    halves = Halves(scenario, post_world, setpoints=setpoints, tick=0.01)
    closest = np.inf
    for step in range(75):
        halves.advance_to(0.04 * step)
        closest = min(closest, vector_output(halves.vehicle, "clearance", halves.vehicle_root)[0])
    assert halves.mode() == (status.FLYING, status.LIMITED_CLEARANCE)
    assert 0.099 < closest < 0.2


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"scenario": Scenario(sensors={"down": OnboardCamera()})}, "sensors must be .* got down"),
        ({"moving": object()}, "world post must be without moving"),
        ({"config": HardwareConfig(tick=0.0)}, r"tick must be in .* got 0.0"),
        ({"lcm": DrakeLcm("memq://")}, "lcm must be a handle of the package lcm, .*DrakeLcm"),
    ],
)
@pytest.mark.parametrize("build", [BuildHardwareDiagram, BuildVehicleDiagram])
def test_what_messages_cannot_carry_is_refused(post_world, build, given, message):
    transport, config = given.get("lcm", lcm.LCM("memq://")), given.get("config", HardwareConfig())
    world = dataclasses.replace(post_world, moving=given.get("moving"))
    with pytest.raises(ValueError, match=message):
        build(given.get("scenario", Scenario()), world, transport, config)


def test_images_of_another_size_are_rejected(post_world):
    policy = policy_named("diffaero")
    assert isinstance(policy, LearnedPolicyConfig)
    small = dataclasses.replace(policy, camera=OnboardCamera(width=32, height=18))
    halves = Halves(Scenario(policy=policy), post_world, vehicle=Scenario(policy=small))
    halves.advance_to(0.3)
    mode, _, state_age, image_age, _, rejected, _ = halves.out("status")
    assert (mode, image_age, rejected) == (status.WAITING, np.inf, 5) and state_age < 0.04
    assert not halves.heard


def test_both_halves_are_freed(post_world):
    halves = Halves(Scenario(policy=policy_named("diffaero")), post_world)
    transport, freed = halves.lcm, [weakref.ref(d) for d in (halves.vehicle, halves.hardware)]
    halves.advance_to(0.02)
    del halves
    gc.collect()
    assert transport and [reference() for reference in freed] == [None, None]


def test_two_processes_fly(udp_url, tmp_path):
    small = ["--set", "world.length=8", "--set", "world.width=6", "--seed", "2"]
    words = ["--lcm-url", udp_url, "--patience", "60", "--policy", "diffaero", *small]
    log = f"--log={tmp_path}/flight.lcm"
    command, out = [SPLATPILOT, "hardware"], f"--out={tmp_path}/vehicle"
    with subprocess.Popen([*command, "vehicle", out, *words]) as flies:
        try:
            printed = subprocess.check_output([*command, "bridge", log, *words], text=True)
            assert flies.wait(60) == 0
        finally:
            flies.kill()
    assert "outcome        goal" in printed
    summary = json.loads((tmp_path / "vehicle" / "summary.json").read_text())
    assert summary["outcome"] == "goal"
    *_, last = (
        lcmt_quadrotor_state.decode(event.data)
        for event in lcm.EventLog(f"{tmp_path}/flight.lcm")
        if event.channel == "QUADROTOR_STATE"
    )
    # The bridge logs until the goal; the vehicle samples its states every 0.01 s.
    flown = np.load(tmp_path / "vehicle" / "trajectory.npz")["states"][-50:, :3]
    assert np.linalg.norm(flown - last.p_WB, axis=1).min() < 0.02


def test_without_a_vehicle_it_gives_up_and_overwrites_no_log(
    udp_url, post_world, monkeypatch, tmp_path
):
    monkeypatch.setattr(bridge, "make_world", lambda world, seed: post_world)
    log = tmp_path / "log"
    log.write_text("a flight")
    with pytest.raises(OSError, match="must begin with udpm://"):
        bridge.run(scenario=STRAIGHT, config=HardwareConfig(url="tcp://somewhere"))
    config = HardwareConfig(url=udp_url, patience=0.2)
    with pytest.raises(FileExistsError):
        bridge.run(scenario=STRAIGHT, config=config, log=log)
    assert log.read_text() == "a flight"
    with pytest.raises(TimeoutError, match=r"message on QUADROTOR_STATE must come .*start the veh"):
        bridge.run(scenario=STRAIGHT, config=config, log=log, overwrite=True)
    assert log.read_bytes() == b""


IN_CHARGE, NOT_IN_CHARGE = [1.0, 1.0], [1.0, 0.0]
GROUND, AIR = [2.0, 0.0, 0.1], [2.0, 0.0, 1.5]
TIMEOUT = 2.0  # [s]


class Watched:
    """A flight that the bridge watches by the messages of the test."""

    def __init__(self, world):
        self.lcm, self.p_WG = lcm.LCM("memq://"), world.p_WG.tolist()
        scenario = Scenario(policy=policy_named("straight", 1.0), timeout=TIMEOUT)
        config = HardwareConfig(tick=0.01, patience=1.0, failsafe=FailsafeConfig(patience=0.5))
        self.diagram = BuildHardwareDiagram(scenario, world, self.lcm, config)
        self.simulator = Simulator(self.diagram)
        root = self.simulator.get_context()
        self.flight = bridge.BridgeFlight(self.diagram, root, scenario, world.p_WG, config)
        self.senders = {
            codec.port: Harness(MessagePublisher(self.lcm, codec, 0.02))
            for codec in (StateCodec(), VehicleStatusCodec())
        }
        self.tick, self.over = 0, False

    def hear(self, duration: float, charge, p_WB=None) -> None:
        """For `duration` [s]; without a position no states come."""
        for _ in range(round(duration / 0.02)):
            now = 0.02 * self.tick
            noise = 1e-4 * np.sin(now)  # An estimate is never the same for long.
            state = hover_state(np.array(p_WB or [0, 0, 0]) + noise)
            for port, value in (("vehicle_status", charge), ("state", state)):
                sender = self.senders[port]
                sender.context.SetTime(now)
                sender.give(**{port: value}, unix_time=now)
                if port != "state" or p_WB is not None:
                    sender.system.ForcedPublish(sender.context)
            self.simulator.AdvanceTo(now + 1e-3)
            self.over = self.over or self.flight.is_over(now)
            self.tick += 1


@pytest.mark.parametrize(
    ("steps", "outcome"),
    [
        ([(0.8, NOT_IN_CHARGE, where) for where in (GROUND, AIR, "goal", None)], ""),
        ([(1.0, IN_CHARGE, GROUND), (TIMEOUT - 0.1, IN_CHARGE, AIR)], ""),
        ([(1.0, IN_CHARGE, GROUND), (TIMEOUT + 0.1, IN_CHARGE, AIR)], "timeout"),
        ([(0.4, IN_CHARGE, AIR), (0.1, IN_CHARGE, "goal")], "goal"),
        ([(0.4, IN_CHARGE, AIR), (0.1, IN_CHARGE, [2.0, 0.0, 0.3])], "collision"),
        ([(0.4, IN_CHARGE, AIR), (1.4, NOT_IN_CHARGE, [2.0, 0.0, 0.36])], "landed"),
        ([(0.4, IN_CHARGE, AIR), (1.4, IN_CHARGE, None)], "silence"),
        ([(0.4, IN_CHARGE, AIR), (1.4, NOT_IN_CHARGE, "goal")], ""),  # The pilot has taken over.
    ],
)
def test_a_flight_ends_after_it_was_in_the_air_and_in_charge(forest, steps, outcome):
    watched = Watched(forest)
    for duration, charge, where in steps:
        assert not watched.over
        watched.hear(duration, charge, watched.p_WG if where == "goal" else where)
        if charge == NOT_IN_CHARGE and not outcome:
            mode = vector_output(watched.diagram, "status", watched.simulator.get_context())[0]
            assert mode != status.LANDING
    assert (watched.over, watched.flight.outcome) == (bool(outcome), outcome)
    if outcome == "timeout":
        assert watched.flight.duration == pytest.approx(TIMEOUT, abs=0.05)
