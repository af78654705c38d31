"""Distance fields in a Drake MathematicalProgram."""

from typing import Any

import numpy as np
from pydrake.solvers import MathematicalProgram

from splatpilot.systems.collision.distance_field import DistanceField, sample_field, soft_barrier
from splatpilot.systems.common.validation import require
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS


def AddClearanceConstraint(
    prog: MathematicalProgram, field: DistanceField, p_WQ: np.ndarray, lower: float = VEHICLE_RADIUS
) -> Any:
    """Adds the constraint distance(p_WQ) >= lower, and returns its Binding.

    Args:
        field: has distances everywhere, as `Esdf.conservative`; NaN stops solvers.
        p_WQ: (3,) decision variables [m].
        lower: [m].
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
    """Adds the `soft_barrier` of distance(p_WQ) to the cost, and returns its Binding.

    Args:
        field: has distances everywhere, as `Esdf.conservative`; NaN stops solvers.
        p_WQ: (3,) decision variables [m].
        radius, margin: [m].
        beta: [1/m].
    """
    return prog.AddCost(
        lambda p: soft_barrier(_distance(field, p), radius, beta, margin), vars=_point(p_WQ)
    )


def _distance(field: DistanceField, p_WQ: Any) -> Any:
    return sample_field(field, p_WQ).distance


def _point(p_WQ: np.ndarray) -> np.ndarray:
    require(np.shape(p_WQ) == (3,), "the shape of p_WQ", "(3,)", np.shape(p_WQ))
    return p_WQ
