"""Distances and collisions as a Drake system, and in a MathematicalProgram."""

import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.solvers import MathematicalProgram
from pydrake.systems.framework import (
    LeafSystem_,  # pyright: ignore[reportAttributeAccessIssue]
    ValueProducer,
)

from splatpilot.systems.collision.distance_field import (
    DistanceField,
    FieldSample,
    in_collision,
    sample_field,
    soft_barrier,
)
from splatpilot.systems.common.drake import ConfigParameter, parameter_setter, system_template
from splatpilot.systems.common.validation import Config, bounded, require
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState


@dataclass
class BarrierParams(Config):
    """Parameters of `soft_barrier`."""

    # [m] Radius of the vehicle.
    radius: float = bounded(VEHICLE_RADIUS, "[0, inf) m")
    # [1/m] Sharpness.
    beta: float = bounded(4.0, "(0, inf) 1/m")
    # [m] Clearance at which the barrier rises.
    margin: float = bounded(1.0, "(-inf, inf) m")


@system_template("EsdfCollision_")
def EsdfCollision_(T):
    class EsdfCollision(LeafSystem_[T]):
        """Computes the distance to obstacles and the collision signals of a vehicle.

        .. pydrake_system::

            name: EsdfCollision
            input_ports: [state, moving (optional)]
            output_ports: [distance, gradient, clearance, in_collision, barrier, field_state]

        `distance` [m] is that of p_WB to occupied surfaces and bodies of `moving`, see
        `MovingBodies`, `gradient` its derivative by p_WB in W, `clearance` [m] the distance less
        the radius of the vehicle, `in_collision` 1 if that is negative, `barrier` [m] that of
        `soft_barrier`, and `field_state` a `FieldState`. Outside the field's bounds distance,
        clearance and barrier are NaN, the gradient is zero and there is no collision.

        Numeric parameter 0 (3): ``[radius [m], beta [1/m], margin [m]]``. Supports the scalars
        float and AutoDiffXd, by the exact gradient; `gradient` itself has zero derivatives, and so
        has the motion of obstacles.
        """

        def __init__(
            self,
            field: DistanceField,
            radius: float = VEHICLE_RADIUS,
            beta: float = 4.0,
            margin: float = 1.0,
            *,
            converter: Any = None,
        ) -> None:
            super().__init__(converter=converter)
            name, valid = type(field).__name__, hasattr(field, "query")
            remedy = "pass the `distance_field` of a world"
            require(valid, "field", "a DistanceField", f"a {name}", remedy)
            params = BarrierParams(radius, beta, margin)
            params.validate()
            self._field = field
            self._parameters = [ConfigParameter(self, T, params)]
            self.DeclareVectorInputPort("state", 13)
            self.DeclareAbstractInputPort("moving", AbstractValue.Make(object()))
            # Drake never frees a system that its own callbacks refer to.
            collision = weakref.proxy(self)
            cache = self.DeclareCacheEntry(
                description="sample of the distance field at p_WB",
                value_producer=ValueProducer(
                    allocate=lambda: AbstractValue.Make(object()),
                    calc=lambda context, sample: collision._sample(context, sample),
                ),
                prerequisites_of_calc={self.all_input_ports_ticket()},
            )
            index, tickets = cache.cache_index(), {cache.ticket(), self.all_parameters_ticket()}

            def declare(name, value_of, size=1):
                def calc(context, output):
                    sample = collision.get_cache_entry(index).Eval(context)
                    value = value_of(sample, context.get_numeric_parameter(0))
                    # Setting one number costs a fraction of setting an array.
                    output.SetFromVector(value) if size > 1 else output.SetAtIndex(0, value)

                self.DeclareVectorOutputPort(name, size, calc, prerequisites_of_calc=tickets)

            declare("distance", lambda sample, _: sample.distance)
            declare("gradient", lambda sample, _: sample.gradient, 3)
            declare("clearance", lambda sample, each: sample.distance - each[0])
            declare("in_collision", lambda each, p: 1.0 * in_collision(each.distance, p[0]))
            declare("barrier", lambda sample, each: soft_barrier(sample.distance, *each.value()))
            declare("field_state", lambda sample, _: sample.state)

        def get_input_port(self, port_index=0):
            """Returns an input port by its index; `state` by default."""
            return super().get_input_port(port_index)

        SetRadius = parameter_setter("radius")
        SetBeta = parameter_setter("beta")
        SetMargin = parameter_setter("margin")

        def _sample(self, context: Any, sample: Any) -> None:
            state = self.EvalVectorInput(context, 0)
            if state is None:  # Drake raises.
                self.get_input_port().Eval(context)
            assert state is not None
            moving, field = self.EvalAbstractInput(context, 1), self._field
            if moving is not None and (bodies := moving.get_value()):
                field = bodies.among(field, bodies.time)
            distance, gradient, space = sample_field(field, QuadrotorState.of(state.value()).p_WB)
            sample.set_value(FieldSample(np.asarray(distance).item(), gradient, float(space)))

    return EsdfCollision


EsdfCollision = EsdfCollision_[None]


def AddClearanceConstraint(
    prog: MathematicalProgram, field: DistanceField, p_WQ: np.ndarray, lower: float = VEHICLE_RADIUS
) -> Any:
    """Adds the constraint distance(p_WQ) >= lower [m], and returns its Binding.

    Args:
        field: has distances everywhere, as `Esdf.conservative`; NaN stops solvers.
        p_WQ: (3,) decision variables [m].
    """

    def distance(p: Any) -> np.ndarray:
        return np.array([_distance(field, p)])

    bounds = np.array([lower]), np.array([np.inf])
    return prog.AddConstraint(distance, *bounds, vars=_point(p_WQ))


def AddBarrierCost(
    prog: MathematicalProgram,
    field: DistanceField,
    p_WQ: np.ndarray,
    radius: float = VEHICLE_RADIUS,
    beta: float = 4.0,
    margin: float = 1.0,
) -> Any:
    """Adds the `soft_barrier` of distance(p_WQ) to the cost, and returns its Binding; for arguments
    see there and `AddClearanceConstraint`."""
    return prog.AddCost(
        lambda p: soft_barrier(_distance(field, p), radius, beta, margin), vars=_point(p_WQ)
    )


def _distance(field: DistanceField, p_WQ: Any) -> Any:
    return sample_field(field, p_WQ).distance


def _point(p_WQ: np.ndarray) -> np.ndarray:
    require(np.shape(p_WQ) == (3,), "the shape of p_WQ", "(3,)", np.shape(p_WQ))
    return p_WQ
