"""Every policy flies, and is found by its name."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.diagrams.flight import policies
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import (
    BENCHMARK_POLICIES,
    POLICIES,
    PolicyEntry,
    at_speed,
    policy_name,
    policy_named,
    policy_speed,
    register_policy,
)
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.simulation import Outcome, fly
from splatpilot.systems.common.registry import Registry
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.depthnav import DEPTHNAV_NETWORK, DepthNavConfig


@dataclass
class _OneSpeedConfig:
    """Configures a policy with a fixed speed."""

    def validate(self) -> None: ...


@pytest.mark.parametrize(
    ("name", "outcome"), [("straight", Outcome.COLLISION), ("reactive", Outcome.GOAL)]
)
def test_policies_fly_toward_a_post(name, outcome, post_world):
    scenario = Scenario(timeout=20.0, start_radius=0.0, policy=policy_named(name))
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    flight = fly(diagram)
    assert flight.outcome == outcome
    assert flight.hypotheses.shape == (0, 0)
    assert diagram.HasSubsystemNamed("policy_camera") == (name == "reactive")
    assert not diagram.HasSubsystemNamed("camera")


def test_the_scenario_camera_changes_no_flight(post_world):
    scenario = Scenario(timeout=1.0, policy=policy_named("reactive"))
    scenario.camera.width, scenario.camera.height = 32, 24
    bare = fly(BuildFlightDiagram(scenario, post_world, camera=False))
    shown = BuildFlightDiagram(scenario, post_world, Meshcat(), video=True)
    watched = fly(shown)
    np.testing.assert_array_equal(bare.states, watched.states)


@pytest.mark.parametrize("name", BENCHMARK_POLICIES)
def test_name_gives_a_policy_of_that_speed(name, post_world):
    reach = []
    for speed in (1.5, 3.0):
        scenario = Scenario(timeout=1.5, start_radius=0.0, policy=policy_named(name, speed))
        diagram = BuildFlightDiagram(scenario, post_world, camera=False)
        states = fly(diagram).states
        assert np.linalg.norm(states[:, 3:6], axis=1).max() < 1.3 * speed
        reach.append(np.linalg.norm(states[-1, :3] - states[0, :3]))
    assert reach[1] > 1.2 * reach[0] > 0.5


def test_unknown_policy_and_speed_are_refused():
    with pytest.raises(ValueError, match=r"no policy 'Planner'; did you mean planner\?"):
        policy_named("Planner")
    with pytest.raises(ValueError, match=r"speed .* got -1"):
        policy_named("planner", -1.0)


def test_types_that_can_be_no_configuration_are_refused():

    @dataclass
    class BareConfig:
        rate: float = 10.0

    class PlainConfig:
        def validate(self) -> None: ...

    @dataclass
    class SetConfig(PlainConfig):
        names: set = field(default_factory=set)

    @dataclass
    class OpenConfig(PlainConfig):
        rate: float

    for config, message in (
        (BareConfig, r"BareConfig has no method validate\(\); derive it"),
        (PlainConfig, "PlainConfig must be a dataclass, got .*; decorate it"),
        (SetConfig, r"SetConfig makes no YAML \(NotImplementedError: .*'set'.*; give all fields"),
        (OpenConfig, r"OpenConfig makes no YAML \(TypeError: .*'rate'.*; give all fields defaults"),
    ):
        with pytest.raises(ValueError, match=message):
            register_policy(config, lambda config, world, scenario: None)


def test_file_of_weights_is_a_policy(tmp_path):
    PolicyCheckpoint("depthnav", DEPTHNAV_NETWORK, {}, {}).save(tmp_path / "mine.npz")
    config = policy_named(str(tmp_path / "mine.npz"), 1.5)
    assert config == DepthNavConfig(speed=1.5, weights=str(tmp_path / "mine.npz"))
    with pytest.raises(FileNotFoundError, match=r"No such file of weights: .*absent.npz"):
        policy_named(str(tmp_path / "absent.npz"))
    (tmp_path / "text.npz").write_text("nothing")
    with pytest.raises(ValueError, match=r"text.npz must hold weights"):
        policy_named(str(tmp_path / "text.npz"))


@pytest.mark.parametrize("name", POLICIES.registered())
def test_speed_is_set_where_the_configuration_keeps_it(name):
    config = policy_named(name)
    assert policy_name(config) == name
    faster = at_speed(config, 3.0)
    assert (policy_speed(config), policy_speed(faster)) == (2.0, 3.0)
    assert at_speed(faster, 2.0) == config


def test_policy_that_knows_one_speed_refuses_others(monkeypatch):
    monkeypatch.setattr(policies, "POLICIES", Registry("policy", "none", PolicyEntry))
    register_policy(_OneSpeedConfig, lambda config, world, scenario: ConstantVectorSource([0.0]))
    assert policy_speed(_OneSpeedConfig()) is None
    with pytest.raises(ValueError, match=r"speed of .*_onespeed must be left out"):
        at_speed(_OneSpeedConfig(), 3.0)
