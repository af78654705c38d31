"""Vehicle, bridge and logger, each a process, between which messages travel by UDP."""

import json
import subprocess
import sys
from pathlib import Path

import lcm
import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware import bridge, vehicle
from splatpilot.diagrams.hardware.bridge import BuildHardwareDiagram, HardwareConfig
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.messaging.codecs import StateCodec, VehicleStatusCodec
from splatpilot.systems.messaging.failsafe import FailsafeConfig
from splatpilot.systems.messaging.generated import lcmt_bridge_status, lcmt_quadrotor_state
from splatpilot.systems.messaging.lcm_ports import MessagePublisher
from splatpilot.systems.vehicle.quadrotor import hover_state

SPLATPILOT = Path(sys.executable).with_name("splatpilot")
SMALL = ["--set", "world.length=10", "--set", "world.width=6", "--seed", "2"]


def small_scenario() -> Scenario:
    return Scenario(seed=2, world=ForestConfig(length=10.0, width=6.0))


def test_three_processes_fly(udp_url, tmp_path):
    log = tmp_path / "flight.lcm"
    words = ["--lcm-url", udp_url, "--patience", "60", "--policy", "diffaero", *SMALL]
    logger = subprocess.Popen(
        [Path(lcm.LCM_BIN_DIR) / "lcm-logger", "--quiet", f"--lcm-url={udp_url}", log]
    )
    flies = subprocess.Popen(
        [SPLATPILOT, "hardware", "vehicle", f"--out={tmp_path}/vehicle", *words]
    )
    try:
        ended = subprocess.run(
            [SPLATPILOT, "hardware", "bridge", *words], capture_output=True, text=True, timeout=240
        )
        assert flies.wait(60) == 0
    finally:
        flies.kill()
        logger.terminate()
        logger.wait()
    assert ended.returncode == 0, ended.stderr
    assert "outcome        goal" in ended.stdout
    summary = json.loads((tmp_path / "vehicle" / "summary.json").read_text())
    assert summary["outcome"] == "goal"
    trajectory = np.load(tmp_path / "vehicle" / "trajectory.npz")
    states = [
        lcmt_quadrotor_state.decode(event.data)
        for event in lcm.EventLog(log)
        if event.channel == "QUADROTOR_STATE"
    ]
    numbers = np.array([state.header.seq for state in states])
    assert (np.diff(numbers[:-1]) == 1).all()  # The last is sent out of turn.
    np.testing.assert_allclose(states[-1].p_WB, trajectory["states"][-1, :3], atol=0.01)


def test_without_the_other_end_both_give_up(udp_url, tmp_path):
    config = HardwareConfig(url=udp_url, patience=0.2)
    with pytest.raises(TimeoutError, match=r"nothing has come on QUADROTOR_STATE .*start the veh"):
        bridge.run(scenario=small_scenario(), config=config)
    with pytest.raises(TimeoutError, match=r"no command has come for 0.2 s; start the bridge"):
        vehicle.run(scenario=small_scenario(), config=config, out=tmp_path)


def test_bad_urls_are_errors_before_the_world_is_made(tmp_path):
    config = HardwareConfig(url="tcp://somewhere")
    with pytest.raises(OSError, match="must begin with udpm://"):
        bridge.run(scenario=small_scenario(), config=config)
    with pytest.raises(OSError, match="must begin with udpm://"):
        vehicle.run(scenario=small_scenario(), config=config, out=tmp_path)


def test_logs_are_not_overwritten(udp_url, tmp_path):
    log = tmp_path / "log"
    log.write_text("a flight")
    config = HardwareConfig(url=udp_url, patience=0.2)
    with pytest.raises(FileExistsError, match="is there already"):
        bridge.run(scenario=small_scenario(), config=config, log=log)
    assert log.read_text() == "a flight"
    with pytest.raises(TimeoutError):
        bridge.run(scenario=small_scenario(), config=config, log=log, overwrite=True)
    assert log.read_bytes() == b""


IN_CHARGE, NOT_IN_CHARGE = [1.0, 1.0], [1.0, 0.0]
CONFIG = HardwareConfig(patience=3.0, failsafe=FailsafeConfig(patience=1.0))


class Watched:
    """A flight that the bridge watches; the test says what it hears of the vehicle."""

    def __init__(self, world):
        self.lcm = lcm.LCM("memq://")
        scenario = Scenario(policy=policy_named("straight", 1.0), timeout=4.0)
        self.diagram = BuildHardwareDiagram(scenario, world, self.lcm, CONFIG)
        self.simulator = Simulator(self.diagram)
        root = self.simulator.get_context()
        self.flight = bridge.BridgeFlight(self.diagram, root, scenario, world.p_WG, CONFIG)
        self.senders = {}
        for codec in (StateCodec(), VehicleStatusCodec()):
            sender = MessagePublisher(self.lcm, codec, 0.02)
            self.senders[codec.port] = sender, sender.CreateDefaultContext()
        self.tick, self.over = 0, False

    def hear(self, duration: float, charge, p_WB=None) -> None:
        """For `duration` [s]; without a position no states come."""
        for _ in range(round(duration / 0.02)):
            now = 0.02 * self.tick
            noise = 1e-4 * np.sin(now)  # An estimate is never the same for long.
            state = hover_state(np.array(p_WB or [0, 0, 0]) + noise)
            for port, value in (("vehicle_status", charge), ("state", state)):
                sender, context = self.senders[port]
                context.SetTime(now)
                sender.GetInputPort(port).FixValue(context, value)
                sender.GetInputPort("unix_time").FixValue(context, [now])
                if port != "state" or p_WB is not None:
                    sender.ForcedPublish(context)
            self.simulator.AdvanceTo(now + 1e-3)
            self.over = self.over or self.flight.is_over(now)
            self.tick += 1

    def mode(self) -> int:
        root = self.simulator.get_context()
        return int(np.asarray(self.diagram.GetOutputPort("status").Eval(root))[0])


@pytest.fixture(scope="module")
def forest():
    return make_world(ForestConfig(length=12.0, width=8.0, height=4.0), 0)


@pytest.fixture
def watched(forest):
    return Watched(forest)


GROUND, AIR = [2.0, 0.0, 0.1], [2.0, 0.0, 1.5]


def test_before_the_bridge_is_in_charge_nothing_ends(watched, forest):
    for where in (GROUND, AIR, forest.p_WG.tolist(), None):
        watched.hear(4.0, NOT_IN_CHARGE, where)
        assert not watched.over
        assert watched.mode() != lcmt_bridge_status.LANDING


def test_a_vehicle_that_takes_off_in_charge_has_not_collided_with_the_ground(watched):
    watched.hear(2.0, IN_CHARGE, GROUND)
    assert not watched.over
    watched.hear(3.9, IN_CHARGE, AIR)
    assert not watched.over
    watched.hear(0.2, IN_CHARGE, AIR)
    assert (watched.over, watched.flight.outcome) == (True, "timeout")
    assert watched.flight.duration == pytest.approx(4.0, abs=0.05)


@pytest.mark.parametrize(
    ("charge", "where", "outcome"),
    [
        (IN_CHARGE, "goal", "goal"),
        (IN_CHARGE, [2.0, 0.0, 0.3], "collision"),
        (NOT_IN_CHARGE, [2.0, 0.0, 0.36], "landed"),
        (IN_CHARGE, None, "silence"),
    ],
)
def test_in_the_air_and_in_charge_a_flight_ends(watched, forest, charge, where, outcome):
    watched.hear(0.5, IN_CHARGE, AIR)
    assert not watched.over
    watched.hear(3.3, charge, forest.p_WG.tolist() if where == "goal" else where)
    assert (watched.over, watched.flight.outcome) == (True, outcome)


def test_a_pilot_who_took_over_ends_no_flight(watched, forest):
    watched.hear(0.5, IN_CHARGE, AIR)
    watched.hear(1.0, NOT_IN_CHARGE, forest.p_WG.tolist())
    assert not watched.over
