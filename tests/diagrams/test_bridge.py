"""Vehicle, bridge and logger, each a process, between which messages travel by UDP."""

import json
import subprocess
import sys
from pathlib import Path

import lcm
import numpy as np
import pytest

from splatpilot.diagrams import bridge, vehicle
from splatpilot.diagrams.hardware_config import HardwareConfig
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.systems.messaging.generated import lcmt_quadrotor_state

SPLATPILOT = Path(sys.executable).with_name("splatpilot")
SMALL = ["--set", "world.length=10", "--set", "world.width=6", "--seed", "2"]


def small_scenario() -> Scenario:
    return Scenario(seed=2, world=ForestConfig(length=10.0, width=6.0))


def test_three_processes_fly(udp_url, tmp_path):
    """A vehicle, who flies it and lcm-logger, three processes, reach the goal of a forest by
    images; the log and the vehicle agree on the way, and every state is there."""
    log = tmp_path / "flight.lcm"
    words = ["--lcm-url", udp_url, "--patience", "60", "--policy", "diffaero", *SMALL]
    logger = subprocess.Popen(
        [Path(lcm.LCM_BIN_DIR) / "lcm-logger", "--quiet", f"--lcm-url={udp_url}", log]
    )
    flies = subprocess.Popen([SPLATPILOT, "vehicle", "--out", tmp_path / "vehicle", *words])
    try:
        ended = subprocess.run(
            [SPLATPILOT, "bridge", *words], capture_output=True, text=True, timeout=240
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
    """A bridge without a vehicle and a vehicle without commands end with an error that names what
    did not come and the remedy."""
    config = HardwareConfig(url=udp_url, patience=0.2)
    with pytest.raises(TimeoutError, match=r"nothing has come on QUADROTOR_STATE .*start the veh"):
        bridge.run(scenario=small_scenario(), config=config)
    with pytest.raises(TimeoutError, match=r"no command has come for 0.2 s; start the bridge"):
        vehicle.run(scenario=small_scenario(), config=config, out=tmp_path)


def test_bad_urls_are_errors_before_the_world_is_made(tmp_path):
    """Where LCM does not work, that is the first thing to be said."""
    config = HardwareConfig(url="tcp://somewhere")
    with pytest.raises(OSError, match="must begin with udpm://"):
        bridge.run(scenario=small_scenario(), config=config)
    with pytest.raises(OSError, match="must begin with udpm://"):
        vehicle.run(scenario=small_scenario(), config=config, out=tmp_path)


def test_logs_are_not_overwritten(udp_url, tmp_path):
    """A log that is there already is an error before anything is waited for, unless it may be."""
    log = tmp_path / "log"
    log.write_text("a flight")
    config = HardwareConfig(url=udp_url, patience=0.2)
    with pytest.raises(FileExistsError, match="is there already"):
        bridge.run(scenario=small_scenario(), config=config, log=log)
    assert log.read_text() == "a flight"
    with pytest.raises(TimeoutError):
        bridge.run(scenario=small_scenario(), config=config, log=log, overwrite=True)
    assert log.read_bytes() == b""
