"""From the raw frame of a time-of-flight sensor to the grid that policies see.

The order of the steps is that of the streamer which feeds such a policy on a Starling 2 Max: turn
the frame upright, crop it to the policy's field of view, take what was not measured for far, turn
depth into range, take the nearest of each cell, encode it, and turn the grid upside down.
"""

import math
from dataclasses import dataclass

import numpy as np

from splatpilot.systems.messages import require_field
from splatpilot.systems.sensing.onboard_camera import OnboardCamera, focal_length

LEAST_DEPTH = 1e-3
"""[m], up to which the sensor has measured nothing."""


@dataclass
class TimeOfFlight:
    """The sensor, and what part of its frame the policy sees; defaults are those of the drone."""

    # [px] Width of its frames; one that lies on its side is stood up.
    width: int = 180
    # [px] Height of its frames.
    height: int = 240
    # [deg] Horizontal field of view.
    fov_x: float = 86.0
    # [deg] Vertical field of view.
    fov_y: float = 106.0
    # [deg] Field of view, both ways, that is left by the crop.
    fov: float = 86.0
    # Which part of the height is left: "top", "center" or "bottom".
    anchor: str = "bottom"
    # [px] By how much that part then moves down; what leaves the frame is lost.
    shift: int = -100
    # [m] From which on nothing is near.
    max_range: float = 5.0
    # [-] Cells across.
    columns: int = 16
    # [-] Cells down.
    rows: int = 9

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("fov_x", "fov_y", "fov"):
            value = getattr(self, name)
            require_field(self, name, 1.0 <= value < 180.0, "at least 1 and below 180 deg")
        require_field(self, "anchor", self.anchor in _ANCHORS, f"one of {', '.join(_ANCHORS)}")
        require_field(self, "max_range", 0.0 < self.max_range < math.inf, "positive and finite")
        for name in ("width", "height", "columns", "rows"):
            value = getattr(self, name)
            require_field(self, name, value >= 1, "at least 1")
        crop = self.crop(self.height, self.width, self.fov_x, self.fov_y)
        for count, part, name in zip(
            (self.rows, self.columns), crop, ("rows", "columns"), strict=True
        ):
            left = part.stop - part.start
            require_field(
                self, name, count <= left, f"at most {left}, the pixels that the crop leaves"
            )

    def crop(self, height: int, width: int, fov_x: float, fov_y: float) -> tuple[slice, slice]:
        """The rows and columns that are left of an upright frame with these fields of view."""
        half_x, half_y = (
            focal_length(size, fov) * math.tan(math.radians(0.5 * self.fov))
            for size, fov in ((width, fov_x), (height, fov_y))
        )
        left, right = math.floor(0.5 * width - half_x), math.ceil(0.5 * width + half_x)
        tall = min(math.ceil(2.0 * half_y), height)
        top, bottom = {
            "top": (0, tall),
            "center": (math.floor(0.5 * height - half_y), math.ceil(0.5 * height + half_y)),
            "bottom": (height - tall, height),
        }[self.anchor]
        top, bottom = max(0, top), min(height, bottom)
        top = max(0, min(height - 1, top + self.shift))
        bottom = max(top + 1, min(height, bottom + self.shift))
        return slice(top, bottom), slice(max(0, left), min(width, right))


def sensor_of(camera: OnboardCamera) -> TimeOfFlight:
    """The sensor that a policy's camera is: all of its image is left.

    Raises:
        ValueError: for a camera whose lens distorts; frames of such sensors come rectified.
    """
    if camera.distortion is not None:
        raise ValueError(
            f"OnboardCamera.distortion is {camera.distortion}; a time-of-flight sensor has none: "
            "leave it out"
        )
    fov_y = math.degrees(2.0 * math.atan(0.5 * camera.height / camera.focal_y))
    return TimeOfFlight(
        width=camera.width,
        height=camera.height,
        fov_x=camera.fov_x,
        fov_y=fov_y,
        fov=max(camera.fov_x, fov_y),
        anchor="center",
        shift=0,
    )


_ANCHORS = ("top", "center", "bottom")


def time_of_flight_grid(depth: np.ndarray, sensor: TimeOfFlight) -> np.ndarray:
    """
    The proximities (rows, columns) in a frame: 1 - range / max_range, 1 touched, 0 nothing near.

    Row 0 is the lowest: the grid is upside down.

    Args:
        depth: (H, W) [m] along the optical axis; what is not finite, or at most 1 mm, was not
            measured. A frame that lies on its side is turned by 90 degrees, counterclockwise.
        sensor: a valid configuration.

    Raises:
        ValueError: for a frame of another size.
    """
    H, W = sensor.height, sensor.width
    if depth.shape not in ((H, W), (W, H)):
        raise ValueError(
            f"the frame has {depth.shape[1]}x{depth.shape[0]} pixels; it must have {W}x{H}, or lie "
            "on its side"
        )
    lying = depth.shape != (H, W)
    upright = np.rot90(depth) if lying else depth
    # The streamer takes the fields of view of a frame that lay with it as they were.
    fov_x, fov_y = (sensor.fov_y, sensor.fov_x) if lying else (sensor.fov_x, sensor.fov_y)
    rows, columns = sensor.crop(H, W, fov_x, fov_y)
    cropped = upright[rows, columns]
    measured = np.isfinite(cropped) & (cropped > LEAST_DEPTH)
    cropped = np.where(measured, cropped, sensor.max_range)
    ranges = cropped * range_of_depth(H, W, fov_x, fov_y)[rows, columns]
    for axis, count in ((0, sensor.rows), (1, sensor.columns)):
        edges = np.linspace(0, ranges.shape[axis], count + 1).astype(int)
        ranges = np.minimum.reduceat(ranges, edges[:-1], axis=axis)
    return (1.0 - np.clip(ranges, 0.0, sensor.max_range) / sensor.max_range)[::-1]


def range_of_depth(height: int, width: int, fov_x: float, fov_y: float) -> np.ndarray:
    """(height, width) [-] How far what pixels see is, by its depth along the optical axis."""
    x = (np.arange(width) - 0.5 * width) / focal_length(width, fov_x)
    y = (np.arange(height) - 0.5 * height) / focal_length(height, fov_y)
    return np.sqrt(1.0 + x**2 + y[:, None] ** 2)
