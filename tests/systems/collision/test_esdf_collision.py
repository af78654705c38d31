import numpy as np
import pytest
from pydrake.autodiffutils import (
    AutoDiffXd,
    ExtractGradient,
    ExtractValue,
    InitializeAutoDiff,
)
from pydrake.systems.analysis import (
    ResetIntegratorFromFlags,
    Simulator_,  # pyright: ignore[reportAttributeAccessIssue]
)
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Linearize

from splatpilot.systems.collision.distance_field import FieldState, soft_barrier
from splatpilot.systems.collision.esdf_collision import EsdfCollision
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
