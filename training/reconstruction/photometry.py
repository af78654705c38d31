"""How bright each image of a capture is beside the others, and how much its corners darken."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.sparse import coo_array
from scipy.sparse.linalg import lsqr
from torch import Tensor

from splatpilot.systems.common.progress import Progress
from splatpilot.systems.splats.background import FAR
from splatpilot.training.captures.capture import CaptureFrame, back_project


def radius_squared(width: int, height: int) -> NDArray[np.float64]:
    """Returns rho^2 (height, width) of each pixel: rho is the distance from the image's centre, 1
    in the corners."""
    x = np.arange(width) + 0.5 - width / 2
    y = (np.arange(height) + 0.5 - height / 2)[:, None]
    return (x**2 + y**2) / ((width**2 + height**2) / 4)


def vignette(vignetting: float, width: int, height: int) -> NDArray[np.float64]:
    """Returns the brightness (height, width) of each pixel relative to the image's centre.

    Args:
        vignetting: logarithm of the relative brightness of the corners.
        width, height: [px].
    """
    return np.exp(vignetting * radius_squared(width, height))


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


_SAMPLES_PER_PAIR = 100
_BRIGHTNESS = (0.1, 0.98)  # outside, noise or saturation spoils the ratio


@dataclass(frozen=True, eq=False)
class Photometry:
    """Relates image values I to those of the scene S: I = gain_i exp(vignetting rho^2) S.

    rho is the distance from the image centre, 1 in the corners. The scene has the mean brightness
    of the image centres: the logarithms of the gains have the mean 0.
    """

    gains: NDArray[np.float64]  # (n,), one for each image
    vignetting: float  # logarithm of the relative brightness of the corners, at most 0

    def factor(self, i: int, height: int, width: int) -> NDArray[np.float32]:
        """Returns I / S for the pixels of image i, (height, width)."""
        return (self.gains[i] * vignette(self.vignetting, width, height)).astype(np.float32)


def estimate_photometry(views: Sequence[ThinnedFrame], seed: int) -> Photometry:
    """Estimates gains and vignetting from the points that two views or more show.

    Each such point gives one equation, log I_i - log I_j = g_i - g_j + a (rho_i^2 - rho_j^2); they
    are solved for the log gains g and the vignetting a with the least sum of absolute residuals
    (iteratively reweighted least squares), since surfaces that shine break some of them. What the
    equations leave open is pulled to 0.
    """
    rng = np.random.default_rng(seed)
    n = len(views)
    first, second, log_ratio, radius_difference = [], [], [], []
    for i, view in enumerate(views):
        p_WQ, pixel_i = view.points(step=4)
        for j, other in enumerate(views):
            if i == j:
                continue
            number, pixel_j = other.find(p_WQ)
            I_i, I_j = view.luminance.flat[pixel_i[number]], other.luminance.flat[pixel_j]
            low, high = _BRIGHTNESS
            usable = np.flatnonzero((np.minimum(I_i, I_j) > low) & (np.maximum(I_i, I_j) < high))
            if len(usable) < _SAMPLES_PER_PAIR:
                continue
            usable = rng.choice(usable, _SAMPLES_PER_PAIR, replace=False)
            first.append(np.full(_SAMPLES_PER_PAIR, i))
            second.append(np.full(_SAMPLES_PER_PAIR, j))
            log_ratio.append(np.log(I_i[usable] / I_j[usable]))
            radius_difference.append(
                view.radius_squared.flat[pixel_i[number[usable]]]
                - other.radius_squared.flat[pixel_j[usable]]
            )
    if not first:
        return Photometry(np.ones(n), 0.0)
    i, j, b, r = map(np.concatenate, (first, second, log_ratio, radius_difference))
    equation = np.arange(len(b))
    A = coo_array(
        (
            np.concatenate([np.ones(len(b)), -np.ones(len(b)), r]),
            (np.tile(equation, 3), np.concatenate([i, j, np.full(len(b), n)])),
        ),
        shape=(len(b), n + 1),
    ).tocsr()
    weights, x = np.ones(len(b)), np.zeros(n + 1)
    for _ in range(8):
        x = lsqr(A * weights[:, None], b * weights, damp=1e-3)[0]
        weights = 1 / np.sqrt(np.maximum(np.abs(b - A @ x), 0.01))
    log_gains = x[:n] - x[:n].mean()
    return Photometry(np.exp(log_gains), float(min(x[n], 0)))


def fit_gain(color: Tensor, image: Tensor, valid: Tensor) -> float:
    """Returns the factor by which `color` (H, W, 3) comes nearest to `image` in the least-squares
    sense, over pixels `valid` (H, W) that are not saturated."""
    usable = (image < _BRIGHTNESS[1]) & valid[..., None]
    x, y = color[usable].double(), image[usable].double()
    return float((x * y).sum() / (x * x).sum().clamp(min=1e-9))
