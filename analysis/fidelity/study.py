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
from splatpilot.training.reconstruction.metrics import SceneRenderer, ViewMetrics

# From measured errors to how far they can be trusted: monotone fits and where they cross limits.
#
# Errors grow with what drives them (distance from the capture, or the share of a view nobody saw),
# up to noise, and single views that show what nobody saw are wrong by any amount. So medians over
# views are fitted by the non-decreasing function of least squares, and the reach is where that
# function exceeds its limit: one half of the views keep it there.


_MOST_GROUPS = 16
_PER_GROUP = 5  # samples at least, where x takes more values than there may be groups


@dataclass(frozen=True)
class Band:
    """Groups of samples of like x, in rising order: their mean x, their number, and the 10th, 50th
    and 90th percentile of y."""

    at: NDArray[np.float64]
    counts: NDArray[np.int64]
    low: NDArray[np.float64]
    middle: NDArray[np.float64]
    high: NDArray[np.float64]


def band(x: ArrayLike, y: ArrayLike) -> Band:
    """Groups samples by x: one group for each value if there are at most 16, otherwise up to 16
    groups of as many samples, at least 5 each."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    values, which = np.unique(np.round(x, 6), return_inverse=True)
    if len(values) <= _MOST_GROUPS:
        groups = [np.flatnonzero(which == k) for k in range(len(values))]
    else:
        count = min(_MOST_GROUPS, max(1, len(x) // _PER_GROUP))
        groups = np.array_split(np.argsort(x, kind="stable"), count)
    low, middle, high = np.array([np.percentile(y[group], [10, 50, 90]) for group in groups]).T
    at = np.array([x[group].mean() for group in groups])
    return Band(at, np.array([len(group) for group in groups]), low, middle, high)


def monotone_fit(x: ArrayLike, y: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns mean x of the groups of `band`, and there the non-decreasing function that is closest
    to the medians of y in the least-squares sense (pool adjacent violators)."""
    found = band(x, y)
    return found.at, isotonic_regression(found.middle, weights=found.counts).x


def reach(x: ArrayLike, y: ArrayLike, limit: float) -> float:
    """Returns the largest x up to which the monotone fit of y stays within `limit`.

    Between samples the fit is taken as linear. If it never exceeds the limit, the largest x that
    was measured is returned: nothing is known beyond. If it does from the start, 0.
    """
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
    """Returns how far along the rising x the values y stay at most `limit`, linear in between; 0 if
    the first does not. No more values are asked for than it takes."""
    x = np.asarray(x, np.float64)
    before = 0.0
    for k, value in enumerate(y):
        if value > limit:
            return (
                float(x[k - 1] + (x[k] - x[k - 1]) * (limit - before) / (value - before))
                if k
                else 0.0
            )
        before = value
    return float(x[-1])


@dataclass(frozen=True)
class Sample:
    """One view beside the path."""

    frame: int  # of the capture: the one displaced, or the one withheld
    offset: float  # [m] from the path, or from the nearest camera that was kept
    unseen: float  # share of the view that no camera saw like it, see `ViewSupport`
    psnr_db: float
    depth_mae_m: float
    depth_relative: float
    floater_fraction: float

    @classmethod
    def of(cls, frame: int, offset: float, unseen: float, found: ViewMetrics) -> "Sample":
        """Returns the sample of a view that has been measured, with true depth."""
        assert found.psnr_db is not None and found.depth_mae_m is not None
        assert found.depth_relative is not None and found.floater_fraction is not None
        return cls(
            frame=frame,
            offset=offset,
            unseen=unseen,
            psnr_db=found.psnr_db,
            depth_mae_m=found.depth_mae_m,
            depth_relative=found.depth_relative,
            floater_fraction=found.floater_fraction,
        )


@dataclass(frozen=True)
class FidelityStudy:
    """The samples of one scene and what follows from them."""

    name: str
    kind: str
    """Where the truth is from: "rendered", or "withheld" frames."""
    on_path_psnr_db: float
    """Of the held-out frames on the path."""
    samples: list[Sample]
    max_depth_error: float
    max_psnr_drop: float

    def column(self, name: str) -> np.ndarray:
        """Returns one figure of all samples."""
        return np.array([getattr(sample, name) for sample in self.samples])

    @cached_property
    def reach(self) -> float:
        """[m], the largest offset up to which the median view stays within the limits."""
        return self._reach("offset")

    @cached_property
    def unseen_limit(self) -> float:
        """The largest unseen share of a view at which the median view stays within the limits."""
        return self._reach("unseen")

    def at(self, offset: float) -> dict[str, float]:
        """Returns what the median view has at an offset [m], from the monotone fits; NaN where
        nothing was measured."""
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
        drop = self.on_path_psnr_db - self.column("psnr_db")
        return min(
            reach(x, self.column("depth_relative"), self.max_depth_error),
            reach(x, drop, self.max_psnr_drop),
        )

    def agreement(self) -> tuple[float, float]:
        """Returns the share of views that keep the limits among those that are trusted by what of
        them is unseen, and among the others; NaN where there are none."""
        drop = self.on_path_psnr_db - self.column("psnr_db")
        kept = (self.column("depth_relative") <= self.max_depth_error) & (
            drop <= self.max_psnr_drop
        )
        trusted = self.column("unseen") <= self.unseen_limit
        inside, outside = (
            float(kept[which].mean()) if which.any() else float("nan")
            for which in (trusted, ~trusted)
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


def choose_withheld(frames: int, stretches: Sequence[int], kept: int) -> list[int]:
    """Returns the frames to withhold: stretches of these lengths in turn, over and over, with
    `kept` frames before, between and after them.

    Raises:
        ValueError: if not even one stretch fits.
    """
    withheld: list[int] = []
    start = kept
    for length in cycle(stretches):
        if start + length + kept > frames:
            break
        withheld += range(start, start + length)
        start += length + kept
    if not withheld:
        raise ValueError(
            f"{frames} frames are too few to withhold {stretches[0]} between {kept} that are kept; "
            "withhold shorter stretches"
        )
    return withheld


def drop_frames(capture: Capture, withheld: Sequence[int]) -> Capture:
    """Returns the capture less some of its frames."""
    gone = set(withheld)
    kept = [i for i in range(len(capture)) if i not in gone]
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
    """Returns pose i of a path moved by `offset` [m] to its left, to its right, up and down.

    Left is horizontal and at right angles to the way the path goes there; where it stands still or
    goes up and down, it is along the camera's x axis.
    """
    before, after = X_WCs[max(i - 1, 0)], X_WCs[min(i + 1, len(X_WCs) - 1)]
    way = after.translation() - before.translation()
    left = np.array([-way[1], way[0], 0.0])
    if np.linalg.norm(left) < 0.5 * np.linalg.norm(way) or not way.any():
        left = -X_WCs[i].rotation().matrix()[:, 0]
    left = offset * left / np.linalg.norm(left)
    up = np.array([0.0, 0.0, offset])
    R_WC, p_WC = X_WCs[i].rotation(), X_WCs[i].translation()
    steps = (left, -left, up, -up)
    a, b, c, d = (RigidTransform(R_WC, p_WC + step) for step in steps)
    return a, b, c, d


_WIDTH = 48  # [px] of the views that are compared
_NEAREST = 16  # cameras that are asked
_DEPTH_TOLERANCE = 0.05  # relative difference of depth on the same surface
_MAX_ANGLE = np.cos(np.deg2rad(45))  # between the rays of both cameras to a point
_MAX_RATIO = 2.0  # of the distances from which both cameras see a point


class ViewSupport:
    """The share of a view's pixels whose surface a camera of the capture saw much the same way.

    A camera did if it has the point in its image, at the depth that the scene has for it there (5 %
    apart at most: nothing stands before it), from a direction at most 45 degrees off, and not from
    more than twice as far. The nearest 16 cameras are asked. Pixels that show nothing count as not
    seen.

    Args:
        renderer: of the scene.
        K, width, height: the camera [px].
        X_WCs: poses of the cameras that the scene was made from.
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
        """Returns the share, 0 to 1, for the camera at `X_WC`."""
        depth = self._render(X_WC)
        rows, columns = np.nonzero(depth > 0)
        z = depth[rows, columns].astype(np.float64)
        p_WQ = X_WC.multiply(back_project(self._K, columns + 0.5, rows + 0.5, z).T)  # (3, m)
        ray = p_WQ - X_WC.translation()[:, None]
        distance = np.linalg.norm(ray, axis=0)
        unseen = np.arange(len(z))
        for i in self._nearest(X_WC.translation()):
            sees = self._sees(i, p_WQ[:, unseen], ray[:, unseen], distance[unseen])
            unseen = unseen[~sees]
        return float((len(z) - len(unseen)) / depth.size)

    def distance(self, p_WC: ArrayLike) -> float:
        """Returns the distance to the nearest camera [m]."""
        return float(np.linalg.norm(self._p_WCs - np.asarray(p_WC), axis=1).min())

    def _nearest(self, p_WC: NDArray) -> NDArray[np.intp]:
        return np.argsort(np.linalg.norm(self._p_WCs - p_WC, axis=1), kind="stable")[:_NEAREST]

    def _sees(self, i: int, p_WQ: NDArray, ray: NDArray, distance: NDArray) -> NDArray[np.bool_]:
        """Tells which of the points (3, m) camera i saw like a camera with these rays to them."""
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
        return inside & same & near & (cosine >= _MAX_ANGLE)

    def _render(self, X_WC: RigidTransform) -> NDArray[np.float32]:
        return self._renderer.render(self._K, self._width, self._height, X_WC).depth
