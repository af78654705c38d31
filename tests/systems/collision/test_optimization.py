import numpy as np
import pytest
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
from pydrake.planning import DirectCollocation
from pydrake.solvers import IpoptSolver, MathematicalProgram, SnoptSolver

from splatpilot.systems.collision.esdf_collision import AddBarrierCost, AddClearanceConstraint
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Sphere
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorPlant, hover_state

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
