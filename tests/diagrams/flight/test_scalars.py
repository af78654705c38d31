import numpy as np
import pytest
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.analysis import (
    ApplySimulatorConfig,
    Simulator_,  # pyright: ignore[reportAttributeAccessIssue]
    SimulatorConfig,
)

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario


def fly_for(diagram, scalar, state, duration):
    """The state (13,) of the plant after a time [s] from a state."""
    simulator = Simulator_[scalar](diagram)
    config = SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=0.02, use_error_control=False
    )
    ApplySimulatorConfig(config, simulator)
    simulator.get_mutable_context().SetContinuousState(state)
    simulator.AdvanceTo(duration)
    return simulator.get_context().get_continuous_state_vector().CopyToVector()


@pytest.mark.parametrize("name", ["planner", "straight"])
def test_a_privileged_flight_with_derivatives_has_the_same_path(post_world, name):
    scenario = Scenario(policy=policy_named(name))
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    start = diagram.CreateDefaultContext().get_continuous_state_vector().CopyToVector()
    expected = fly_for(diagram, float, start, 0.5)
    dual = InitializeAutoDiff(start).ravel()
    found = fly_for(diagram.ToAutoDiffXd(), AutoDiffXd, dual, 0.5)
    np.testing.assert_allclose(ExtractValue(found).ravel(), expected, rtol=0, atol=1e-12)


def test_derivatives_of_a_flight_that_senses_nothing_equal_differences(post_world):
    scenario = Scenario(policy=policy_named("straight"))
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    start = diagram.CreateDefaultContext().get_continuous_state_vector().CopyToVector()
    start[3:6] = [0.3, -0.2, 0.1]
    dual = InitializeAutoDiff(start).ravel()
    gradient = ExtractGradient(fly_for(diagram.ToAutoDiffXd(), AutoDiffXd, dual, 0.3))
    h = 1e-6
    differences = [
        fly_for(diagram, float, start + h * e, 0.3) - fly_for(diagram, float, start - h * e, 0.3)
        for e in np.eye(13)
    ]
    np.testing.assert_allclose(gradient, np.transpose(differences) / (2 * h), rtol=1e-5, atol=1e-6)
