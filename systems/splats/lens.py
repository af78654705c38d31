"""Lenses that bend the rays of a pinhole camera: OpenCV's rational and fisheye models.

Points are on the image plane of focal length 1; see OpenCV, and Kannala and Brandt, PAMI 2006.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, wraps
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.polynomial import Polynomial

from splatpilot.systems.common.validation import Config, bounded, require_field

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

NUM_RADIAL = {"opencv": 6, "fisheye": 4}
"""Maximum number of radial coefficients of each model."""

_MARGIN = 0.15  # fraction of the image around it in which rays are still projected as if inside
_BLUR = 3.0  # [px] by which the blur of a pixel spreads Gaussians around the image
_NEWTON_STEPS, _STEP = 6, 1e-5  # of tangential distortion; [-] of slopes for its derivatives
_SAMPLES, _STEPS = 4097, 6  # of the radial table and of its refinement, to rounding


@dataclass
class Distortion(Config):
    """Lens model.

    A ray of slopes (x, y) = (X / Z, Y / Z), r^2 = x^2 + y^2, meets the image plane at (x', y'),
    pixels K (x', y', 1). "opencv", with g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4
    + k6 r^6): x' = g x + 2 p1 x y + p2 (r^2 + 2 x^2), y' = g y + p1 (r^2 + 2 y^2) + 2 p2 x y.
    "fisheye", with a = atan r: (x', y') = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8) (x, y) / r.
    """

    # OpenCV's rational model or its fisheye.
    model: str = bounded("opencv", "{opencv, fisheye}")
    # k1, k2, ...: up to six of "opencv", up to four of "fisheye"; the others are zero.
    radial: list[float] = bounded(list, "(-inf, inf)")
    # p1, p2 of "opencv"; zero if empty.
    tangential: list[float] = bounded(list, "(-inf, inf)")
    # [deg] Largest angle from the optical axis that the lens shows; depth is along that axis.
    max_angle: float = bounded(85.0, "(0, 85] deg")

    def check(self) -> None:
        most = NUM_RADIAL[self.model]
        require_field(self, "radial", len(self.radial) <= most, f"at most {most} numbers")
        count = 2 if self.model == "opencv" else 0
        valid = len(self.tangential) in (0, count)
        require_field(self, "tangential", valid, f"{count} numbers of {self.model}, or none")

    def __hash__(self) -> int:
        return hash((self.model, *self.radial, *self.tangential, self.max_angle))

    @property
    def limit(self) -> float:
        """The largest r on the image: beyond, the lens would fold it back."""
        k = _padded(self.radial, NUM_RADIAL[self.model])
        widest = math.radians(self.max_angle)
        if self.model == "fisheye":  # where a (1 + k1 a^2 + ...) stops growing
            factors = zip((3, 5, 7, 9), k, strict=True)
            growth = Polynomial([1.0, *(n * each for n, each in factors)])  # of a^2
            return math.tan(min(widest, math.sqrt(_first_root(growth))))
        top, bottom = Polynomial([1.0, *k[:3]]), Polynomial([1.0, *k[3:]])  # of r^2
        growth = top * bottom + 2 * Polynomial([0, 1]) * (
            top.deriv() * bottom - top * bottom.deriv()
        )
        return min(math.tan(widest), math.sqrt(min(_first_root(growth), _first_root(bottom))))

    def project(self, slopes: "ArrayLike") -> "NDArray[np.float64]":
        """Projects rays of `slopes` (..., 2) to the image plane (..., 2); NaN beyond `limit`."""
        slopes = np.asarray(slopes, dtype=np.float64)
        return np.where(
            _lengths(slopes)[..., None] < self.limit, self._bent(slopes, self.tangential), np.nan
        )

    def slopes(self, points: "ArrayLike") -> "NDArray[np.float64]":
        """Inverts `project`: slopes (..., 2) of rays to `points` (..., 2); NaN without one.

        OpenCV's own inverses diverge toward the limit.
        """
        points = np.asarray(points, dtype=np.float64)
        slopes = self._undistort_radially(points)
        known = np.isfinite(slopes[..., 0])
        if not any(self.tangential) or not known.any():
            return slopes
        found = slopes[known]
        for _ in range(_NEWTON_STEPS):
            ahead, behind = (
                [self._bent(found + step, self.tangential) for step in sign * _STEP * np.eye(2)]
                for sign in (1.0, -1.0)
            )
            jacobian = (np.stack(ahead, -1) - np.stack(behind, -1)) / (2.0 * _STEP)
            off = points[known] - self._bent(found, self.tangential)
            found = found + np.linalg.solve(jacobian, off[..., None])[..., 0]
        off = np.abs(self.project(found) - points[known]).max(axis=-1)  # NaN beyond the limit
        slopes[known] = np.where(off[..., None] < 1e-9, found, np.nan)
        return slopes

    def _bent(
        self, slopes: "NDArray[np.float64]", tangential: Sequence[float]
    ) -> "NDArray[np.float64]":
        k = _padded(self.radial, NUM_RADIAL[self.model])
        flat = np.nan_to_num(slopes).reshape(-1, 1, 2)
        if self.model == "fisheye":
            bent = cv2.fisheye.distortPoints(flat, np.eye(3), np.array(k))
        else:
            rays = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=2)
            coefficients = np.array([*k[:2], *_padded(tangential, 2), *k[2:]])
            bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), coefficients)
        return np.asarray(bent, dtype=np.float64).reshape(slopes.shape)

    def _radius(self, r: "NDArray[np.float64]") -> "NDArray[np.float64]":
        """Returns r g(r), the image radius without the tangential part."""
        return self._bent(np.stack([r, np.zeros_like(r)], -1), [])[..., 0]

    def _undistort_radially(self, points: "NDArray[np.float64]") -> "NDArray[np.float64]":
        table = np.linspace(0.0, self.limit, _SAMPLES)
        radii = self._radius(table)
        desired = _lengths(points)
        cell = np.clip(np.searchsorted(radii, desired) - 1, 0, _SAMPLES - 2)
        low, high = table[cell], table[cell + 1]
        chord = (high - low) / (radii[cell + 1] - radii[cell])
        r = low + (desired - radii[cell]) * chord
        for _ in range(_STEPS):
            r = np.clip(r + (desired - self._radius(r)) * chord, low, high)
        share = np.divide(r, desired, out=np.ones_like(r), where=desired > 0)
        return np.where(desired < radii[-1], share, np.nan)[..., None] * points


type _Intrinsics = tuple[float, float, float, float]  # fx, fy, cx, cy


def _cached[T](maxsize: int) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Caches a function of a lens, intrinsics, width and height by their values."""

    def decorate(compute: Callable[..., T]) -> Callable[..., T]:
        cached = lru_cache(maxsize)(compute)

        def call(distortion: Distortion | None, K: "NDArray", width: int, height: int) -> T:
            intrinsics = tuple(map(float, K[[0, 1, 0, 1], [0, 1, 2, 2]]))
            return cached(distortion, intrinsics, width, height)

        return wraps(compute)(call)

    return decorate


@_cached(512)  # each band of a rolling shutter has one
def native_lens(
    distortion: Distortion, intrinsics: _Intrinsics, width: int, height: int
) -> "NDArray[np.float64]":
    """Returns the renderer's numbers (17,) of a camera with the intrinsics K (3, 3) [px]: radial 6,
    tangential 2, limit^2, min and max slopes of the image and, the same, of its rows."""
    fx, fy, cx, cy = intrinsics
    along = np.linspace(-1.0, 1.0, 257)
    edges = [(along, np.full(257, end)) for end in (-1.0, 1.0)]
    border = np.concatenate([np.stack(pair, -1) for a, b in edges for pair in ((a, b), (b, a))])
    size = np.array([width, height])
    half = 0.5 * size + np.maximum(_MARGIN * size, _BLUR)
    points = (0.5 * size + border * half - [cx, cy]) / [fx, fy]
    slopes = distortion.slopes(points)
    # The limit of the lens replaces a border beyond it.
    outward = distortion.limit * points / np.maximum(_lengths(points), 1e-12)[:, None]
    slopes = np.where(np.isnan(slopes), outward, slopes)
    numbers = [
        *_padded(distortion.radial, 6),
        *_padded(distortion.tangential, 2),
        min(distortion.limit**2, 1e12),
        *(*slopes.min(axis=0), *slopes.max(axis=0)) * 2,
    ]
    return np.array(numbers)


@_cached(8)
def pixel_slopes(
    distortion: Distortion | None, intrinsics: _Intrinsics, width: int, height: int
) -> "NDArray[np.float64]":
    """Returns the slopes (height, width, 2) of a camera's pixels; NaN without a ray. The camera is
    a pinhole if `distortion` is None."""
    fx, fy, cx, cy = intrinsics
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    points = np.stack([(u - cx) / fx, (v - cy) / fy], -1).astype(np.float64)
    slopes = points if distortion is None else distortion.slopes(points)
    slopes.setflags(write=False)
    return slopes


def _padded(numbers: Sequence[float], count: int) -> list[float]:
    return [*numbers, *[0.0] * (count - len(numbers))]


def _lengths(points: "NDArray[np.float64]") -> "NDArray[np.float64]":
    return np.hypot(points[..., 0], points[..., 1])


def _first_root(polynomial: Polynomial) -> float:
    """Returns the least positive real root; inf without one."""
    roots = polynomial.trim().roots()
    positive = roots.real[(roots.imag == 0) & (roots.real > 0)]
    return float(np.min(positive, initial=math.inf))
