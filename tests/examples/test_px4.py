"""The files of `examples/px4` fly a stand-in for PX4, as `fly.sh` flies PX4."""

import re
from pathlib import Path

import lcm
import pytest
import yaml
from px4_stand_in import OFFBOARD, Px4StandIn
from pydrake.systems.analysis import Simulator

import splatpilot as sp
from splatpilot.diagrams.hardware.bridge import BuildHardwareDiagram, HardwareConfig
from splatpilot.diagrams.hardware.px4 import BuildPx4Diagram, Px4Config
from splatpilot.systems.messaging.receiver import UdpConfig, UdpInbox
from splatpilot.systems.px4.commander import Px4CommanderConfig

FILES = Path(__file__).parents[2] / "examples/px4"
PAGE = Path(__file__).parents[2] / "docs/px4.md"


def test_compose_sets_the_parameters_of_the_page():
    service = yaml.safe_load((FILES / "compose.yaml").read_text())["services"]["px4"]
    names = {name.removeprefix("PX4_PARAM_") for name in service["environment"]}
    rows = re.findall(r"^\| ([A-Z0-9_, ]+) \| ([^|]+) \|", PAGE.read_text(), re.MULTILINE)
    page = {name: value for row, value in rows for name in row.split(", ")}
    for name in names - {"PX4_SIM_MODEL", "NAV_DLL_ACT", "COM_RCL_EXCEPT", "MPC_XY_VEL_MAX"}:
        value = service["environment"][f"PX4_PARAM_{name}"]
        assert value in re.findall(r"[\d.]+", page[name]), name
    limits = sp.load_config(HardwareConfig(), FILES / "hardware.yaml").failsafe.limits
    assert float(service["environment"]["PX4_PARAM_MPC_XY_VEL_MAX"]) <= limits.max_speed
    assert service["network_mode"] == "host"
    assert (Px4Config().udp.port, Px4Config().vehicle_port) == (14540, 14580)


def test_the_stand_in_takes_off_and_flies(monkeypatch):
    monkeypatch.chdir(FILES)
    scenario = sp.load_config(sp.Scenario(), Path("scenario.yaml"))
    scenario.policy = sp.policy_named("straight", 1.5)  # is faster than the planner
    hardware = sp.load_config(HardwareConfig(tick=0.01), Path("hardware.yaml"))
    world, memory = sp.make_world(scenario.world, scenario.seed), lcm.LCM("memq://")
    px4, inbox = Px4StandIn("1.18", [0.0, 0.0, 0.0]), UdpInbox(UdpConfig(port=0))
    px4.peer = ("127.0.0.1", inbox.port)
    commander = Px4CommanderConfig(engage=True, arm=True)
    config = Px4Config(vehicle_port=px4.port, tick=0.01, commander=commander)
    diagrams = [
        BuildHardwareDiagram(scenario, world, memory, hardware),
        BuildPx4Diagram(config, memory, inbox),
    ]
    simulators = [Simulator(diagram) for diagram in diagrams]
    for simulator, diagram in zip(simulators, diagrams, strict=True):
        diagram.GetSubsystemByName("clock").set_epoch(simulator.get_mutable_context(), 1.8e9)
    clearance = []
    for tick in range(1, 700):
        for simulator in simulators:
            simulator.AdvanceTo(0.01 * tick)
        px4.step(0.01 * tick)
        if px4.state[2] > 0.5:
            clearance.append(world.distance_field.query(px4.state[:3])[0])
        if px4.state[0] > 2.0:
            break
    else:
        pytest.fail(f"it must come 2 m far, got {px4.state[:3]}")
    px4.socket.close()
    inbox.close()
    assert px4.mode == OFFBOARD and px4.armed
    assert min(clearance) > 0.1
