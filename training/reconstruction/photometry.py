"""Photometry of a capture: overlap of its frames, gains of its images and vignetting."""

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
from splatpilot.training.captures.capture import CaptureFrame, back_project, project_points

_THINNED_WIDTH = 160  # [px], about that of thinned frames
_DEPTH_TOLERANCE = 0.01  # relative, of depth on the same surface, without its slope
_COARSER = 1.5  # size of pixels that count as finest, relative to the finest
_SAMPLES_PER_PAIR = 100
_BRIGHTNESS = (0.1, 0.98)  # outside, noise or saturation spoils the ratio


def radius_squared(width: int, height: int) -> NDArray[np.float64]:
    """Returns rho^2 (height, width), rho being the distance from the center, 1 in the corners."""
    x = np.arange(width) + 0.5 - width / 2
    y = (np.arange(height) + 0.5 - height / 2)[:, None]
    return (x**2 + y**2) / ((width**2 + height**2) / 4)


def vignette(vignetting: float, width: int, height: int) -> NDArray[np.float64]:
    """Returns the brightness (height, width) relative to the center's, given the corners' log."""
    return np.exp(vignetting * radius_squared(width, height))


def widen(pixels: NDArray, stride: int, height: int, width: int) -> NDArray:
    """Returns pixels (h, w) of a thinned frame in the size (height, width) of the frame."""
    return pixels.repeat(stride, axis=0).repeat(stride, axis=1)[:height, :width]


@dataclass(frozen=True, eq=False)
class ThinnedFrame:
    """A frame for comparison with others; (h, w) = (H, W) / `stride`."""

    stride: int  # one in so many pixels is kept along each axis
    X_WC: RigidTransform
    K: NDArray[np.float64]  # (3, 3) [px], of the whole frame
    depth: NDArray[np.floating]  # (h, w) [m]; 0 if unknown or sky
    tolerance: NDArray[np.floating]  # (h, w) [m], difference of depth on the same surface
    pixel_size: NDArray[np.floating]  # (h, w) [m], longest extent of a whole pixel on the surface
    luminance: NDArray[np.floating]  # (h, w), 0 to 1
    radius_squared: NDArray[np.floating]  # (h, w), see `radius_squared`

    @classmethod
    def of(cls, frame: CaptureFrame) -> "ThinnedFrame":
        height, width = frame.depth.shape
        stride = max(2, round(width / _THINNED_WIDTH))
        thin = (slice(None, None, stride), slice(None, None, stride))
        depth = np.where(frame.depth < FAR, frame.depth, 0).astype(np.float32)
        w = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
        w_v, w_u = (_smaller_difference(w, axis)[thin] for axis in (0, 1))
        depth = depth[thin]
        # A plane is linear in inverse depth w: z changes by z^2 dw over one pixel.
        slope = depth * np.hypot(w_u, w_v)  # relative change of depth per pixel
        f = frame.K[0, 0]
        return cls(
            stride=stride,
            X_WC=frame.X_WC,
            K=frame.K,
            depth=depth,
            tolerance=depth * (_DEPTH_TOLERANCE + np.minimum(stride * slope, 0.1)),
            pixel_size=depth / f * np.minimum(np.hypot(1, f * slope), 10),
            luminance=frame.image[thin].mean(-1) / 255,
            radius_squared=radius_squared(width, height)[thin].astype(np.float32),
        )

    def points(self, step: int = 1) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Returns the points p_WQ (3, n) of every `step`-th pixel and the flat index of each."""
        (h, w), s = self.depth.shape, self.stride
        rows, columns = np.mgrid[0:h:step, 0:w:step]
        index = (rows * w + columns).ravel()
        index = index[self.depth.flat[index] > 0]
        z = self.depth.flat[index].astype(np.float64)
        p_CQ = back_project(self.K, index % w * s + 0.5, index // w * s + 0.5, z)
        return self.X_WC.multiply(p_CQ.T), index

    def find(self, p_WQ: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Returns the indices of the points (3, n) that this view sees, and of their pixels."""
        h, w = self.depth.shape
        p_CQ = self.X_WC.inverse().multiply(p_WQ).T
        K = self.K / [[self.stride], [self.stride], [1]]
        inside, rows, columns = project_points(K, p_CQ, w, h)
        number, index = np.flatnonzero(inside), rows * w + columns
        same = np.abs(self.depth.flat[index] - p_CQ[number, 2]) < self.tolerance.flat[index]
        return number[same], index[same]


def find_overlaps(views: Sequence[ThinnedFrame]) -> list[list[int]]:
    """Returns, for each view, the indices of those that see some of its points, itself included."""
    X_CWs = np.stack([view.X_WC.inverse().GetAsMatrix34() for view in views]).astype(np.float32)
    KX_CWs = np.stack([view.K for view in views]).astype(np.float32) @ X_CWs  # (n, 3, 4)
    sizes = [np.multiply(view.stride, view.depth.shape[::-1]) for view in views]
    limit = np.array(sizes, np.float32)[..., None] + 1  # (n, 2, 1) [px], with a margin
    overlaps = []
    for view in views:
        p_WQ, _ = view.points(step=8)
        projected = KX_CWs @ np.concatenate([p_WQ, np.ones((1, p_WQ.shape[1]))]).astype(np.float32)
        z = projected[:, 2:]  # (n, 1, m)
        inside = (projected[:, :2] >= -z) & (projected[:, :2] <= limit * z)  # with a margin of 1 px
        possible = np.flatnonzero((inside.all(axis=1) & (z[:, 0] > 0)).any(axis=1))
        overlaps.append([j for j in possible.tolist() if len(views[j].find(p_WQ)[0])])
    return overlaps


def find_new_pixels(
    views: Sequence[ThinnedFrame], last: Collection[int] = (), smooth: bool = True
) -> list[NDArray[np.bool_]]:
    """Finds, for each view, the pixels (h, w) that keep every point about once: nearly the finest
    of their point, in the first view that has them, from the closest to the farthest view, those
    with an index in `last` after the others. `smooth` removes speckle."""
    overlapping = find_overlaps(views)
    fine = []  # pixels that are nearly the finest
    for i, view in enumerate(Progress(views, "comparing frames", unit="frame")):
        p_WQ, pixel = view.points()
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
        p_WQ, pixel = view.points()
        covered = np.zeros(view.depth.size, dtype=bool)
        for j in overlapping[i]:
            if j in new:
                number, shown = views[j].find(p_WQ)
                covered[pixel[number]] |= new[j].flat[shown]
        keep = fine[i] & ~covered.reshape(view.depth.shape)
        if smooth:  # for speckle, where two views are about equally fine
            keep = cv2.medianBlur(keep.astype(np.uint8), 5) > 0
        new[i] = keep & (view.depth > 0)
    return [new[i] for i in range(len(views))]


def seen_pixels(frame: CaptureFrame, views: Sequence[ThinnedFrame]) -> NDArray[np.bool_]:
    """Returns the pixels (H, W) of a frame whose point one of the views saw, or without depth."""
    own = ThinnedFrame.of(frame)
    p_WQ, pixel = own.points()
    seen = own.depth.ravel() == 0
    p_WC = own.X_WC.translation()
    # The closest first: they find most points.
    for view in sorted(views, key=lambda v: float(np.linalg.norm(v.X_WC.translation() - p_WC))):
        number, _ = view.find(p_WQ)
        seen[pixel[number]] = True
        p_WQ, pixel = np.delete(p_WQ, number, axis=1), np.delete(pixel, number)
    # Closes speckle along edges, where depths of one point disagree.
    image = seen.reshape(own.depth.shape).astype(np.uint8)
    image = cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    height, width = frame.depth.shape
    return widen(image, own.stride, height, width) > 0


def _smaller_difference(values: NDArray, axis: int) -> NDArray:
    """Returns the smaller of forward and backward difference, which ignores edges."""
    step = np.diff(values, axis=axis)
    forward = np.concatenate([step, step.take([-1], axis)], axis)
    backward = np.concatenate([step.take([0], axis), step], axis)
    return np.where(np.abs(forward) < np.abs(backward), forward, backward)


@dataclass(frozen=True, eq=False)
class Photometry:
    """Relates image values I to those of the scene S: I = gain_i exp(vignetting rho^2) S. The
    logarithms of the gains have the mean 0. For rho, see `radius_squared`."""

    gains: NDArray[np.float64]  # (n,)
    vignetting: float  # logarithm of the relative brightness of the corners, at most 0

    def factor(self, i: int, height: int, width: int) -> NDArray[np.float32]:
        """Returns I / S for the pixels of image i, (height, width)."""
        return (self.gains[i] * vignette(self.vignetting, width, height)).astype(np.float32)


def estimate_photometry(views: Sequence[ThinnedFrame], seed: int) -> Photometry:
    """Estimates log gains g and vignetting a from points that at least two views show,
    log I_i - log I_j = g_i - g_j + a (rho_i^2 - rho_j^2), by iteratively reweighted least squares:
    shiny surfaces give outliers. Damping makes free variables 0."""
    rng = np.random.default_rng(seed)
    n = len(views)
    samples = []
    for i, (view, overlapping) in enumerate(zip(views, find_overlaps(views), strict=True)):
        p_WQ, pixel_i = view.points(step=4)
        for j in overlapping:
            if i == j:
                continue
            other = views[j]
            index, pixel_j = other.find(p_WQ)
            I_i, I_j = view.luminance.flat[pixel_i[index]], other.luminance.flat[pixel_j]
            low, high = _BRIGHTNESS
            usable = np.flatnonzero((np.minimum(I_i, I_j) > low) & (np.maximum(I_i, I_j) < high))
            if len(usable) < _SAMPLES_PER_PAIR:
                continue
            usable = rng.choice(usable, _SAMPLES_PER_PAIR, replace=False)
            rho_i = view.radius_squared.flat[pixel_i[index[usable]]]
            rho_j = other.radius_squared.flat[pixel_j[usable]]
            pair = np.full(_SAMPLES_PER_PAIR, i), np.full(_SAMPLES_PER_PAIR, j)
            samples.append((*pair, np.log(I_i[usable] / I_j[usable]), rho_i - rho_j))
    if not samples:
        return Photometry(np.ones(n), 0.0)
    i, j, b, r = (np.concatenate(column) for column in zip(*samples, strict=True))
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


def predict_gains(
    fitted: Sequence[int], gains: NDArray[np.float64], others: Sequence[int]
) -> NDArray[np.float64]:
    """Predicts the gains of the frames `others` (m,) from those of the `fitted` frames (n,), both
    numbered in order of time: interpolated logarithms, shrunk by the factor from 0 to 1 that
    predicts fitted gains best from their neighbors, about 0 for photographs in any order."""
    numbers, log_gains = np.asarray(fitted, float), np.log(gains)
    middle = numbers[1:-1]
    share = (middle - numbers[:-2]) / np.maximum(numbers[2:] - numbers[:-2], 1)
    neighbors = (1 - share) * log_gains[:-2] + share * log_gains[2:]
    energy = float(neighbors @ neighbors)
    factor = float(neighbors @ log_gains[1:-1]) / energy if energy > 0 else 0.0
    return np.exp(min(max(factor, 0.0), 1.0) * np.interp(others, numbers, log_gains))


def fit_gain(color: Tensor, image: Tensor, valid: Tensor) -> float:
    """Returns the least-squares factor from `color` to `image` (H, W, 3) in unsaturated pixels."""
    usable = (image < _BRIGHTNESS[1]) & valid[..., None]
    x, y = color[usable].double(), image[usable].double()
    return float((x * y).sum() / (x * x).sum().clamp(min=1e-9))
