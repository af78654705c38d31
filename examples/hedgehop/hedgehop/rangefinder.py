"""A sensor: the distance along one ray."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot import Config, bounded, register_sensor
from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.common.validation import require_field
from splatpilot.systems.sensing.imu import cast_ray


@dataclass
class RangefinderConfig(Config):
    """A rangefinder on a gimbal that keeps it level."""

    # Direction in the vehicle's level frame: x ahead, y left, z up.
    direction: list[float] = field(default_factory=lambda: [1.0, 0.0, 0.0])
    max_range: float = bounded(8.0, "(0, 100] m")

    def check(self) -> None:
        """Checks the direction."""
        valid = len(self.direction) == 3 and np.linalg.norm(self.direction) > 0
        require_field(self, "direction", valid, "three numbers, not all 0")


class Rangefinder(LeafSystem):
    """Measures the distance along a ray that stays level at any attitude of the vehicle.

    .. pydrake_system::

        name: Rangefinder
        input_ports: [body_pose]
        output_ports: [distance]

    - ``body_pose``: X_WB.
    - ``distance`` (1): [m] to the nearest surface of the distance field along the ray.
    """

    def __init__(self, config: RangefinderConfig, distance_field: DistanceField):
        super().__init__()
        self._far, self._field = config.max_range, distance_field
        self._e_L = np.array(config.direction) / np.linalg.norm(config.direction)
        self.DeclareAbstractInputPort("body_pose", Value(RigidTransform()))
        self.DeclareVectorOutputPort("distance", 1, self._calc_distance)

    def _calc_distance(self, context: Context, output: BasicVector) -> None:
        X_WB = self.GetInputPort("body_pose").Eval(context)
        R_WL = RollPitchYaw(0, 0, RollPitchYaw(X_WB.rotation()).yaw_angle()).ToRotationMatrix()
        e_W = R_WL.multiply(self._e_L)
        distance = cast_ray(self._field, X_WB.translation(), e_W, self._far)
        output.SetAtIndex(0, min(distance, self._far))


register_sensor(
    RangefinderConfig, lambda config, world, _: Rangefinder(config, world.distance_field)
)
