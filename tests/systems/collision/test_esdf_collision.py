import numpy as np
import pytest
from pydrake.autodiffutils import (
    AutoDiffXd,
    ExtractGradient,
    ExtractValue,
    InitializeAutoDiff,
)
from pydrake.planning import DirectCollocation
from pydrake.solvers import IpoptSolver, MathematicalProgram, SnoptSolver
from pydrake.systems.analysis import (
    ResetIntegratorFromFlags,
    Simulator_,  # pyright: ignore[reportAttributeAccessIssue]
)
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Linearize

from splatpilot.systems.collision.distance_field import FieldState, soft_barrier
from splatpilot.systems.collision.esdf_collision import (
    AddBarrierCost,
    AddClearanceConstraint,
    EsdfCollision,
)
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Sphere
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorPlant, hover_state

SIZES = {
    "distance": 1,
    "gradient": 3,
    "clearance": 1,
    "in_collision": 1,
    "barrier": 1,
    "field_state": 1,
}


class CountingField(AnalyticDistanceField):
    """A sphere of radius 1 at the origin that counts its queries."""

    def __init__(self):
        super().__init__([Sphere(np.zeros(3), 1.0)], np.full(3, -5.0), np.full(3, 5.0))
        self.queries = 0

    def query(self, p_WQ):
        self.queries += 1
        return super().query(p_WQ)


def value_of(system, name, context) -> np.ndarray:
    return np.asarray(system.GetOutputPort(name).Eval(context))


def outputs_at(system, p_WB):
    context = system.CreateDefaultContext()
    system.GetInputPort("state").FixValue(context, np.r_[p_WB, np.zeros(3), 1.0, np.zeros(6)])
    return {name: value_of(system, name, context) for name in SIZES}


def test_outputs_beside_an_obstacle():
    out = outputs_at(EsdfCollision(CountingField()), [0.0, 0.0, 2.5])
    assert {name: len(value) for name, value in out.items()} == SIZES
    assert out["distance"][0] == pytest.approx(1.5)
    np.testing.assert_allclose(out["gradient"], [0.0, 0.0, 1.0])
    assert out["clearance"][0] == pytest.approx(1.5 - VEHICLE_RADIUS)
    assert out["in_collision"][0] == 0.0
    assert out["barrier"][0] == pytest.approx(float(soft_barrier(1.5, VEHICLE_RADIUS)))
    assert out["field_state"][0] == FieldState.FREE


def test_outside_the_field_there_is_no_collision():
    out = outputs_at(EsdfCollision(CountingField()), [0.0, 0.0, 5.1])
    for name in ("distance", "clearance", "barrier"):
        assert np.isnan(out[name][0])
    np.testing.assert_array_equal(out["gradient"], 0.0)
    assert out["in_collision"][0] == 0.0
    assert out["field_state"][0] == FieldState.OUTSIDE


def test_all_outputs_share_one_query_and_follow_the_state():
    field = CountingField()
    system = EsdfCollision(field)
    context = system.CreateDefaultContext()
    port = system.GetInputPort("state")
    port.FixValue(context, np.r_[0.0, 0.0, 2.0, np.zeros(10)])
    for name in SIZES:
        system.GetOutputPort(name).Eval(context)
    context.SetTime(1.0)
    system.GetOutputPort("distance").Eval(context)
    assert field.queries == 1
    port.FixValue(context, np.r_[0.0, 0.0, 3.0, np.zeros(10)])
    assert value_of(system, "distance", context)[0] == pytest.approx(2.0)
    assert field.queries == 2


@pytest.mark.parametrize(("name", "value"), [("radius", -0.1), ("beta", 0.0)])
def test_bad_parameters_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be .* got {value}"):
        EsdfCollision(CountingField(), **{name: value})


@pytest.mark.parametrize(("name", "value"), [("Radius", -0.1), ("Beta", 0.0), ("Margin", np.nan)])
def test_bad_parameters_of_a_context_are_refused(name, value):
    system = EsdfCollision(CountingField())
    context = system.CreateDefaultContext()
    with pytest.raises(ValueError, match=f"{name.lower()} must be in .* got {value}"):
        getattr(system, f"Set{name}")(context, value)


def test_parameters_of_a_context_change_the_outputs_without_another_query():
    field = CountingField()
    system = EsdfCollision(field)
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, np.r_[0.0, 0.0, 2.5, np.zeros(10)])
    assert value_of(system, "clearance", context)[0] == pytest.approx(1.5 - VEHICLE_RADIUS)
    system.SetRadius(context, 1.6)
    system.SetBeta(context, 2.0)
    system.SetMargin(context, 0.5)
    assert value_of(system, "clearance", context)[0] == pytest.approx(-0.1)
    assert value_of(system, "in_collision", context)[0] == 1.0
    barrier = float(soft_barrier(1.5, 1.6, 2.0, 0.5))
    assert value_of(system, "barrier", context)[0] == pytest.approx(barrier)
    assert field.queries == 1


@pytest.mark.parametrize("field", [3.0, object()])
def test_what_is_not_a_field_is_named_at_construction(field):
    with pytest.raises(ValueError, match=r"field must be a DistanceField, got a .*distance_field"):
        EsdfCollision(field)


def test_outputs_have_exact_derivatives():
    system = EsdfCollision(CountingField()).ToAutoDiffXd()
    context = system.CreateDefaultContext()
    p_WB = np.array([0.6, 0.0, 0.8]) * 2.5
    state = InitializeAutoDiff(np.r_[p_WB, np.zeros(10)]).ravel()
    system.get_input_port().FixValue(context, state)

    def gradient(name):
        return ExtractGradient(system.GetOutputPort(name).Eval(context))[0, :3]

    np.testing.assert_allclose(gradient("distance"), [0.6, 0.0, 0.8])
    np.testing.assert_allclose(gradient("clearance"), [0.6, 0.0, 0.8])
    slope = -1.0 / (1.0 + np.exp(-4.0 * (VEHICLE_RADIUS + 1.0 - 1.5)))
    np.testing.assert_allclose(gradient("barrier"), slope * np.array([0.6, 0.0, 0.8]))
    system.get_input_port().FixValue(context, ExtractValue(state).ravel())
    system.SetMargin(context, AutoDiffXd(1.0, [1.0]))
    assert gradient("barrier") == pytest.approx(-slope)


def hover_diagram(field) -> Diagram:
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", QuadrotorPlant())
    collision = builder.AddNamedSystem("collision", EsdfCollision(field))
    builder.Connect(plant.get_output_port(), collision.get_input_port())
    builder.ExportInput(plant.get_input_port(), "command")
    builder.ExportOutput(collision.GetOutputPort("barrier"), "barrier")
    return builder.Build()


def test_gradient_of_the_barrier_through_a_simulation_equals_differences():
    diagram = hover_diagram(CountingField())
    autodiff = diagram.ToAutoDiffXd()
    start = hover_state([1.0, -0.5, 1.2])
    start[3:6] = [-0.8, 0.3, 0.2]

    def barrier(x):
        scalar = AutoDiffXd if x.dtype == object else float
        system = autodiff if scalar is AutoDiffXd else diagram
        simulator = Simulator_[scalar](system)
        ResetIntegratorFromFlags(simulator, "runge_kutta3", 0.02)
        simulator.get_mutable_integrator().set_fixed_step_mode(True)
        context = simulator.get_mutable_context()
        system.get_input_port().FixValue(context, [9.81, 0.2, -0.1, 0.3])
        context.SetContinuousState(x)
        simulator.AdvanceTo(0.5)
        return system.GetOutputPort("barrier").Eval(context)[0]

    dual, h = barrier(InitializeAutoDiff(start).ravel()), 1e-5
    steps = h * np.eye(13)
    expected = [(barrier(start + step) - barrier(start - step)) / (2 * h) for step in steps]
    assert dual.value() == barrier(start)
    np.testing.assert_allclose(dual.derivatives(), expected, rtol=1e-5, atol=1e-8)
    assert np.linalg.norm(expected) > 0.1


def test_a_diagram_of_plant_and_collision_is_linearized():
    diagram = hover_diagram(CountingField())
    context = diagram.CreateDefaultContext()
    context.SetContinuousState(hover_state([0.0, 0.0, 2.5]))
    diagram.get_input_port().FixValue(context, [9.81, 0.0, 0.0, 0.0])
    slope = -1.0 / (1.0 + np.exp(-4.0 * (VEHICLE_RADIUS + 1.0 - 1.5)))
    np.testing.assert_allclose(Linearize(diagram, context).C(), [[0, 0, slope, *np.zeros(10)]])


FIELD = AnalyticDistanceField([Sphere(np.zeros(3), 1.0)], np.full(3, -9.0), np.full(3, 9.0))


def test_the_closest_point_with_clearance_is_found():
    prog = MathematicalProgram()
    p_WQ = prog.NewContinuousVariables(3, "p")
    AddClearanceConstraint(prog, FIELD, p_WQ)
    prog.AddQuadraticErrorCost(np.eye(3), np.array([0.3, 0.0, 0.4]), p_WQ)
    result = SnoptSolver().Solve(prog, np.array([2.0, 0.1, 1.0]), None)
    assert result.is_success()
    expected = (1.0 + VEHICLE_RADIUS) * np.array([0.6, 0.0, 0.8])
    np.testing.assert_allclose(result.GetSolution(p_WQ), expected, atol=1e-4)


def test_the_barrier_balances_a_pull():
    prog = MathematicalProgram()
    p_WQ = prog.NewContinuousVariables(3, "p")
    AddBarrierCost(prog, FIELD, p_WQ, radius=0.3, beta=5.0, margin=0.7)
    prog.AddLinearCost(np.array([0.0, 0.0, 0.5]), 0.0, p_WQ)
    prog.AddBoundingBoxConstraint(0.0, 0.0, p_WQ[:2])
    result = IpoptSolver().Solve(prog, np.array([0.0, 0.0, 2.5]), None)
    # The slope of the barrier is one half where the distance is radius + margin.
    np.testing.assert_allclose(result.GetSolution(p_WQ), [0.0, 0.0, 2.0], atol=1e-4)


def test_direct_collocation_flies_around_a_sphere():
    plant, start, goal = QuadrotorPlant(), hover_state([-2.5, 0, 0]), hover_state([2.5, 0, 0])
    context = plant.CreateDefaultContext()
    collocation = DirectCollocation(
        plant,
        context,
        num_time_samples=13,
        minimum_time_step=0.1,
        maximum_time_step=0.4,
        input_port_index=plant.GetInputPort("command").get_index(),
    )
    prog = collocation.prog()
    collocation.AddEqualTimeIntervalsConstraints()
    prog.AddBoundingBoxConstraint(start, start, collocation.initial_state())
    prog.AddBoundingBoxConstraint(goal[:6], goal[:6], collocation.final_state()[:6])
    for k in range(13):
        AddClearanceConstraint(prog, FIELD, collocation.state(k)[:3])
        prog.AddBoundingBoxConstraint([2, -6, -6, -6], [20, 6, 6, 6], collocation.input(k))
        prog.SetInitialGuess(collocation.input(k), [9.81, 0.0, 0.0, 0.0])
        s = k / 12
        guess = (1 - s) * start + s * goal
        guess[1] = 2.0 * np.sin(np.pi * s)
        prog.SetInitialGuess(collocation.state(k), guess)
        prog.SetInitialGuess(collocation.time_step(min(k, 11)), [0.3])
    result = SnoptSolver().Solve(prog, None, None)
    assert result.is_success()
    points = np.array([result.GetSolution(collocation.state(k))[:3] for k in range(13)])
    assert FIELD.distance(points).min() > VEHICLE_RADIUS - 1e-4


def test_costs_and_constraints_have_exact_gradients():
    prog = MathematicalProgram()
    p_WQ = prog.NewContinuousVariables(3, "p")
    bindings = AddClearanceConstraint(prog, FIELD, p_WQ), AddBarrierCost(prog, FIELD, p_WQ)
    p = np.array([1.0, 0.5, -1.5])
    for binding in bindings:
        evaluator = binding.evaluator()
        gradient = ExtractGradient(evaluator.Eval(InitializeAutoDiff(p)))[0]
        h = 1e-6
        differences = [
            evaluator.Eval(p + h * e)[0] - evaluator.Eval(p - h * e)[0] for e in np.eye(3)
        ]
        np.testing.assert_allclose(gradient, np.array(differences) / (2 * h), atol=1e-8)


@pytest.mark.parametrize("add", [AddClearanceConstraint, AddBarrierCost])
def test_a_point_has_three_variables(add):
    prog = MathematicalProgram()
    with pytest.raises(ValueError, match=r"shape of p_WQ must be \(3,\), got \(2,\)"):
        add(prog, FIELD, prog.NewContinuousVariables(2, "p"))
