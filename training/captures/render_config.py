"""How a world is captured by `splatpilot capture render`."""

from dataclasses import dataclass, field

import numpy as np

from splatpilot.diagrams.worlds.splits import check_split


@dataclass(kw_only=True)
class RenderConfig:
    """How a world is captured."""

    width: int = 640  # [px] of the images
    height: int = 480  # [px] of the images
    # [m] Points x, y, z that the camera goes through; left out, it visits all the free space
    # between the heights, no two visited places being closer than `apart` on the way.
    path: list[list[float]] = field(default_factory=list)
    lowest: float = 1.0  # [m] of the path where it is not given
    highest: float = 2.2  # [m] of the path where it is not given
    apart: float = 3.0  # [m] least distance of two visited places
    clearance: float = 0.5  # [m] that the camera keeps from surfaces
    spacing: float = 0.6  # [m] between stops on the path
    # [deg] Directions in which the camera looks at each stop, from that of travel to the left.
    yaws: list[float] = field(default_factory=lambda: [0.0, 90.0, -90.0])
    pitch: float = -5.0  # [deg] by which the camera looks up
    # [m] to the camera's left, negative to its right: for each, a second capture `offset_...` from
    # there, of the poses that have room for the camera.
    offsets: list[float] = field(default_factory=list)
    up: str = "y"  # axis of the file's coordinates that points up: y, as glTF says, or z
    # Colour where there is no mesh; red, green, blue in 0 to 1.
    background: list[float] = field(default_factory=lambda: [0.6, 0.75, 0.9])
    voxel_size: float = 0.1  # [m] of the grid in which the path is found
    # What scenes of the capture are for: train, validation or test. Empty: train, but test for what
    # the benchmark tests in, and for its worlds of seeds below those of training.
    split: str = ""

    def validate(self) -> None:
        """Raises ValueError for values that make no sense."""
        check_split(self.split)
        for name in ("width", "height"):
            if not 8 <= getattr(self, name) <= 4096:
                raise ValueError(f"{name} is {getattr(self, name)} px, 8 to 4096 is needed")
        for name in ("apart", "spacing", "voxel_size"):
            if not 0.01 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)} m, at least 0.01 is needed")
        if not 0 <= self.clearance < np.inf:
            raise ValueError(f"clearance is {self.clearance} m, it must not be negative")
        if not self.lowest < self.highest:
            raise ValueError(
                f"lowest is {self.lowest} m and highest {self.highest} m: nothing lies between"
            )
        if not self.yaws or not np.isfinite([*self.yaws, self.pitch]).all():
            raise ValueError(f"yaws are {self.yaws}, pitch {self.pitch}: finite angles are needed")
        if abs(self.pitch) >= 90:
            raise ValueError(f"pitch is {self.pitch} deg, between -90 and 90 is needed")
        if not all(np.isfinite(offset) and offset for offset in self.offsets):
            raise ValueError(f"offsets are {self.offsets} m; finite ones other than 0 are needed")
        if len(self.background) != 3 or not all(0 <= value <= 1 for value in self.background):
            raise ValueError(f"background is {self.background}, three numbers 0 to 1 are needed")
