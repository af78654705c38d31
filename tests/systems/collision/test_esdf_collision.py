import numpy as np
import pytest
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.solvers import IpoptSolver, MathematicalProgram, SnoptSolver

from splatpilot.systems.collision.distance_field import FieldState, soft_barrier
from splatpilot.systems.collision.esdf_collision import (
    AddBarrierCost,
    AddClearanceConstraint,
    EsdfCollision,
)
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Sphere
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

SIZES = {"distance": 1, "gradient": 3, "clearance": 1}
SIZES |= {"in_collision": 1, "barrier": 1, "field_state": 1}
FIELD = AnalyticDistanceField([Sphere(np.zeros(3), 1.0)], np.full(3, -9.0), np.full(3, 9.0))
BARRIER = float(soft_barrier(1.5, VEHICLE_RADIUS))
SLOPE = -1.0 / (1.0 + np.exp(-4.0 * (VEHICLE_RADIUS + 1.0 - 1.5)))  # of the barrier, at 1.5 m


class CountingField(AnalyticDistanceField):
    queries = 0

    def __init__(self):
        super().__init__([Sphere(np.zeros(3), 1.0)], np.full(3, -5.0), np.full(3, 5.0))

    def query(self, p_WQ):
        self.queries += 1
        return super().query(p_WQ)


def value_of(system, name, context) -> np.ndarray:
    return np.asarray(system.GetOutputPort(name).Eval(context))


@pytest.mark.parametrize(
    ("z", "expected"),
    [
        (2.5, [1.5, [0, 0, 1], 1.5 - VEHICLE_RADIUS, 0, BARRIER, FieldState.FREE]),
        (5.1, [np.nan, [0, 0, 0], np.nan, 0, np.nan, FieldState.OUTSIDE]),
    ],
)
def test_outputs_beside_an_obstacle_and_outside_the_field(z, expected):
    system = EsdfCollision(CountingField())
    context = system.CreateDefaultContext()
    system.GetInputPort("state").FixValue(context, np.r_[0.0, 0.0, z, np.zeros(10)])
    for (name, size), value in zip(SIZES.items(), expected, strict=True):
        found = value_of(system, name, context)
        np.testing.assert_allclose(found, np.broadcast_to(value, size), atol=1e-12)


@pytest.mark.parametrize(("name", "value"), [("radius", -0.1), ("beta", 0.0), ("margin", np.nan)])
def test_bad_parameters_are_refused(name, value):
    message = f"{name} must be in .* got {value}"
    with pytest.raises(ValueError, match=message):
        EsdfCollision(FIELD, **{name: value})
    system = EsdfCollision(FIELD)
    with pytest.raises(ValueError, match=message):
        getattr(system, f"Set{name.title()}")(system.CreateDefaultContext(), value)


def test_all_outputs_and_parameters_share_one_query_of_a_state():
    field = CountingField()
    system = EsdfCollision(field)
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, np.r_[0.0, 0.0, 2.5, np.zeros(10)])
    for name in SIZES:
        system.GetOutputPort(name).Eval(context)
    context.SetTime(1.0)
    assert value_of(system, "clearance", context)[0] == pytest.approx(1.5 - VEHICLE_RADIUS)
    system.SetRadius(context, 1.6)
    system.SetBeta(context, 2.0)
    system.SetMargin(context, 0.5)
    assert value_of(system, "clearance", context)[0] == pytest.approx(-0.1)
    assert value_of(system, "in_collision", context)[0] == 1.0
    barrier = float(soft_barrier(1.5, 1.6, 2.0, 0.5))
    assert value_of(system, "barrier", context)[0] == pytest.approx(barrier)
    assert field.queries == 1
    system.get_input_port().FixValue(context, np.r_[0.0, 0.0, 3.0, np.zeros(10)])
    assert value_of(system, "distance", context)[0] == pytest.approx(2.0)
    assert field.queries == 2


@pytest.mark.parametrize("field", [3.0, object()])
def test_what_is_not_a_field_is_named_at_construction(field):
    with pytest.raises(ValueError, match=r"field must be a DistanceField, got a .*distance_field"):
        EsdfCollision(field)


def test_outputs_have_exact_derivatives():
    system = EsdfCollision(FIELD).ToAutoDiffXd()
    context = system.CreateDefaultContext()
    p_WB = np.array([0.6, 0.0, 0.8]) * 2.5
    state = InitializeAutoDiff(np.r_[p_WB, np.zeros(10)]).ravel()
    system.get_input_port().FixValue(context, state)

    def gradient(name):
        return ExtractGradient(system.GetOutputPort(name).Eval(context))[0, :3]

    np.testing.assert_allclose(gradient("distance"), [0.6, 0.0, 0.8])
    np.testing.assert_allclose(gradient("clearance"), [0.6, 0.0, 0.8])
    np.testing.assert_allclose(gradient("barrier"), SLOPE * np.array([0.6, 0.0, 0.8]))
    system.get_input_port().FixValue(context, ExtractValue(state).ravel())
    system.SetMargin(context, AutoDiffXd(1.0, [1.0]))
    assert gradient("barrier") == pytest.approx(-SLOPE)


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


def test_costs_and_constraints_have_exact_gradients():
    prog = MathematicalProgram()
    p_WQ = prog.NewContinuousVariables(3, "p")
    bindings = AddClearanceConstraint(prog, FIELD, p_WQ), AddBarrierCost(prog, FIELD, p_WQ)
    p = np.array([1.0, 0.5, -1.5])
    for binding in bindings:
        evaluator = binding.evaluator()
        gradient = ExtractGradient(evaluator.Eval(InitializeAutoDiff(p)))[0]
        steps = 1e-6 * np.eye(3)
        differences = [evaluator.Eval(p + h)[0] - evaluator.Eval(p - h)[0] for h in steps]
        np.testing.assert_allclose(gradient, np.array(differences) / 2e-6, atol=1e-8)


@pytest.mark.parametrize("add", [AddClearanceConstraint, AddBarrierCost])
def test_a_point_has_three_variables(add):
    prog = MathematicalProgram()
    with pytest.raises(ValueError, match=r"shape of p_WQ must be \(3,\), got \(2,\)"):
        add(prog, FIELD, prog.NewContinuousVariables(2, "p"))
