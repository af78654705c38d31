"""Registries of sensors and of estimators."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from pydrake.systems.framework import System

from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.common.config import require_configuration
from splatpilot.systems.common.registry import Registry
from splatpilot.systems.sensing.estimators import (
    InertialFilter,
    InertialFilterEstimator,
    MotionCapture,
    MotionCaptureEstimator,
    TrueState,
    VisualInertial,
    VisualInertialEstimator,
)
from splatpilot.systems.sensing.imu import Imu, ImuSensor, RangeFinder, RangeFinderSensor
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.splat_camera import SplatCamera


class SensorConfig(Protocol):
    """Configuration of a sensor: a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def validate(self) -> None:
        """Raises ValueError for a value out of range."""
        ...


@dataclass(frozen=True)
class SensorEntry:
    """Entry of the registry."""

    config: type  # of its configurations
    build: Callable[[Any, World, Any], System]
    """Makes a system of a configuration, the world and the scenario, with its seed.

    Its inputs are any of `state` (13) and `body_pose` (X_WB), the true ones, `command` (4), `goal`
    (3), `moving` (see `MovingBodies`), `start_pose` (X_WB the configuration's `readout` [s]
    before), the policy's images, and outputs of other sensors. An output `p` of the sensor `s` is
    the output `s_p` of the flight, and the input of that name of policies and sensors."""


SENSORS = Registry("sensor", "splatpilot.sensors", SensorEntry)
"""All sensors, by the names of their configurations' types."""


def register_sensor(config: type, build: Callable[[Any, World, Any], System]) -> None:
    """Registers a sensor.

    Args:
        config: type of its configurations, see `SensorConfig`; its name is their YAML tag.
        build: see `SensorEntry.build`.
    """
    require_configuration(config)
    SENSORS.add(config.__name__, SensorEntry(config, build))


ESTIMATORS = Registry("estimator", "splatpilot.estimators", SensorEntry)
"""All estimators, by the names of their configurations' types.

`build` makes a system as `AddFlight` describes it, or None for the true state. A configuration may
have `sensors`, by name, and a `rate` [Hz].
"""


def register_estimator(config: type, build: Callable[[Any, World, Any], System | None]) -> None:
    """Registers an estimator; see `ESTIMATORS` and `register_sensor`."""
    require_configuration(config)
    ESTIMATORS.add(config.__name__, SensorEntry(config, build))  # pyright: ignore


def make_onboard_camera(
    config: OnboardCamera,
    world: World,
    latency: float | Callable[[float], float] = 0.0,
    exposure: float = 0.0,
) -> SplatCamera:
    """Makes a camera of the Gaussians of the world; for the other arguments see `SplatCamera`."""
    return SplatCamera(
        world.baked,
        config.camera_info(),
        config.mount(),
        min_depth=config.min_depth,
        max_depth=config.max_depth,
        background=world.background,
        latency=latency,
        distortion=config.distortion,
        readout=config.readout,
        exposure=exposure,
        merged_spread=config.merged_spread,
    )


register_sensor(OnboardCamera, lambda config, world, scenario: make_onboard_camera(config, world))
register_sensor(
    Imu, lambda config, world, scenario: ImuSensor(config, scenario.vehicle, scenario.seed)
)
register_sensor(
    RangeFinder,
    lambda config, world, scenario: RangeFinderSensor(config, world.distance_field, scenario.seed),
)
register_estimator(TrueState, lambda config, world, scenario: None)
register_estimator(
    MotionCapture, lambda config, world, scenario: MotionCaptureEstimator(config, scenario.seed)
)
register_estimator(
    VisualInertial, lambda config, world, scenario: VisualInertialEstimator(config, scenario.seed)
)
register_estimator(
    InertialFilter,
    lambda config, world, scenario: InertialFilterEstimator(config, scenario.vehicle),
)
