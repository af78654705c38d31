import numpy as np
import pytest
from pydrake.common import RandomDistribution
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, EventStatus, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, RandomSource

from splatpilot.diagrams.flight.flight_diagram import AddFlight, BuildFlightDiagram
from splatpilot.diagrams.flight.monitor import AddFlightMonitor
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.flight.simulation import Outcome, fly, fly_all, make_flight_simulator
from splatpilot.systems.vehicle.flatness import FlatnessController
from splatpilot.systems.vehicle.quadrotor import QuadrotorPlant, hover_state


def toward(name: str, value: list[float]) -> LeafSystem:
    policy = LeafSystem()
    policy.DeclareVectorOutputPort(name, len(value), lambda _, output: output.SetFromVector(value))
    return policy


@pytest.mark.parametrize("accuracy", [None, 1e-5])
def test_any_simulator_ends_with_the_flight(post_world, accuracy):
    scenario = Scenario(policy=policy_named("straight", 6.0), start=[3.0, 0.0, 2.0])
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    if accuracy:
        root.SetAccuracy(accuracy)
    status = simulator.AdvanceTo(20.0)
    assert status.reason() == status.ReturnReason.kReachedTerminationCondition
    assert "monitor: collision" in status.FormatMessage()
    assert diagram.GetOutputPort("outcome").Eval(root) == "collision"
    clearance = diagram.GetOutputPort("clearance").Eval(root)[0]
    assert -(1e-6 if accuracy else 0.2) < clearance <= 0


@pytest.mark.parametrize("speed", [1.0, 6.0])
def test_contact_is_found_to_a_micrometer(post_world, speed):
    scenario = Scenario(policy=policy_named("straight", speed))
    flight = fly(BuildFlightDiagram(scenario, post_world, camera=False))
    assert flight.outcome == Outcome.COLLISION
    assert -1e-6 < flight.clearances[-1] <= 0


def test_goal_and_bounds_end_at_the_exact_instant(post_world):
    scenario = Scenario(start=[8.0, 0.0, 2.0], start_radius=0.0, policy=policy_named("straight"))
    flight = fly(BuildFlightDiagram(scenario, post_world, camera=False))
    to_goal = np.linalg.norm(flight.states[-1, :3] - post_world.p_WG)
    assert flight.outcome == Outcome.GOAL and abs(to_goal - scenario.goal_radius) < 1e-6
    up = toward("velocity", [0.0, 0.0, 2.0])
    flight = fly(BuildFlightDiagram(Scenario(), post_world, camera=False, policy=up))
    assert flight.outcome == Outcome.LEFT_VOLUME
    assert abs(flight.states[-1, 2] - post_world.distance_field.upper_W[2]) < 1e-6


def test_random_sources_repeat_with_the_seed_of_the_scenario(post_world):
    def flown(seed: int) -> np.ndarray:
        builder = DiagramBuilder()
        source = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, 3, 0.1))
        builder.ExportOutput(source.get_output_port(), "velocity")
        scenario = Scenario(seed=seed, timeout=0.5, start_radius=0.0)
        diagram = BuildFlightDiagram(scenario, post_world, camera=False, policy=builder.Build())
        return fly(diagram).states

    first = flown(1)
    np.testing.assert_array_equal(first, flown(1))
    assert np.abs(first - flown(2)).max() > 1e-3


def hand_wired(scenario: Scenario, world) -> DiagramBuilder:
    """Returns a loop of plant and controller that flies 1 m/s along x, with a monitor."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(QuadrotorPlant(None, sample_initial_state(scenario, world)))
    controller = builder.AddSystem(FlatnessController())
    state, command = plant.GetOutputPort("state"), controller.GetOutputPort("command")
    builder.Connect(state, controller.GetInputPort("state"))
    waypoint = builder.AddSystem(ConstantVectorSource(np.array([3.0, 0.0, 2.0])))
    builder.Connect(waypoint.get_output_port(), controller.GetInputPort("waypoint"))
    builder.Connect(command, plant.GetInputPort("command"))
    AddFlightMonitor(builder, scenario, world, state, command)
    return builder


def test_a_loop_wired_by_hand_flies_also_within_another_diagram(post_world):
    scenario = Scenario(goal=[2.5, 0.0, 2.0], timeout=10.0)
    outer = DiagramBuilder()
    outer.AddSystem(hand_wired(scenario, post_world).Build())
    flight = fly(outer.Build())
    assert flight.outcome == Outcome.GOAL
    bare = fly(hand_wired(scenario, post_world).Build())
    np.testing.assert_array_equal(flight.states, bare.states)


class DiscretePlant(LeafSystem):
    """Climbs by thrust less 9.81 m/s^2 as if it were a speed, in steps."""

    def __init__(self, start: np.ndarray) -> None:
        super().__init__()
        self.DeclareVectorInputPort("command", 4)
        self.DeclareStateOutputPort("state", self.DeclareDiscreteState(start))
        self.DeclarePeriodicDiscreteUpdateEvent(0.01, 0.0, self._update)

    def _update(self, context, discrete_state) -> None:
        state = context.get_discrete_state_vector().CopyToVector()
        state[2] += 0.01 * (self.get_input_port().Eval(context)[0] - 9.81)
        discrete_state.set_value(state)


def test_a_discrete_plant_flies_from_its_own_start(post_world):
    plant = DiscretePlant(hover_state([2.0, 0.0, 3.0]))
    systems = {"plant": plant, "policy": toward("command", [10.81, 0.0, 0.0, 0.0])}
    flight = fly(BuildFlightDiagram(Scenario(), post_world, camera=False, **systems))
    assert flight.outcome == Outcome.LEFT_VOLUME
    np.testing.assert_array_equal(flight.states[0, :3], [2.0, 0.0, 3.0])
    assert (flight.commands == [10.81, 0, 0, 0]).all()


def test_a_plant_that_starts_outside_of_the_world_is_refused(post_world):
    plant = QuadrotorPlant(None, hover_state([-5.0, 0.0, 2.0]))
    diagram = BuildFlightDiagram(Scenario(), post_world, camera=False, plant=plant)
    with pytest.raises(ValueError, match=r"at its start, got left_volume; build the plant with"):
        fly(diagram)


def test_a_flight_that_its_caller_ends_keeps_its_record(post_world):
    diagram = BuildFlightDiagram(Scenario(), post_world, camera=False)

    def half_a_second(context):
        if context.get_time() >= 0.5:
            return EventStatus.ReachedTermination(diagram, "enough")
        return None

    def interrupt(time: float) -> None:
        if time >= 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as raised:
        fly(diagram, progress=interrupt)
    for flight in (fly(diagram, monitor=half_a_second), vars(raised.value)["flight"]):
        assert flight.outcome == Outcome.INTERRUPTED
        assert flight.times[-1] == pytest.approx(0.5)


def test_each_of_two_flights_in_a_diagram_has_its_own_end(post_world):
    builder = DiagramBuilder()
    for name, x in (("one", 8.0), ("two", 7.0)):
        scenario = Scenario(start=[x, 0.0, 2.0], start_radius=0.0, policy=policy_named("straight"))
        AddFlight(builder, scenario, post_world, name=name, camera=False)
    diagram = builder.Build()
    flights = fly_all(diagram)
    assert [flight.outcome for flight in flights.values()] == [Outcome.GOAL] * 2
    assert flights["one_monitor"].times[-1] < flights["two_monitor"].times[-1]
    with pytest.raises(ValueError, match="flights in the diagram must be 1, got 2; call fly_all"):
        fly(diagram)


def test_a_diagram_without_monitor_is_refused():
    builder = DiagramBuilder()
    builder.AddSystem(ConstantVectorSource(np.zeros(1)))
    with pytest.raises(ValueError, match="must have a FlightMonitor"):
        make_flight_simulator(builder.Build())
