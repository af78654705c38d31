import numpy as np
import pytest

from splatpilot.systems.collision.distance_field import FieldState, soft_barrier
from splatpilot.systems.collision.esdf_collision import EsdfCollision
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Sphere
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

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
