"""Which pixels of different frames of a capture show the same point of the place."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.progress import Progress
from splatpilot.systems.splats.background import FAR
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.captures.lens import back_project
from splatpilot.training.reconstruction.vignette import radius_squared

STRIDE = 2
"""Views keep every second pixel along each axis."""

# Depths agree within this fraction, plus what the slope of the surface does to one pixel.
_DEPTH_TOLERANCE = 0.01

_COARSER = 1.5


@dataclass(frozen=True, eq=False)
class ThinnedFrame:
    """A frame thinned to what the comparison of frames needs; (h, w) = (H, W) / `STRIDE`."""

    X_WC: RigidTransform
    K: NDArray[np.float64]  # (3, 3) [px], of the whole frame
    depth: NDArray[np.floating]  # (h, w) [m]; 0 where there is none, or what is infinitely far
    tolerance: NDArray[np.floating]  # (h, w) [m], difference of depth on the same surface
    pixel_size: NDArray[np.floating]  # (h, w) [m], longest extent of a whole pixel on the surface
    luminance: NDArray[np.floating]  # (h, w), 0 to 1
    radius_squared: NDArray[np.floating]  # (h, w), squared distance from the image centre; corner 1

    @classmethod
    def of(cls, frame: CaptureFrame) -> "ThinnedFrame":
        """Thins `frame`."""
        thin = (slice(None, None, STRIDE), slice(None, None, STRIDE))
        height, width = frame.depth.shape
        depth = np.where(frame.depth < FAR, frame.depth, 0).astype(np.float32)
        with np.errstate(divide="ignore"):
            w = np.where(depth > 0, 1 / depth, 0)
        w_v, w_u = (_smaller_difference(w, axis)[thin] for axis in (0, 1))
        depth = depth[thin]
        # A plane is linear in inverse depth w: z changes by z^2 dw over one pixel, and the surface
        # is turned away from the ray by about f z |dw|.
        slope = depth * np.hypot(w_u, w_v)  # relative change of depth a pixel
        f = frame.K[0, 0]
        return cls(
            X_WC=frame.X_WC,
            K=frame.K,
            depth=depth,
            tolerance=depth * (_DEPTH_TOLERANCE + np.minimum(STRIDE * slope, 0.1)),
            pixel_size=depth / f * np.minimum(np.hypot(1, f * slope), 10),
            luminance=frame.image[thin].mean(-1) / 255,
            radius_squared=radius_squared(width, height)[thin].astype(np.float32),
        )

    def points(self, step: int = 1) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Returns the points p_WQ (3, n) of every `step`-th pixel and the flat index of each."""
        h, w = self.depth.shape
        rows, columns = np.mgrid[0:h:step, 0:w:step]
        index = (rows * w + columns).ravel()
        index = index[self.depth.flat[index] > 0]
        z = self.depth.flat[index].astype(np.float64)
        p_CQ = back_project(self.K, index % w * STRIDE + 0.5, index // w * STRIDE + 0.5, z)
        return self.X_WC.multiply(p_CQ.T), index

    def find(self, p_WQ: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Finds which of the points (3, n) this view sees.

        Returns their numbers and the flat index of the pixel that shows each.
        """
        h, w = self.depth.shape
        x, y, z = self.X_WC.inverse().multiply(p_WQ)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (self.K[0, 0] * x / z + self.K[0, 2]) / STRIDE
            v = (self.K[1, 1] * y / z + self.K[1, 2]) / STRIDE
        number = np.flatnonzero((z > 0) & (u >= 0) & (u < w) & (v >= 0) & (v < h))
        index = v[number].astype(np.intp) * w + u[number].astype(np.intp)
        same = np.abs(self.depth.flat[index] - z[number]) < self.tolerance.flat[index]
        return number[same], index[same]


def find_new_pixels(
    views: Sequence[ThinnedFrame], last: Collection[int] = ()
) -> list[NDArray[np.bool_]]:
    """Finds, for each view, the pixels (h, w) to keep so that every point is kept about once.

    Kept are pixels that are nearly the finest which any view has of their point (at most `_COARSER`
    times as large on the surface), in the first view that has them: views are visited from the
    closest to the farthest, those numbered in `last` after the others.
    """
    points = [view.points() for view in views]
    overlapping = [_overlapping(view, views) for view in views]

    fine = []  # pixels that are nearly the finest
    for i, view in enumerate(Progress(views, "comparing frames", unit="frame")):
        p_WQ, pixel = points[i]
        finest = np.full(view.depth.size, np.inf, dtype=np.float32)
        for j in overlapping[i]:
            number, shown = views[j].find(p_WQ)
            seen = pixel[number]
            finest[seen] = np.minimum(finest[seen], views[j].pixel_size.flat[shown])
        fine.append((view.pixel_size.ravel() < _COARSER * finest).reshape(view.depth.shape))

    sizes = [view.pixel_size[view.depth > 0] for view in views]
    far = [float(np.median(size)) if len(size) else np.inf for size in sizes]
    order = sorted(range(len(views)), key=lambda i: (i in last, far[i]))
    new: dict[int, NDArray[np.bool_]] = {}
    for i in Progress(order, "choosing frames", unit="frame"):
        view = views[i]
        p_WQ, pixel = points[i]
        covered = np.zeros(view.depth.size, dtype=bool)
        for j in overlapping[i]:
            if j in new:
                number, shown = views[j].find(p_WQ)
                covered[pixel[number]] |= new[j].flat[shown]
        keep = fine[i] & ~covered.reshape(view.depth.shape)
        # Without the speckle where two views are about equally fine.
        new[i] = (cv2.medianBlur(keep.astype(np.uint8), 5) > 0) & (view.depth > 0)
    return [new[i] for i in range(len(views))]


def seen_pixels(frame: CaptureFrame, views: Sequence[ThinnedFrame]) -> NDArray[np.bool_]:
    """Returns the pixels (H, W) of a frame whose point one of the views has seen; and those without
    depth, of which nobody can say."""
    own = ThinnedFrame.of(frame)
    p_WQ, pixel = own.points()
    seen = own.depth.ravel() == 0
    p_WC = own.X_WC.translation()
    # The nearest first: most points are found there.
    for view in sorted(views, key=lambda v: float(np.linalg.norm(v.X_WC.translation() - p_WC))):
        number, _ = view.find(p_WQ)
        seen[pixel[number]] = True
        p_WQ, pixel = np.delete(p_WQ, number, axis=1), np.delete(pixel, number)
    # With the speckle along edges, where depths of one point disagree.
    image = seen.reshape(own.depth.shape).astype(np.uint8)
    image = cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    height, width = frame.depth.shape
    return image.repeat(STRIDE, axis=0).repeat(STRIDE, axis=1)[:height, :width] > 0


def _overlapping(view: ThinnedFrame, views: Sequence[ThinnedFrame]) -> list[int]:
    """Returns the numbers of the views that see some of a few points of `view`."""
    p_WQ, _ = view.points(step=8)
    return [j for j, other in enumerate(views) if len(other.find(p_WQ)[0])]


def _smaller_difference(values: NDArray, axis: int) -> NDArray:
    """Returns the forward or backward difference, whichever is smaller: edges do not spoil it."""
    step = np.diff(values, axis=axis)
    ends = [(0, 0), (0, 0)]
    ends[axis] = (0, 1)
    forward = np.pad(step, ends, mode="edge")
    ends[axis] = (1, 0)
    backward = np.pad(step, ends, mode="edge")
    return np.where(np.abs(forward) < np.abs(backward), forward, backward)
