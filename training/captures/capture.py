"""A capture: what a camera saw of a place, from known poses."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.lens import back_project
from splatpilot.training.captures.register_depth import register_depth


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """One photograph with its depth.

    The centre of the pixel in column i and row j has the image coordinates (i + 0.5, j + 0.5).
    """

    image: NDArray[np.uint8]  # (H, W, 3) red, green, blue
    depth: NDArray[np.float32]  # (H, W) [m], along the optical axis; 0 unknown, inf beyond range
    X_WC: RigidTransform  # pose of the camera (x right, y down, z forward) in the world
    K: NDArray[np.float64]  # (3, 3) [px], pinhole intrinsics
    valid: NDArray[np.bool_] = field(default_factory=lambda: _EVERYWHERE)
    """(H, W), the pixels that are used: no other has depth, is fitted or is measured."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "valid", np.broadcast_to(self.valid, self.depth.shape))

    def back_project(self, columns: NDArray, rows: NDArray, depth: NDArray) -> NDArray[np.floating]:
        """Returns the points p_CQ, (..., 3) [m], at image coordinates [px] and depths [m]."""
        return back_project(self.K, columns, rows, depth)


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """A camera that measures depth, beside the one that takes colour."""

    K: NDArray[np.float64]  # (3, 3) [px]
    width: int  # [px]
    height: int  # [px]
    X_CD: RigidTransform  # pose of the depth camera D in the colour camera C


@dataclass(frozen=True, eq=False)
class SfmPoints:
    """Coloured points of the place, from structure from motion or a scan."""

    p_WQ: NDArray[np.float64]  # (N, 3) [m]
    colors: NDArray[np.float64]  # (N, 3) red, green, blue, 0 to 1


@dataclass(frozen=True, eq=False)
class FileAxes:
    """The axes in which the files of a capture gave their poses, before they were read as X_WC.

    With the pose X_FB of a body B in a world F as the files have it, X_WC = R_WF X_FB R_BC.
    """

    name: str
    """What they are called in messages."""
    R_WF: RotationMatrix
    R_BC: RotationMatrix


OPTICAL_AXES = FileAxes("optical: x right, y down, z forward", RotationMatrix(), RotationMatrix())
OPENGL_AXES = FileAxes(
    "OpenGL: x right, y up, z back", RotationMatrix(), RotationMatrix(np.diag([1.0, -1.0, -1.0]))
)


_EVERYWHERE = np.ones((1, 1), dtype=bool)


def no_depth(i: int) -> None:
    """The `Capture.load_depth` of a capture without depth."""


def all_valid(i: int) -> NDArray[np.bool_]:
    """The `Capture.load_valid` of a capture whose pixels are all used."""
    return _EVERYWHERE


@dataclass(frozen=True, eq=False)
class Capture:
    """A sequence of posed images, with depth if there is any, loaded frame by frame when asked for.

    Cameras are pinholes: loaders undistort. World W has z up and, unless `metric` is false, is in
    metres.
    """

    name: str
    source: str
    """Where it was read from, for the record."""
    K: NDArray[np.float64]  # (3, 3) [px], of the colour camera
    width: int  # [px]
    height: int  # [px]
    X_WCs: Sequence[RigidTransform]
    load_image: Callable[[int], NDArray[np.uint8]]
    """Returns the image of frame i, (height, width, 3), or raises an error that names the file."""
    load_depth: Callable[[int], NDArray[np.float32] | None] = no_depth
    """Returns the depth of frame i [m] in the pixels of the camera that measured it, None if that
    frame has none, or raises an error that names the file. 0 is unknown, inf is beyond range."""
    load_valid: Callable[[int], NDArray[np.bool_]] = all_valid
    """Returns the pixels of the image of frame i that are used, (height, width) or (1, 1)."""
    depth_camera: DepthCamera | None = None
    """The camera that measured depth; None if depth has the pixels of the images."""
    points: SfmPoints | None = None
    """Points known of the place, if any."""
    metric: bool = True
    """Whether lengths are metres; if not, their unit is unknown and nothing can fly there."""
    frame_names: Sequence[str] = ()
    """Path of each image as the files give it; empty if only numbers are known."""
    dropped: Sequence[str] = ()
    """Why frames were left out, one message each that names the file."""
    held_out: Sequence[int] | None = None
    """The frames that the files hold out from training; None if they do not say."""
    notes: Sequence[str] = ()
    """What was assumed or not used when the files were read, one sentence each."""
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """(3,) [m], position of W's origin in the world of the files, upright and in metres."""
    axes: FileAxes | None = None
    """The axes of the files, for those who doubt that they were read rightly."""
    folder: str = ""
    """The absolute path from which `read_capture` opens it again, with `config`; empty if it does
    not come from there as it is."""
    config: CaptureConfig = field(default_factory=CaptureConfig)
    """What was said when it was read of what its files leave open."""

    def __len__(self) -> int:
        return len(self.X_WCs)

    @property
    def has_depth(self) -> bool:
        """Whether any frame has depth."""
        return self.load_depth is not no_depth

    def measured_depth(self, i: int) -> NDArray[np.float32] | None:
        """Returns what `load_depth` does; 0 in invalid pixels if it has the pixels of the images.

        Raises:
            OSError, ValueError: if its file cannot be read or is of another size.
        """
        depth = self.load_depth(i)
        if depth is None or self.depth_camera is not None:
            return depth
        return np.where(self.load_valid(i), depth, np.float32(0))

    def registered_depth(self, i: int) -> NDArray[np.float32]:
        """Returns the depth (height, width) [m] of frame i in the pixels of its image.

        0 where it is unknown or the pixel is invalid, everywhere if the frame has none.

        Raises:
            OSError, ValueError: if its file cannot be read or is of another size.
        """
        depth, camera = self.measured_depth(i), self.depth_camera
        if depth is None:
            return np.zeros((self.height, self.width), np.float32)
        if camera is None:
            return depth
        depth = register_depth(depth, camera.K, camera.X_CD, self.K, self.width, self.height)
        return np.where(self.load_valid(i), depth, np.float32(0))

    def frame(self, i: int) -> CaptureFrame:
        """Loads frame i, 0 <= i < len(self), with its registered depth.

        Raises:
            IndexError: if there is no such frame.
            OSError, ValueError: if its files cannot be read or are of another size.
        """
        if not 0 <= i < len(self):
            raise IndexError(f"frame {i} of {self.name}: it has the frames 0 to {len(self) - 1}")
        return CaptureFrame(
            self.load_image(i), self.registered_depth(i), self.X_WCs[i], self.K, self.load_valid(i)
        )

    def frames(self) -> Iterator[CaptureFrame]:
        """Loads one frame after the other."""
        return (self.frame(i) for i in range(len(self)))
