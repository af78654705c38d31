"""The camera through which a policy sees."""

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

_LARGEST = 4096  # [px]

_R_BC_LEVEL = RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
"""Optical axes (x right, y down, z forward) of a level camera that looks ahead, in body axes."""


@dataclass
class OnboardCamera:
    """A pinhole camera with square pixels and its mount; it takes images when its policy looks."""

    # [px]
    width: int = 64
    height: int = 36
    # [deg] Horizontal field of view.
    fov_x: float = 90.0
    # [m] Range of its depth images.
    min_depth: float = 0.1
    max_depth: float = 20.0
    # [m] Where it sits on the vehicle.
    p_BC: list[float] = field(default_factory=lambda: [0.1, 0.0, 0.0])
    # [deg] How far it looks up.
    pitch: float = 0.0

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("width", "height"):
            value = getattr(self, name)
            _check(name, value, 1 <= value <= _LARGEST, f"1 to {_LARGEST} pixels")
        _check("fov_x", self.fov_x, 1.0 <= self.fov_x <= 170.0, "1 to 170 deg")
        _check("min_depth", self.min_depth, self.min_depth >= 0.0, "at least 0 m")
        farther = self.min_depth < self.max_depth < math.inf
        _check("max_depth", self.max_depth, farther, "more than min_depth, and finite")
        mounted = len(self.p_BC) == 3 and bool(np.isfinite(self.p_BC).all())
        _check("p_BC", self.p_BC, mounted, "three finite numbers x, y, z in metres")
        _check("pitch", self.pitch, -90.0 <= self.pitch <= 90.0, "-90 to 90 deg")

    @property
    def focal_length(self) -> float:
        """[px], of both axes."""
        return 0.5 * self.width / math.tan(math.radians(0.5 * self.fov_x))

    def camera_info(self) -> CameraInfo:
        """The intrinsics, the principal point in the middle."""
        return CameraInfo(
            width=self.width,
            height=self.height,
            focal_x=self.focal_length,
            focal_y=self.focal_length,
            center_x=0.5 * self.width,
            center_y=0.5 * self.height,
        )

    def X_BC(self) -> RigidTransform:
        """Pose of the camera (x right, y down, z forward) in the body."""
        R_BC = RotationMatrix.MakeYRotation(-math.radians(self.pitch)) @ _R_BC_LEVEL
        return RigidTransform(R_BC, np.array(self.p_BC))

    def ray_slopes(self) -> np.ndarray:
        """(height, width, 3) The points p_CQ at planar depth 1 that the pixels look at."""
        x = (np.arange(self.width) + 0.5 - 0.5 * self.width) / self.focal_length
        y = (np.arange(self.height) + 0.5 - 0.5 * self.height) / self.focal_length
        return np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], axis=-1)


def _check(name: str, value: object, valid: bool, limit: str) -> None:
    if not valid:
        raise ValueError(f"OnboardCamera.{name} is {value}; it must be {limit}")
