"""A capture: what a camera saw of a place, from known poses."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """One photograph with its depth.

    The centre of the pixel in column i and row j has the image coordinates (i + 0.5, j + 0.5).
    """

    image: NDArray[np.uint8]  # (H, W, 3) red, green, blue
    depth: NDArray[np.float32]  # (H, W) [m], along the optical axis; 0 unknown, inf beyond range
    X_WC: RigidTransform  # pose of the camera (x right, y down, z forward) in the world
    K: NDArray[np.float64]  # (3, 3) [px], pinhole intrinsics

    def back_project(self, columns: NDArray, rows: NDArray, depth: NDArray) -> NDArray[np.floating]:
        """Returns the points p_CQ, (..., 3) [m], at image coordinates [px] and depths [m]."""
        x = (columns - self.K[0, 2]) / self.K[0, 0] * depth
        y = (rows - self.K[1, 2]) / self.K[1, 1] * depth
        return np.stack([x, y, depth], axis=-1)


@dataclass(frozen=True, eq=False)
class Capture:
    """A sequence of posed images with metric depth, loaded frame by frame when asked for.

    World W has z up and is metric.
    """

    name: str
    source: str
    """Where it was read from, for the record."""
    K: NDArray[np.float64]  # (3, 3) [px]
    width: int  # [px]
    height: int  # [px]
    X_WCs: Sequence[RigidTransform]
    load_image: Callable[[int], NDArray[np.uint8]]
    """Returns the image of frame i, (height, width, 3), or raises an error that names the file."""
    load_depth: Callable[[int], NDArray[np.float32]]
    """Returns the depth of frame i, (height, width) [m], or raises an error that names the file."""

    def __len__(self) -> int:
        return len(self.X_WCs)

    def frame(self, i: int) -> CaptureFrame:
        """Loads frame i, 0 <= i < len(self).

        Raises:
            IndexError: if there is no such frame.
            OSError, ValueError: if its files cannot be read or are of another size.
        """
        if not 0 <= i < len(self):
            raise IndexError(f"frame {i} of {self.name}: it has the frames 0 to {len(self) - 1}")
        return CaptureFrame(self.load_image(i), self.load_depth(i), self.X_WCs[i], self.K)

    def frames(self) -> Iterator[CaptureFrame]:
        """Loads one frame after the other."""
        return (self.frame(i) for i in range(len(self)))
