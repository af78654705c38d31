"""A sensor: the distance along one ray."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot import World, register_sensor
from splatpilot.systems.collision.distance_field import DistanceField


@dataclass
class RangefinderConfig:
    """Where a rangefinder on a gimbal looks, and how far."""

    # Direction in the vehicle's level frame: x ahead, y left, z up.
    direction: list[float] = field(default_factory=lambda: [1.0, 0.0, 0.0])
    # [m] What is farther reads this.
    max_range: float = 8.0

    def validate(self) -> None:
        """Raises ValueError on a value out of range."""
        if len(self.direction) != 3 or not np.linalg.norm(self.direction) > 0:
            raise ValueError(f"direction is {self.direction}; it must be three numbers, not all 0")
        if not 0 < self.max_range <= 100:
            raise ValueError(
                f"max_range is {self.max_range} m; it must be more than 0, at most 100"
            )


def cast_ray(distance_field: DistanceField, p_WQ: np.ndarray, e_W: np.ndarray, far: float) -> float:
    """Distance [m] from p_WQ (3,) along the unit vector e_W (3,) to the first surface, or `far`.

    Sphere tracing (Hart 1996): no surface is nearer than the signed distance, so that is a step.
    """
    way = 0.0
    while way < far:
        step = float(distance_field.distance(p_WQ + way * e_W))
        if not step > 1e-3:  # A surface; NaN beyond the world.
            return far if np.isnan(step) else way
        way += step
    return far


class Rangefinder(LeafSystem):
    """
    Measures the distance along a ray that stays level whatever the vehicle's attitude.

    .. pydrake_system::

        name: Rangefinder
        input_ports:
        - body_pose
        output_ports:
        - distance

    - ``body_pose``: X_WB.
    - ``distance`` (1): [m] to the nearest surface of the distance field along the ray.
    """

    def __init__(self, config: RangefinderConfig, distance_field: DistanceField):
        super().__init__()
        config.validate()
        self._far, self._field = config.max_range, distance_field
        self._e_L = np.array(config.direction) / np.linalg.norm(config.direction)
        self.DeclareAbstractInputPort("body_pose", Value(RigidTransform()))
        self.DeclareVectorOutputPort("distance", 1, self._calc_distance)

    def _calc_distance(self, context: Context, output: BasicVector) -> None:
        X_WB = self.GetInputPort("body_pose").Eval(context)
        R_WL = RollPitchYaw(0, 0, RollPitchYaw(X_WB.rotation()).yaw_angle()).ToRotationMatrix()
        e_W = R_WL.multiply(self._e_L)
        output.SetAtIndex(0, cast_ray(self._field, X_WB.translation(), e_W, self._far))


def _build(config: RangefinderConfig, world: World) -> Rangefinder:
    return Rangefinder(config, world.distance_field)


register_sensor(RangefinderConfig, _build)
