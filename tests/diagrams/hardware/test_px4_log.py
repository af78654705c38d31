"""Logs of PX4, which `pyulog` reads, are replayed into the bridge."""

import lcm
import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from ulog_writer import write_log

from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware.bridge import BuildHardwareDiagram
from splatpilot.diagrams.hardware.px4 import BuildPx4Diagram, Px4Config, replay_report
from splatpilot.systems.common.drake import vector_output
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.px4.ulog import LogInbox

VELOCITY = (0.5, 0.0, 0.0)
EPOCH = 1_800_000_000.0  # [s] Unix time when a replay begins.


class Replay:
    """Bridge and PX4's messages, of a log; the test advances them."""

    def __init__(self, path, world):
        self.now, memory = 0.0, lcm.LCM("memq://")
        self.inbox = LogInbox(path, 1, lambda: self.now)
        scenario = Scenario(policy=policy_named("straight", 1.0), goal=[9.0, 2.0, 2.0])
        bridge = BuildHardwareDiagram(scenario, world, memory)
        self.diagrams = {"link": BuildPx4Diagram(Px4Config(), memory, self.inbox), "bridge": bridge}
        self.simulators = {name: Simulator(diagram) for name, diagram in self.diagrams.items()}
        for name, diagram in self.diagrams.items():
            root = self.simulators[name].get_mutable_context()
            diagram.GetSubsystemByName("clock").set_epoch(root, EPOCH)

    def advance(self, until: float) -> None:
        while self.now < until - 1e-9:
            self.now += 0.01
            for simulator in self.simulators.values():
                simulator.AdvanceTo(self.now)

    def out(self, diagram: str, port: str) -> np.ndarray:
        root = self.simulators[diagram].get_context()
        return vector_output(self.diagrams[diagram], port, root)


@pytest.fixture
def replay(tmp_path, post_world):
    def make(*args, **kwargs) -> Replay:
        write_log(tmp_path / "flight.ulg", *args, **kwargs)
        return Replay(tmp_path / "flight.ulg", post_world)

    return make


def test_the_state_of_a_log_reaches_the_bridge_whose_setpoints_are_counted(replay):
    flight = replay(VELOCITY)
    flight.advance(2.5)
    state = flight.out("bridge", "state")
    # The first message of a type may come up to a period after PX4 sent it.
    np.testing.assert_allclose(state[:3], [2.25, 2.0, 2.0], atol=0.02)
    np.testing.assert_allclose(state[3:10], [0.5, 0, 0, 1, 0, 0, 0], atol=0.01)
    assert tuple(flight.out("bridge", "status")[:1]) == (status.FLYING,)
    assert tuple(flight.out("link", "mode")) == (6.0, 0.0) and flight.out("link", "armed")
    assert 0.0 <= flight.out("link", "state_age")[0] <= 0.13
    assert flight.inbox.sent["SET_POSITION_TARGET_LOCAL_NED"] > 100
    assert not flight.inbox.is_over
    flight.advance(3.1)
    assert flight.inbox.is_over and flight.out("link", "rejected")[0] == 0
    report = replay_report(flight.inbox, [np.inf, 0.02, 0.1], 0.0)
    assert "median 0.060, max 0.100" in report and "0.000 0.000 0.000" in report


def test_velocities_that_do_not_fit_the_positions_are_a_jump(replay):
    flight = replay((-0.5, 0.0, 0.0))
    np.testing.assert_allclose(flight.inbox.velocity_error, [1.0, 0.0, 0.0], atol=1e-3)
    flight.advance(2.5)
    assert tuple(flight.out("bridge", "status")[:2]) == (status.HOLDING, status.STATE_JUMPED)


def test_invalid_positions_are_not_sent_and_other_modes_are_not_offboard(replay):
    flight = replay(VELOCITY, nav_state=2, valid=lambda time: time < 1.0)
    flight.advance(2.0)
    assert tuple(flight.out("bridge", "status")[:2]) == (status.HOLDING, status.STATE_OLD)
    assert flight.out("link", "mode")[0] not in (0.0, 6.0)


def test_damaged_files_are_named(tmp_path, capfd):
    (tmp_path / "flight.ulg").write_bytes(b"no log")
    assert main(["hardware", "px4", "--replay", str(tmp_path / "flight.ulg")]) == 1
    assert "flight.ulg must be a ULog" in capfd.readouterr().err
