"""All sensors: their configurations, and how each becomes part of a flight."""

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
    """The configuration of a sensor: a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        ...


@dataclass(frozen=True)
class SensorKind:
    """How a sensor is configured and built."""

    config: type
    """The type of its configurations."""
    build: Callable[[Any, World], System]
    """From a configuration and the world to a system. Its inputs `body_pose` (X_WB), `state` and
    `start_pose` (X_WB of the configuration's `readout` [s] before), where it has them, are
    connected to the vehicle; an output `p` of the sensor `s` is the flight's
    output `s_p`, and a policy that has an input of that name gets it."""


SENSORS = Registry("sensor", "splatpilot.sensors", SensorKind)
"""All sensors, by the names of their configurations' types."""


def register_sensor(config: type, build: Callable[[Any, World], System]) -> None:
    """
    Makes a kind of sensor known, so that scenarios and policies can name it by its configuration's
    type.

    Args:
        config: the type of its configurations, see `SensorConfig`; its name is their YAML tag.
        build: see `SensorKind.build`.

    Raises:
        ValueError: if another sensor has the name, or the type is none of configurations.
    """
    require_configuration(config)
    SENSORS.add(config.__name__, SensorKind(config, build))


def make_camera(config: OnboardCamera, world: World, latency: float = 0.0) -> SplatCamera:
    """A camera that looks at the Gaussians of the world, as they were `latency` [s] ago."""
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


register_sensor(OnboardCamera, make_camera)
