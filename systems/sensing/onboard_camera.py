"""Configuration of a policy's camera."""

import math
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.splats.lens import Distortion

_R_BC_LEVEL = RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
"""Optical axes (x right, y down, z forward) of a level camera that looks ahead, in body axes."""


@dataclass
class OnboardCamera(Config):
    """A camera and its mount; it takes an image at each update of its policy."""

    # [px] Width of its images.
    width: int = bounded(64, "[1, 4096] px")
    # [px] Height of its images.
    height: int = bounded(36, "[1, 4096] px")
    # [deg] Horizontal field of view, from edge to edge through the middle.
    fov_x: float = bounded(90.0, "[1, 170] deg")
    # [deg] Vertical field of view; that of square pixels if left out.
    fov_y: float | None = bounded(None, "[1, 170] deg")
    # Of the lens; a pinhole if left out.
    distortion: Distortion | None = None
    # [m] Minimum depth of its depth images.
    min_depth: float = bounded(0.1, "[0, inf) m")
    # [m] Maximum depth of its depth images.
    max_depth: float = bounded(20.0, "(0, inf) m")
    # [m] Position on the vehicle.
    p_BC: list[float] = bounded(lambda: [0.1, 0.0, 0.0], "(-inf, inf) m")
    # [deg] Upward pitch.
    pitch: float = bounded(0.0, "[-90, 90] deg")
    # [s] Between reading the first row of an image and the last; 0 is a global shutter.
    readout: float = bounded(0.0, "[0, 0.2] s")

    def check(self) -> None:
        if self.distortion is not None:
            widest = 2.0 * math.degrees(math.atan(self.distortion.limit))
            for name in ("fov_x", "fov_y"):
                value = getattr(self, name)
                valid = value is None or value < widest
                require_field(self, name, valid, f"below {widest:.1f} deg, the limit of the lens")
        valid = self.min_depth < self.max_depth
        require_field(self, "max_depth", valid, f"above min_depth = {self.min_depth} m")
        require_field(self, "p_BC", len(self.p_BC) == 3, "three finite numbers x, y, z in m")

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
        """Returns the intrinsics, with the principal point in the middle."""
        size, middle = (self.width, self.height), (0.5 * self.width, 0.5 * self.height)
        return CameraInfo(*size, self.focal_x, self.focal_y, *middle)

    def X_BC(self) -> RigidTransform:
        """Returns the pose of the camera (x right, y down, z forward) in the body."""
        R_BC = RotationMatrix.MakeYRotation(-math.radians(self.pitch)) @ _R_BC_LEVEL
        return RigidTransform(R_BC, np.array(self.p_BC))

    def ray_slopes(self) -> np.ndarray:
        """Returns the points p_CQ (height, width, 3) of the pixels at planar depth 1."""
        x = (np.arange(self.width) + 0.5 - 0.5 * self.width) / self.focal_x
        y = (np.arange(self.height) + 0.5 - 0.5 * self.height) / self.focal_y
        return np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], axis=-1)


def focal_length(size: int, fov: float) -> float:
    """Returns the focal length [px] of an axis with `size` pixels and a field of view [deg]."""
    return 0.5 * size / math.tan(math.radians(0.5 * fov))
