"""The camera through which a policy sees."""

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from splatpilot.systems.common.validation import require_field
from splatpilot.systems.splats.lens import Distortion

_LARGEST = 4096  # [px]

_R_BC_LEVEL = RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
"""Optical axes (x right, y down, z forward) of a level camera that looks ahead, in body axes."""


@dataclass
class OnboardCamera:
    """A camera and its mount; it takes images when its policy looks."""

    # [px] Width of its images.
    width: int = 64
    # [px] Height of its images.
    height: int = 36
    # [deg] Horizontal field of view, from edge to edge through the middle.
    fov_x: float = 90.0
    # [deg] Vertical field of view; that of square pixels where left out.
    fov_y: float | None = None
    # Of the lens; a pinhole where left out.
    distortion: Distortion | None = None
    # [m] Least depth that its depth images show.
    min_depth: float = 0.1
    # [m] Greatest depth that its depth images show.
    max_depth: float = 20.0
    # [m] Where it sits on the vehicle.
    p_BC: list[float] = field(default_factory=lambda: [0.1, 0.0, 0.0])
    # [deg] How far it looks up.
    pitch: float = 0.0
    # [s] Between reading the first row of an image and the last; 0 is a global shutter.
    readout: float = 0.0

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("width", "height"):
            value = getattr(self, name)
            require_field(self, name, 1 <= value <= _LARGEST, f"1 to {_LARGEST} pixels")
        for name in ("fov_x", "fov_y"):
            value = getattr(self, name)
            require_field(self, name, value is None or 1.0 <= value <= 170.0, "1 to 170 deg")
        if self.distortion is not None:
            self.distortion.validate()
            widest = 2.0 * math.degrees(math.atan(self.distortion.limit))
            for name in ("fov_x", "fov_y"):
                value = getattr(self, name)
                shown = value is None or value < widest
                require_field(
                    self, name, shown, f"less than the {widest:.1f} deg that the lens shows"
                )
        require_field(self, "min_depth", self.min_depth >= 0.0, "at least 0 m")
        farther = self.min_depth < self.max_depth < math.inf
        require_field(self, "max_depth", farther, "more than min_depth, and finite")
        mounted = len(self.p_BC) == 3 and bool(np.isfinite(self.p_BC).all())
        require_field(self, "p_BC", mounted, "three finite numbers x, y, z in metres")
        require_field(self, "readout", 0.0 <= self.readout <= 0.2, "0 to 0.2 s")
        require_field(self, "pitch", -90.0 <= self.pitch <= 90.0, "-90 to 90 deg")

    @property
    def focal_x(self) -> float:
        """[px]"""
        return self._focal(self.width, self.fov_x, axis=0)

    @property
    def focal_y(self) -> float:
        """[px]"""
        return self.focal_x if self.fov_y is None else self._focal(self.height, self.fov_y, axis=1)

    def _focal(self, pixels: int, fov: float, axis: int) -> float:
        if self.distortion is None:
            return focal_length(pixels, fov)
        edges = np.zeros((2, 2))
        edges[:, axis] = math.tan(math.radians(0.5 * fov)) * np.array([-1.0, 1.0])
        bent = self.distortion.project(edges)[:, axis]
        return pixels / float(bent[1] - bent[0])

    def camera_info(self) -> CameraInfo:
        """The intrinsics, the principal point in the middle."""
        return CameraInfo(
            width=self.width,
            height=self.height,
            focal_x=self.focal_x,
            focal_y=self.focal_y,
            center_x=0.5 * self.width,
            center_y=0.5 * self.height,
        )

    def X_BC(self) -> RigidTransform:
        """Pose of the camera (x right, y down, z forward) in the body."""
        R_BC = RotationMatrix.MakeYRotation(-math.radians(self.pitch)) @ _R_BC_LEVEL
        return RigidTransform(R_BC, np.array(self.p_BC))

    def ray_slopes(self) -> np.ndarray:
        """(height, width, 3) The points p_CQ at planar depth 1 that the pixels look at."""
        x = (np.arange(self.width) + 0.5 - 0.5 * self.width) / self.focal_x
        y = (np.arange(self.height) + 0.5 - 0.5 * self.height) / self.focal_y
        return np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], axis=-1)


def focal_length(size: int, fov: float) -> float:
    """[px], of an axis with `size` pixels and a field of view [deg]."""
    return 0.5 * size / math.tan(math.radians(0.5 * fov))
