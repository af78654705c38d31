"""Configuration of a policy's camera."""

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.common.schema import Rotation, Transform
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from splatpilot.systems.common.config import equal_by_fields
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.splats.lens import Distortion, pixel_slopes


def level_mount() -> Transform:
    """Returns X_BC of a camera at the front that looks ahead."""
    rotation = Rotation(value=Rotation.Rpy(deg=[-90.0, 0.0, -90.0]))
    return Transform(translation=[0.1, 0.0, 0.0], rotation=rotation)


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
    # Pose on the vehicle: axes x right, y down and z forward of the image in body axes x forward, y
    # left and z up. Its rotation !Rpy {deg: [UP - 90, 0, LEFT - 90]} looks up and left by angles.
    X_BC: Transform = field(default_factory=level_mount)
    # [s] Between reading the first row of an image and the last; 0 is a global shutter.
    readout: float = bounded(0.0, "[0, 0.2] s")
    # [px] Neighbors that spread by less on the image have one color. 1 makes RGB of 64x48 pixels
    # up to four times as fast, and nearer to the mean over each pixel; 0 merges none.
    merged_spread: float = bounded(0.0, "[0, 4] px")

    __eq__ = equal_by_fields
    __hash__ = None  # pyright: ignore

    def check(self) -> None:
        if self.distortion is not None:
            widest = 2.0 * math.degrees(math.atan(self.distortion.limit))
            for name in ("fov_x", "fov_y"):
                value = getattr(self, name)
                valid = value is None or value < widest
                require_field(self, name, valid, f"below {widest:.1f} deg, the limit of the lens")
        valid = self.min_depth < self.max_depth
        require_field(self, "max_depth", valid, f"above min_depth = {self.min_depth} m")
        valid = self.X_BC.IsDeterministic() and not self.X_BC.base_frame
        require_field(self, "X_BC", valid, "a pose without distributions and without base_frame")
        valid = np.isfinite(self.X_BC.GetDeterministicValue().GetAsMatrix4()).all()
        require_field(self, "X_BC", valid, "finite")

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

    def mount(self) -> RigidTransform:
        """Returns X_BC, without the rounding of right angles."""
        X_BC = self.X_BC.GetDeterministicValue()
        R_BC = X_BC.rotation().matrix()
        R_BC = np.where(np.abs(R_BC) < 1e-15, 0.0, R_BC)
        return RigidTransform(RotationMatrix(R_BC), X_BC.translation())

    def ray_slopes(self) -> np.ndarray:
        """Returns the points p_CQ (height, width, 3) of the pixels at planar depth 1; NaN without a
        ray."""
        K = self.camera_info().intrinsic_matrix()
        slopes = pixel_slopes(self.distortion, K, self.width, self.height)
        return np.dstack([slopes, np.ones((self.height, self.width))])


def focal_length(size: int, fov: float) -> float:
    """Returns the focal length [px] of an axis with `size` pixels and a field of view [deg]."""
    return 0.5 * size / math.tan(math.radians(0.5 * fov))
