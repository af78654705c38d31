from dataclasses import field, make_dataclass

import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.diagrams.flight import policies
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.simulation import Outcome, fly
from splatpilot.systems.common.registry import Registry
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.depthnav import DEPTHNAV_NETWORK, DepthNavConfig


@pytest.mark.parametrize(
    ("name", "outcome"), [("straight", Outcome.COLLISION), ("reactive", Outcome.GOAL)]
)
def test_policies_fly_toward_a_post(name, outcome, post_world):
    scenario = Scenario(policy=policies.policy_named(name))
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    flight = fly(diagram)
    assert flight.outcome == outcome and flight.hypotheses.shape == (0, 0)
    assert diagram.HasSubsystemNamed("policy_camera") == (name == "reactive")
    assert not diagram.HasSubsystemNamed("camera")


def test_the_scenario_camera_changes_no_flight(post_world):
    scenario = Scenario(timeout=0.5, policy=policies.policy_named("reactive"))
    scenario.camera.width, scenario.camera.height = 32, 24
    bare = fly(BuildFlightDiagram(scenario, post_world, camera=False))
    watched = fly(BuildFlightDiagram(scenario, post_world, Meshcat(), video=True))
    np.testing.assert_array_equal(bare.states, watched.states)


@pytest.mark.parametrize(
    "name", ["planner", "straight", "reactive", "diffaero", "depthnav", "agile_autonomy"]
)
def test_name_gives_a_policy_of_that_speed(name, post_world):
    reach = []
    for speed in (1.5, 3.0):
        policy = policies.policy_named(name, speed)
        scenario = Scenario(timeout=1.5, start_radius=0.0, policy=policy)
        states = fly(BuildFlightDiagram(scenario, post_world, camera=False)).states
        assert np.linalg.norm(states[:, 3:6], axis=1).max() < 1.3 * speed
        reach.append(np.linalg.norm(states[-1, :3] - states[0, :3]))
    assert reach[1] > 1.2 * reach[0] > 0.5


def test_unknown_policy_and_speed_are_refused():
    with pytest.raises(ValueError, match=r"no policy 'Planner'; did you mean planner\?"):
        policies.policy_named("Planner")
    with pytest.raises(ValueError, match=r"speed .* got -1"):
        policies.policy_named("planner", -1.0)


class Plain:
    def validate(self) -> None: ...


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (make_dataclass("Bare", [("rate", float, 10.0)]), r"Bare has no method validate\(\); d"),
        (Plain, "Plain must be a dataclass, got .*; decorate it"),
        (
            make_dataclass("Sets", [("names", set, field(default_factory=set))], bases=(Plain,)),
            r"Sets makes no YAML \(NotImplementedError: .*'set'.*; give all fields",
        ),
        (
            make_dataclass("Open", [("rate", float)], bases=(Plain,)),
            r"Open makes no YAML \(TypeError: .*'rate'.*; give all fields defaults",
        ),
    ],
)
def test_types_that_can_be_no_configuration_are_refused(config, message):
    with pytest.raises(ValueError, match=message):
        policies.register_policy(config, lambda config, world, scenario: None)


def test_file_of_weights_is_a_policy(tmp_path):
    PolicyCheckpoint("depthnav", DEPTHNAV_NETWORK, {}, {}).save(tmp_path / "mine.npz")
    config = policies.policy_named(str(tmp_path / "mine.npz"), 1.5)
    assert config == DepthNavConfig(speed=1.5, weights=str(tmp_path / "mine.npz"))
    with pytest.raises(FileNotFoundError, match=r"No such file of weights: .*absent.npz"):
        policies.policy_named(str(tmp_path / "absent.npz"))
    (tmp_path / "text.npz").write_text("nothing")
    with pytest.raises(ValueError, match=r"text.npz must hold weights"):
        policies.policy_named(str(tmp_path / "text.npz"))


@pytest.mark.parametrize("name", policies.POLICIES.registered())
def test_speed_is_set_where_the_configuration_keeps_it(name):
    config = policies.policy_named(name)
    assert policies.policy_name(config) == name
    faster = policies.at_speed(config, 3.0)
    assert (policies.policy_speed(config), policies.policy_speed(faster)) == (2.0, 3.0)
    assert policies.at_speed(faster, 2.0) == config


def test_policy_that_knows_one_speed_refuses_others(monkeypatch):
    config = make_dataclass("OneSpeedConfig", [], bases=(Plain,))
    monkeypatch.setattr(policies, "POLICIES", Registry("policy", "none", policies.PolicyEntry))
    policies.register_policy(config, lambda config, world, scenario: ConstantVectorSource([0.0]))
    assert policies.policy_speed(config()) is None
    with pytest.raises(ValueError, match=r"speed of .*onespeed must be left out"):
        policies.at_speed(config(), 3.0)
