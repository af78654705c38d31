"""What a procedural forest is made from, and which forests can be grown."""

from dataclasses import dataclass

import numpy as np

from splatpilot.diagrams.worlds.fittings import CLEARING, INSET, PASSAGE, check_count, check_ground


@dataclass
class TrunksConfig:
    """What all forests have."""

    length: float = 36.0  # [m] flyable volume along x: from 0 to length
    width: float = 16.0  # [m] along y, centred on 0
    height: float = 6.0  # [m] along z, from the ground to where the crowns begin
    spacing: float = 3.0  # [m] least distance of two trunks on the ground, axis to axis
    radius_min: float = 0.25  # [m] thinnest trunk
    radius_max: float = 0.45  # [m] thickest trunk
    lean_max: float = 1.5  # [deg] largest tilt of a trunk
    rocks: int = 10  # [-] boulders, at most knee-high, fewer where there is no room
    logs: int = 5  # [-] fallen trunks on the ground, fewer where there is no room
    flight_height: float = 1.8  # [m] height of start and goal
    voxel_size: float = 0.15  # [m] of the distance grid

    @property
    def narrowest(self) -> float:
        """Narrowest gap between two trunks that the other values allow [m]."""
        tilt = self.height * np.tan(np.deg2rad(self.lean_max))
        return float(self.spacing - 2 * self.radius_max - 2 * tilt)

    def validate(self) -> None:
        """Raises ValueError for the first value with which no forest can be grown."""
        positive = "length", "width", "height", "spacing", "radius_min", "radius_max", "voxel_size"
        for name in positive:
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} = {getattr(self, name)} m must be positive and finite")
        check_ground(self)
        check_count(self, "rocks", "logs")
        if not 0 <= self.lean_max <= 10:
            raise ValueError(f"lean_max = {self.lean_max} deg must be between 0 and 10 deg")
        least = 2 * (INSET + CLEARING)
        if self.length < least:
            raise ValueError(
                f"length = {self.length} m must be at least {least:g} m, since start and goal are "
                f"{INSET:g} m from the ends"
            )
        least = 2 * (self.radius_max + PASSAGE)
        if self.width < least:
            raise ValueError(
                f"width = {self.width} m must be at least {least:g} m, or one trunk can block it"
            )
        if not CLEARING <= self.flight_height <= self.height - CLEARING:
            raise ValueError(
                f"flight_height = {self.flight_height} m must be between {CLEARING:g} m and "
                f"height - {CLEARING:g} m = {self.height - CLEARING:g} m"
            )
        if self.radius_max < self.radius_min:
            raise ValueError(
                f"radius_max = {self.radius_max} m must not be below radius_min = "
                f"{self.radius_min} m"
            )
        if self.radius_max >= self.spacing / 2:
            raise ValueError(
                f"radius_max = {self.radius_max} m must be below half the spacing "
                f"{self.spacing} m, or trunks touch: use thinner trunks or a wider spacing"
            )
        if self.narrowest < PASSAGE:
            raise ValueError(
                f"spacing = {self.spacing} m leaves gaps of {self.narrowest:.2f} m between trunks "
                f"of radius {self.radius_max} m that lean up to {self.lean_max} deg, the vehicle "
                f"needs {PASSAGE:.2f} m: use a spacing of at least "
                f"{self.spacing + PASSAGE - self.narrowest:.2f} m"
            )


@dataclass
class ForestConfig(TrunksConfig):
    """A forest.

    It is no base of others: written to YAML, their worlds would become plain forests, since Drake
    takes the first type of a union that a value is an instance of.
    """
