"""A Drake system for distances and collisions of a vehicle."""

import weakref
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import LeafSystem, ValueProducer

from splatpilot.systems.collision.distance_field import DistanceField, in_collision, soft_barrier
from splatpilot.systems.common.drake import optional_value, vector_input
from splatpilot.systems.common.validation import require
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState


class EsdfCollision(LeafSystem):
    """Computes the distance to obstacles and the collision signals of a vehicle.

    .. pydrake_system::

        name: EsdfCollision
        input_ports:
        - state
        - moving (optional)
        output_ports:
        - distance
        - gradient
        - clearance
        - in_collision
        - barrier
        - field_state

    `state` is that of a `QuadrotorState`. `distance` [m] is that of p_WB to occupied surfaces,
    `gradient` its derivative by p_WB in W, `clearance` [m] the distance less the radius of the
    vehicle, `in_collision` 1 if that is negative, `barrier` [m] equation 3, see `soft_barrier`, and
    `field_state` a `FieldState`. Outside the field's bounds distance, clearance and barrier are
    NaN, the gradient is zero and there is no collision. All outputs share one query of the field,
    with the bodies of `moving`, see `MovingBodies`.
    """

    def __init__(
        self,
        field: DistanceField,
        radius: float = VEHICLE_RADIUS,
        beta: float = 4.0,
        margin: float = 1.0,
    ) -> None:
        super().__init__()
        require(radius >= 0.0, "radius", "at least 0 m", radius)
        require(beta > 0.0, "beta", "> 0 1/m", beta)
        self._field = field
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
        index, ticket = cache.cache_index(), cache.ticket()

        def declare(name, size, value_of):
            def calc(context, output):
                sample = collision.get_cache_entry(index).Eval(context)
                output.SetFromVector(np.atleast_1d(value_of(sample)))

            self.DeclareVectorOutputPort(name, size, calc, prerequisites_of_calc={ticket})

        declare("distance", 1, lambda sample: sample.distance)
        declare("gradient", 3, lambda sample: sample.gradient)
        declare("clearance", 1, lambda sample: sample.distance - radius)
        declare("in_collision", 1, lambda sample: float(in_collision(sample.distance, radius)))
        declare("barrier", 1, lambda sample: soft_barrier(sample.distance, radius, beta, margin))
        declare("field_state", 1, lambda sample: float(sample.state))

    def _sample(self, context: Any, sample: Any) -> None:
        state, bodies = (
            vector_input(self, "state", context),
            optional_value(self, "moving", context),
        )
        field = bodies.among(self._field, bodies.time) if bodies else self._field
        sample.set_value(field.query(QuadrotorState.of(state).p_WB))
