"""Errors of a scene's views beside the path of its capture, and how far they can be trusted."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import cycle

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from scipy.optimize import isotonic_regression

from splatpilot.training.captures.capture import Capture, back_project, no_depth, project_points
from splatpilot.training.reconstruction.splat_rendering import SceneRenderer

_MAX_GROUPS, _PER_GROUP = 16, 5  # of samples; minimum number of samples in a group
# Views of `ViewSupport`: width [px], closest cameras that are compared, relative difference of
# depth on the same surface, cosine of the angle between rays to a point, ratio of distances to it.
_WIDTH, _CAMERAS, _DEPTH_TOLERANCE = 48, 16, 0.05
_MIN_COSINE, _MAX_RATIO = np.cos(np.deg2rad(45)), 2.0


@dataclass(frozen=True)
class Band:
    """Groups of samples of similar x, in rising order: mean x, number, and the 10th, 50th and 90th
    percentile of y."""

    at: NDArray[np.float64]
    counts: NDArray[np.int64]
    low: NDArray[np.float64]
    middle: NDArray[np.float64]
    high: NDArray[np.float64]


def band(x: ArrayLike, y: ArrayLike) -> Band:
    """Groups samples by x: a group for each value or, for more than 16, up to 16 groups of equal
    numbers of samples, at least 5 each."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    values, which = np.unique(np.round(x, 6), return_inverse=True)
    if len(values) <= _MAX_GROUPS:
        groups = [np.flatnonzero(which == k) for k in range(len(values))]
    else:
        count = min(_MAX_GROUPS, max(1, len(x) // _PER_GROUP))
        groups = np.array_split(np.argsort(x, kind="stable"), count)
    low, middle, high = np.array([np.percentile(y[group], [10, 50, 90]) for group in groups]).T
    at = np.array([x[group].mean() for group in groups])
    return Band(at, np.array([len(group) for group in groups]), low, middle, high)


def reach(x: ArrayLike, y: ArrayLike, limit: float) -> float:
    """Returns the largest x up to which the non-decreasing least-squares fit to the medians of
    `band`, linear in between, is within `limit`; 0 if the fit starts above."""
    found = band(x, y)
    fit = isotonic_regression(found.middle, weights=found.counts).x
    return first_crossing(found.at, fit, limit)


def first_crossing(x: ArrayLike, y: Iterable[float], limit: float) -> float:
    """Returns the rising x up to which the values y, linear in between, are within `limit`; 0 if
    the first is not. It takes no values beyond."""
    x = np.asarray(x, np.float64)
    before = 0.0
    for k, value in enumerate(y):
        if value > limit:
            step = (limit - before) / (value - before)
            return float(x[k - 1] + (x[k] - x[k - 1]) * step) if k else 0.0
        before = value
    return float(x[-1])


@dataclass(frozen=True)
class Sample:
    """One view off the path."""

    frame: int  # index of the displaced or held-out frame
    offset: float  # [m] from the path, or from the closest fitted camera
    unseen: float  # fraction of the view, see `ViewSupport`
    psnr_db: float
    depth_mae_m: float
    depth_relative: float
    floater_fraction: float


@dataclass(frozen=True)
class FidelityStudy:
    """The samples of one scene and their evaluation."""

    name: str
    kind: str
    """Source of the truth: "rendered", or "held-out" frames."""
    on_path_psnr_db: float  # of the held-out frames on the path
    samples: list[Sample]
    max_depth_error: float
    max_psnr_drop: float

    def column(self, name: str) -> NDArray:
        """Returns a field of all samples."""
        return np.array([getattr(sample, name) for sample in self.samples])

    @cached_property
    def reach(self) -> float:
        """[m], the largest offset at which the median view is within the limits."""
        return self._reach("offset")

    @cached_property
    def unseen_limit(self) -> float:
        """The largest unseen fraction at which the median view is within the limits."""
        return self._reach("unseen")

    def _reach(self, name: str) -> float:
        x = self.column(name)
        return min(
            reach(x, self.column("depth_relative"), self.max_depth_error),
            reach(x, self._psnr_drop, self.max_psnr_drop),
        )

    @property
    def _psnr_drop(self) -> NDArray:
        return self.on_path_psnr_db - self.column("psnr_db")

    def agreement(self) -> tuple[float, float]:
        """Returns the fraction of views within the limits, of those with an unseen fraction up to
        `unseen_limit` and of the others; NaN without any."""
        kept = self.column("depth_relative") <= self.max_depth_error
        kept &= self._psnr_drop <= self.max_psnr_drop
        trusted = self.column("unseen") <= self.unseen_limit
        inside, outside = (
            float(kept[mask].mean()) if mask.any() else float("nan") for mask in (trusted, ~trusted)
        )
        return inside, outside

    def __str__(self) -> str:
        lines = [
            f"{self.name}: {len(self.samples)} views, truth {self.kind}; on the path "
            f"{self.on_path_psnr_db:.2f} dB; medians and 10 to 90 % of the views",
            f"{'offset [m]':>10} {'views':>6} {'PSNR [dB]':>21} {'depth MAE [m]':>24} "
            f"{'relative [%]':>20}",
        ]
        x = self.column("offset")
        bands = [
            band(x, factor * self.column(name))
            for name, factor in (("psnr_db", 1), ("depth_mae_m", 1), ("depth_relative", 100))
        ]
        for k, (at, count) in enumerate(zip(bands[0].at, bands[0].counts, strict=True)):
            psnr, mae, relative = (
                f"{b.middle[k]:.{digits}f} ({b.low[k]:.{digits}f} to {b.high[k]:.{digits}f})"
                for b, digits in zip(bands, (1, 3, 1), strict=True)
            )
            lines.append(f"{at:>10.2f} {count:>6} {psnr:>21} {mae:>24} {relative:>20}")
        inside, outside = self.agreement()
        lines += [
            f"the median view is within limits to {self.reach:.2f} m: depth errors up to "
            f"{self.max_depth_error:.0%} and PSNR up to {self.max_psnr_drop:g} dB lower",
            f"trusted views: those seen to {1 - self.unseen_limit:.0%} or more; {inside:.0%} of "
            f"them keep these limits, {outside:.0%} of the others",
        ]
        return "\n".join(lines)


def choose_held_out(frames: int, stretches: Sequence[int], kept: int) -> list[int]:
    """Returns the indices of held-out frames: stretches of these lengths in turn, between `kept`
    frames each."""
    held_out: list[int] = []
    start = kept
    for length in cycle(stretches):
        if start + length + kept > frames:
            break
        held_out += range(start, start + length)
        start += length + kept
    if not held_out:
        raise ValueError(
            f"{frames} frames are too few to hold out {stretches[0]} between {kept} that are kept; "
            "hold out shorter stretches"
        )
    return held_out


def drop_frames(capture: Capture, held_out: Sequence[int]) -> Capture:
    """Returns the capture without some of its frames."""
    kept = sorted(set(range(len(capture))).difference(held_out))
    return replace(
        capture,
        X_WCs=[capture.X_WCs[i] for i in kept],
        load_image=lambda k: capture.load_image(kept[k]),
        load_depth=(lambda k: capture.load_depth(kept[k])) if capture.has_depth else no_depth,
        load_valid=lambda k: capture.load_valid(kept[k]),
        held_out=None,
        frame_names=[capture.frame_names[i] for i in kept] if capture.frame_names else (),
        folder="",
    )


def displace_pose(
    X_WCs: Sequence[RigidTransform], i: int, offset: float
) -> tuple[RigidTransform, RigidTransform, RigidTransform, RigidTransform]:
    """Returns pose i of a path moved by `offset` [m] left, right, up and down. Left is horizontal
    and perpendicular to the path or, if that is vertical or at rest, along the camera's -x axis."""
    before, after = X_WCs[max(i - 1, 0)], X_WCs[min(i + 1, len(X_WCs) - 1)]
    path = after.translation() - before.translation()
    left = np.array([-path[1], path[0], 0.0])
    if np.linalg.norm(left) < 0.5 * np.linalg.norm(path) or not path.any():
        left = -X_WCs[i].rotation().matrix()[:, 0]
    left = offset * left / np.linalg.norm(left)
    up = np.array([0.0, 0.0, offset])
    R_WC, p_WC = X_WCs[i].rotation(), X_WCs[i].translation()
    steps = (left, -left, up, -up)
    a, b, c, d = (RigidTransform(R_WC, p_WC + step) for step in steps)
    return a, b, c, d


class ViewSupport:
    """The fraction of a view's pixels whose surface a fitted camera saw similarly. One of the 16
    closest cameras saw the point at the depth of the scene (within 5 %), from a direction within 45
    degrees and from at most twice the distance. `camera` is K (3, 3), width and height [px]."""

    def __init__(
        self,
        renderer: SceneRenderer,
        camera: tuple[NDArray, int, int],
        X_WCs: Sequence[RigidTransform],
    ):
        K, width, height = camera
        shrunk = _WIDTH / width
        self._K = K.copy()
        self._K[:2] *= shrunk
        self._height = max(1, round(height * shrunk))
        self._renderer = renderer
        self._X_WCs = list(X_WCs)
        self._p_WCs = np.array([X_WC.translation() for X_WC in X_WCs])  # (n, 3)
        self._depths: dict[int, NDArray] = {}

    def fraction(self, X_WC: RigidTransform) -> float:
        """Returns the fraction, 0 to 1, for the camera at `X_WC`."""
        depth = self._render(X_WC)
        rows, columns = np.nonzero(depth > 0)
        z = depth[rows, columns].astype(np.float64)
        p_WQ = X_WC.multiply(back_project(self._K, columns + 0.5, rows + 0.5, z).T)  # (3, m)
        ray = p_WQ - X_WC.translation()[:, None]
        unseen = np.arange(len(z))
        distances = np.linalg.norm(self._p_WCs - X_WC.translation(), axis=1)
        for i in np.argsort(distances, kind="stable")[:_CAMERAS]:
            unseen = unseen[~self._sees(i, p_WQ[:, unseen], ray[:, unseen])]
        return float((len(z) - len(unseen)) / depth.size)

    def distance(self, p_WC: ArrayLike) -> float:
        """Returns the distance to the closest camera [m]."""
        return float(np.linalg.norm(self._p_WCs - np.asarray(p_WC), axis=1).min())

    def _sees(self, i: int, p_WQ: NDArray, ray: NDArray) -> NDArray[np.bool_]:
        """Returns which of the points (3, m) camera i saw like a camera with these rays to them."""
        p_CQ = self._X_WCs[i].inverse().multiply(p_WQ).T
        inside, rows, columns = project_points(self._K, p_CQ, _WIDTH, self._height)
        if i not in self._depths:
            self._depths[i] = self._render(self._X_WCs[i])
        z, ray = p_CQ[inside, 2], ray[:, inside]
        other_ray = p_WQ[:, inside] - self._p_WCs[i][:, None]
        distance, other_distance = (np.linalg.norm(r, axis=0) for r in (ray, other_ray))
        cosine = (ray * other_ray).sum(axis=0) / np.maximum(distance * other_distance, 1e-12)
        same = np.abs(self._depths[i][rows, columns] - z) <= _DEPTH_TOLERANCE * z
        near = other_distance <= _MAX_RATIO * distance
        inside[inside] = same & near & (cosine >= _MIN_COSINE)
        return inside

    def _render(self, X_WC: RigidTransform) -> NDArray[np.float32]:
        return self._renderer.render(self._K, _WIDTH, self._height, X_WC).depth
