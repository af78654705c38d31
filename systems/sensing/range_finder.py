"""A range finder: the distance along one ray."""

from dataclasses import dataclass
from typing import cast

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.collision.distance_field import DistanceField, Distances
from splatpilot.systems.common.drake import optional_value
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.sensing.imu import white_noise


@dataclass
class RangeFinder(Config):
    """A range finder at the origin of the body, which looks down by default; see
    `RangeFinderSensor`.

    Its output is ``range`` (1) [m].
    """

    # Direction in body axes: x forward, y left, z up.
    direction: list[float] = bounded(lambda: [0.0, 0.0, -1.0], "(-inf, inf)")
    # [m] Maximum distance.
    max_range: float = bounded(10.0, "(0, inf) m")
    # [m] Standard deviation of the noise.
    noise: float = bounded(0.02, "[0, inf) m")
    # [Hz] Draws of the noise per second.
    rate: float = bounded(50.0, "(0, 1000] Hz")

    def check(self) -> None:
        valid = len(self.direction) == 3 and any(self.direction)
        require_field(self, "direction", valid, "three numbers x, y, z, not all 0")


_TOLERANCE = 1e-4  # [m]


def cast_ray(
    field: Distances, p_WQ: np.ndarray, direction_W: np.ndarray, max_range: float
) -> float:
    """Computes by sphere tracing (Hart 1996) the distance [m] from p_WQ (3,) to the first surface.

    The direction (3,) is a unit vector. Without a surface within `max_range` [m] and beyond the
    bounds of the field, the distance is infinite.
    """
    traveled = 0.0
    while traveled <= max_range:
        distance = float(field.distance(p_WQ + traveled * direction_W))
        if np.isnan(distance):
            return np.inf
        traveled += distance
        if distance < _TOLERANCE:
            return max(0.0, traveled)
    return np.inf


class RangeFinderSensor(LeafSystem):
    """Measures the distance along a ray that is fixed to the vehicle.

    .. pydrake_system::

        name: RangeFinderSensor
        input_ports: [body_pose, moving (optional)]
        output_ports: [range]

    - ``body_pose``: X_WB.
    - ``moving``: bodies that the ray may hit, see `MovingBodies`.
    - ``range`` (1): [m] to the distance field's surface plus noise; infinite beyond the maximum.

    The noise follows from the seed, the system's name and the sample's number.
    """

    def __init__(self, config: RangeFinder, field: DistanceField, seed: int) -> None:
        super().__init__()
        config.validate()
        self._config, self._field, self._seed = config, field, seed
        direction = np.array(config.direction)
        self._direction_B = direction / np.linalg.norm(direction)
        self.DeclareAbstractInputPort("body_pose", Value(RigidTransform()))
        self.DeclareAbstractInputPort("moving", AbstractValue.Make(object()))
        tickets = {self.all_input_ports_ticket(), self.time_ticket()}
        self.DeclareVectorOutputPort("range", 1, self._calc, prerequisites_of_calc=tickets)

    def _calc(self, context: Context, output: BasicVector) -> None:
        X_WB = cast(RigidTransform, self.GetInputPort("body_pose").Eval(context))
        bodies = optional_value(self, "moving", context)
        field = bodies.among(self._field, bodies.time) if bodies else self._field
        direction_W, config = X_WB.rotation().multiply(self._direction_B), self._config
        distance = cast_ray(field, X_WB.translation(), direction_W, config.max_range)
        [error] = white_noise(self, self._seed, context.get_time(), config.rate, 1)
        measured = distance + config.noise * error
        output.SetAtIndex(0, measured if measured <= config.max_range else np.inf)
