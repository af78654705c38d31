import numpy as np
import pytest
from halves import Halves

from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware import vehicle
from splatpilot.diagrams.hardware.bridge import HardwareConfig

STRAIGHT = Scenario(policy=policy_named("straight"))


def test_a_vehicle_without_commands_holds_and_then_lands(post_world):
    halves = Halves(STRAIGHT, post_world, tick=0.01)
    halves.simulators[0].AdvanceTo(0.3)
    np.testing.assert_allclose(halves.state()[3:6], np.zeros(3), atol=1e-6)
    halves.tick = round(0.3 / halves.tick_period)
    halves.advance_to(1.5)
    assert halves.state()[3] > 1.0
    halves.simulators[0].AdvanceTo(5.5)
    p = halves.state()[:3].copy()
    assert np.linalg.norm(halves.state()[3:6]) < 0.05
    assert p[2] == pytest.approx(2.0, abs=0.1)
    halves.simulators[0].AdvanceTo(8.0)
    assert halves.state()[2] == pytest.approx(p[2] - 0.5 * (1.4 - 0.4), abs=0.1)
    np.testing.assert_allclose(halves.state()[:2], p[:2], atol=0.1)


def test_the_vehicle_says_that_it_obeys_the_bridge(post_world):
    halves = Halves(STRAIGHT, post_world)
    assert halves.out("in_charge")[0] == 0
    halves.advance_to(0.3)
    assert halves.out("in_charge")[0] == 1


def test_without_a_bridge_it_gives_up(udp_url, post_world, monkeypatch, tmp_path):
    monkeypatch.setattr(vehicle, "make_world", lambda world, seed: post_world)
    config = HardwareConfig(url=udp_url, patience=0.2)
    with pytest.raises(TimeoutError, match=r"no command has come for 0.2 s; start the bridge"):
        vehicle.run(scenario=STRAIGHT, config=config, out=tmp_path)
