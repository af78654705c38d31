"""Errors of a scene's views beside the path of its capture, and how far they can be trusted."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import cycle

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from scipy.optimize import isotonic_regression

from splatpilot.training.captures.capture import Capture, back_project, no_depth
from splatpilot.training.reconstruction.metrics import ViewMetrics
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
    """Groups samples by x: a group for each value or, for more than 16, up to 16 groups of as many
    samples, at least 5 each."""
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


def monotone_fit(x: ArrayLike, y: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns mean x of the groups of `band`, and the non-decreasing least-squares fit to their
    medians of y (pool adjacent violators).

    Errors grow with distance, up to noise; medians ignore views of what no camera saw.
    """
    found = band(x, y)
    return found.at, isotonic_regression(found.middle, weights=found.counts).x


def reach(x: ArrayLike, y: ArrayLike, limit: float) -> float:
    """Returns the largest x up to which the monotone fit of y, linear in between, is within
    `limit`: at most the largest measured x, and 0 if the fit starts above."""
    at, fit = monotone_fit(x, y)
    beyond = np.flatnonzero(fit > limit)
    if not len(beyond):
        return float(at[-1])
    first = beyond[0]
    if first == 0:
        return 0.0
    (x0, x1), (y0, y1) = at[first - 1 : first + 1], fit[first - 1 : first + 1]
    return float(x0 + (x1 - x0) * (limit - y0) / (y1 - y0))


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

    @classmethod
    def of(cls, frame: int, offset: float, unseen: float, found: ViewMetrics) -> "Sample":
        """Returns the sample of a measured view with true depth."""
        names = ("psnr_db", "depth_mae_m", "depth_relative", "floater_fraction")
        return cls(frame, offset, unseen, **{name: getattr(found, name) for name in names})


@dataclass(frozen=True)
class FidelityStudy:
    """The samples of one scene and their evaluation."""

    name: str
    kind: str
    """Source of the truth: "rendered", or "withheld" frames."""
    on_path_psnr_db: float
    """[dB] of the held-out frames on the path."""
    samples: list[Sample]
    max_depth_error: float
    max_psnr_drop: float

    def column(self, name: str) -> np.ndarray:
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

    def at(self, offset: float) -> dict[str, float]:
        """Returns the metrics of the median view at an offset [m], from the monotone fits; NaN
        outside the measured range."""
        x = self.column("offset")
        if not x.min() - 1e-9 <= offset <= x.max() + 1e-9:
            return dict.fromkeys(("psnr_db", "depth_mae_m", "depth_relative"), float("nan"))
        found = {}
        for name, sign in (("psnr_db", -1), ("depth_mae_m", 1), ("depth_relative", 1)):
            at, fit = monotone_fit(x, sign * self.column(name))
            found[name] = sign * float(np.interp(offset, at, fit))
        return found

    def _reach(self, name: str) -> float:
        x = self.column(name)
        return min(
            reach(x, self.column("depth_relative"), self.max_depth_error),
            reach(x, self._psnr_drop, self.max_psnr_drop),
        )

    @property
    def _psnr_drop(self) -> np.ndarray:
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
    """Returns the indices of held-out frames: stretches of these lengths, repeated in turn, with
    `kept` frames before, between and after them."""
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
    """Returns pose i of a path moved by `offset` [m] left, right, up and down.

    Left is horizontal and perpendicular to the path or, if that is vertical or at rest, along the
    camera's -x axis.
    """
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
    """The fraction of a view's pixels whose surface a fitted camera saw similarly.

    A camera did if the point is in its image at the depth of the scene there (within 5 %: it is not
    occluded), from a direction within 45 degrees and from at most twice the distance. Only the 16
    closest cameras count. Pixels without a surface are unseen.

    Args:
        renderer: of the scene.
        K, width, height: of the camera [px].
        X_WCs: poses of the fitted cameras.
    """

    def __init__(
        self,
        renderer: SceneRenderer,
        K: NDArray,
        width: int,
        height: int,
        X_WCs: Sequence[RigidTransform],
    ):
        shrunk = _WIDTH / width
        self._K = K.copy()
        self._K[:2] *= shrunk
        self._width, self._height = _WIDTH, max(1, round(height * shrunk))
        self._renderer = renderer
        self._X_WCs = list(X_WCs)
        self._p_WCs = np.array([X_WC.translation() for X_WC in X_WCs])  # (n, 3)
        self._depths: dict[int, NDArray] = {}

    def of(self, X_WC: RigidTransform) -> float:
        """Returns the fraction, 0 to 1, for the camera at `X_WC`."""
        depth = self._render(X_WC)
        rows, columns = np.nonzero(depth > 0)
        z = depth[rows, columns].astype(np.float64)
        p_WQ = X_WC.multiply(back_project(self._K, columns + 0.5, rows + 0.5, z).T)  # (3, m)
        ray = p_WQ - X_WC.translation()[:, None]
        distance = np.linalg.norm(ray, axis=0)
        unseen = np.arange(len(z))
        distances = np.linalg.norm(self._p_WCs - X_WC.translation(), axis=1)
        for i in np.argsort(distances, kind="stable")[:_CAMERAS]:
            sees = self._sees(i, p_WQ[:, unseen], ray[:, unseen], distance[unseen])
            unseen = unseen[~sees]
        return float((len(z) - len(unseen)) / depth.size)

    def distance(self, p_WC: ArrayLike) -> float:
        """Returns the distance to the closest camera [m]."""
        return float(np.linalg.norm(self._p_WCs - np.asarray(p_WC), axis=1).min())

    def _sees(self, i: int, p_WQ: NDArray, ray: NDArray, distance: NDArray) -> NDArray[np.bool_]:
        """Returns which of the points (3, m) camera i saw like a camera with these rays to them."""
        x, y, z = self._X_WCs[i].inverse().multiply(p_WQ)
        in_front = np.maximum(z, 1e-6)
        column = np.floor(self._K[0, 0] * x / in_front + self._K[0, 2])
        row = np.floor(self._K[1, 1] * y / in_front + self._K[1, 2])
        inside = (
            (z > 0) & (column >= 0) & (column < self._width) & (row >= 0) & (row < self._height)
        )
        if i not in self._depths:
            self._depths[i] = self._render(self._X_WCs[i])
        column, row = (np.where(inside, index, 0).astype(int) for index in (column, row))
        same = np.abs(self._depths[i][row, column] - z) <= _DEPTH_TOLERANCE * np.maximum(z, 0)
        own_ray = p_WQ - self._p_WCs[i][:, None]
        own_distance = np.linalg.norm(own_ray, axis=0)
        cosine = (ray * own_ray).sum(axis=0) / np.maximum(distance * own_distance, 1e-12)
        near = own_distance <= _MAX_RATIO * distance
        return inside & same & near & (cosine >= _MIN_COSINE)

    def _render(self, X_WC: RigidTransform) -> NDArray[np.float32]:
        return self._renderer.render(self._K, self._width, self._height, X_WC).depth
