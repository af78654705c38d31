"""Distance fields in a Drake MathematicalProgram."""

from typing import Any

import numpy as np
from pydrake.solvers import Binding, Constraint, Cost, MathematicalProgram

from splatpilot.systems.collision.distance_field import DistanceField, sample_field, soft_barrier
from splatpilot.systems.common.validation import require
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

# Solvers need numbers outside the bounds too; `Esdf.conservative` has them.


def AddClearanceConstraint(
    prog: MathematicalProgram, field: DistanceField, p_WQ: np.ndarray, lower: float = VEHICLE_RADIUS
) -> "Binding[Constraint]":
    """Adds the constraint distance(p_WQ) >= lower.

    Args:
        field: has distances everywhere, as `Esdf.conservative`; NaN stops solvers.
        p_WQ: (3,) decision variables [m].
        lower: [m].
    """
    return prog.AddConstraint(
        lambda p: np.array([_distance(field, p)]), lb=[lower], ub=[np.inf], vars=_point(p_WQ)
    )


def AddBarrierCost(
    prog: MathematicalProgram,
    field: DistanceField,
    p_WQ: np.ndarray,
    radius: float = VEHICLE_RADIUS,
    beta: float = 4.0,
    margin: float = 1.0,
) -> "Binding[Cost]":
    """Adds the `soft_barrier` of distance(p_WQ) to the cost.

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
