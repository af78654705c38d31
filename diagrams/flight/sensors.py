"""Registry of sensors."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from pydrake.systems.framework import System

from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.common.config import require_configuration
from splatpilot.systems.common.registry import Registry
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
    """Makes a system of a configuration, the world and the scenario, with its seed. Its inputs
    `body_pose` (X_WB), `state` and `start_pose` (X_WB the configuration's `readout` [s] before) are
    connected to the vehicle, if any. An output `p` of the sensor `s` is the output `s_p` of the
    flight, and the input of that name of the policy."""


SENSORS = Registry("sensor", "splatpilot.sensors", SensorEntry)
"""All sensors, by the names of their configurations' types."""


def register_sensor(config: type, build: Callable[[Any, World, Any], System]) -> None:
    """Registers a sensor.

    Args:
        config: type of its configurations, see `SensorConfig`; its name is their YAML tag.
        build: see `SensorEntry.build`.

    Raises:
        ValueError: if another sensor has the name, or the type is not a configuration.
    """
    require_configuration(config)
    SENSORS.add(config.__name__, SensorEntry(config, build))


def make_camera(config: OnboardCamera, world: World, latency: float = 0.0) -> SplatCamera:
    """Makes a camera of the Gaussians of the world, as they were `latency` [s] ago."""
    return SplatCamera(
        world.baked,
        config.camera_info(),
        config.X_BC(),
        min_depth=config.min_depth,
        max_depth=config.max_depth,
        background=world.background,
        moving=world.moving.gaussians if world.moving else None,
        latency=latency,
        distortion=config.distortion,
        readout=config.readout,
    )


register_sensor(OnboardCamera, lambda config, world, scenario: make_camera(config, world))
