"""Lenses that bend what a pinhole camera would see.

OpenCV's models ("Camera Calibration and 3D Reconstruction" and "Fisheye camera model"; Kannala and
Brandt, PAMI 2006), on the image plane of focal length 1: what pixels there are is the intrinsics'
business.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

if TYPE_CHECKING:
    from numpy.typing import NDArray

MODELS = {"opencv": 6, "fisheye": 4}
"""Names of the models, and how many radial coefficients they have at most."""

MOST_ANGLE = 85.0
"""[deg] from the optical axis that a lens shows at most: depth is along it."""

_MARGIN = 0.15
"""Part of the image around it in which what is seen is still projected as if it were in it."""

_STEPS = 60
"""Bisections, to the last bit."""


@dataclass
class Distortion:
    """How a lens bends rays.

    A ray of slopes (x, y) = (X / Z, Y / Z), r^2 = x^2 + y^2, meets the image plane at (x', y'),
    pixels K (x', y', 1). "opencv", with g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4
    + k6 r^6): x' = g x + 2 p1 x y + p2 (r^2 + 2 x^2), y' = g y + p1 (r^2 + 2 y^2) + 2 p2 x y.
    "fisheye", with a = atan r: (x', y') = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8) (x, y) / r.
    """

    # "opencv" or "fisheye".
    model: str = "opencv"
    # k1, k2, ...: up to six of "opencv", up to four of "fisheye"; those left out are zero.
    radial: list[float] = field(default_factory=list)
    # p1, p2 of "opencv"; zero where left out.
    tangential: list[float] = field(default_factory=list)
    # [deg] From the optical axis beyond which the lens shows nothing.
    max_angle: float = MOST_ANGLE

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        if self.model not in MODELS:
            raise ValueError(f"model is {self.model!r}; choose {' or '.join(MODELS)}")
        most, tangential = MODELS[self.model], 2 if self.model == "opencv" else 0
        if len(self.radial) > most:
            raise ValueError(f"radial has {len(self.radial)} numbers; {self.model} has {most}")
        if len(self.tangential) not in (0, tangential):
            raise ValueError(
                f"tangential has {len(self.tangential)} numbers; {self.model} has {tangential}"
            )
        for name in ("radial", "tangential"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} is {getattr(self, name)}; it must be finite numbers")
        if not 0.0 < self.max_angle <= MOST_ANGLE:
            raise ValueError(
                f"max_angle is {self.max_angle}; it must be more than 0, at most {MOST_ANGLE} deg"
            )

    @property
    def limit(self) -> float:
        """The greatest r that has a place on the image: beyond, the lens would fold it back."""
        k = _padded(self.radial, MODELS[self.model])
        widest = math.radians(self.max_angle)
        if self.model == "fisheye":
            return math.tan(min(widest, fisheye_limit(k)))
        return min(math.tan(widest), opencv_limit(k))

    def project(self, slopes: "NDArray[np.float64]") -> "NDArray[np.float64]":
        """Where rays of `slopes` (..., 2) meet the image plane (..., 2); NaN beyond `limit`."""
        slopes = np.asarray(slopes, dtype=np.float64)
        x, y = np.moveaxis(slopes, -1, 0)
        p1, p2 = _padded(self.tangential, 2)
        s = x * x + y * y
        g = self._scale(np.sqrt(s))
        bent = np.stack(
            [
                g * x + 2 * p1 * x * y + p2 * (s + 2 * x * x),
                g * y + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
            ],
            -1,
        )
        return np.where((s < self.limit**2)[..., None], bent, np.nan)

    def slopes(self, points: "NDArray[np.float64]") -> "NDArray[np.float64]":
        """The slopes (..., 2) of the rays that meet the image plane at `points` (..., 2); NaN where
        none does."""
        points = np.asarray(points, dtype=np.float64)
        slopes = self._undistort_radially(points)
        if any(self.tangential):
            for _ in range(_STEPS):
                off = self.project(slopes) - self._scale(_lengths(slopes))[..., None] * slopes
                slopes = self._undistort_radially(points - off)
        return slopes

    def _scale(self, r: "NDArray[np.float64]") -> "NDArray[np.float64]":
        """g(r), the radial part of the image over r."""
        k = _padded(self.radial, MODELS[self.model])
        if self.model == "fisheye":
            angle = np.arctan(r)
            share = np.divide(angle, r, out=np.ones_like(r), where=r > 0)
            return share * Polynomial([1.0, *k])(angle * angle)
        return Polynomial([1.0, *k[:3]])(r * r) / Polynomial([1.0, *k[3:]])(r * r)

    def _undistort_radially(self, points: "NDArray[np.float64]") -> "NDArray[np.float64]":
        wanted = _lengths(points)
        low, high = np.zeros_like(wanted), np.full_like(wanted, self.limit)
        beyond = ~(wanted < self.limit * self._scale(high))
        for _ in range(_STEPS):
            middle = 0.5 * (low + high)
            short = middle * self._scale(middle) < wanted
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        share = np.divide(0.5 * (low + high), wanted, out=np.ones_like(wanted), where=wanted > 0)
        return np.where(beyond, np.nan, share)[..., None] * points


class NativeLens(NamedTuple):
    """A lens before an image, as the renderer takes it."""

    distortion: int
    lens: "NDArray[np.float64]"  # (13,): radial (6), tangential (2), limit^2, least, most slopes


PINHOLE = NativeLens(0, np.zeros(13))


def native_lens(distortion: Distortion | None, K: "NDArray", width: int, height: int) -> NativeLens:
    """The lens of a camera with the intrinsics K (3, 3) [px] for `_native.render_baked`."""
    if distortion is None:
        return PINHOLE
    return _native_lens(*_key(distortion, K), width, height)


def pixel_slopes(
    distortion: Distortion, K: "NDArray", width: int, height: int
) -> "NDArray[np.float64]":
    """Slopes (height, width, 2) in which the pixels of a camera look; NaN where a lens shows
    nothing. Kept, for the next image."""
    return _pixel_slopes(*_key(distortion, K), width, height)


def hidden_pixels(
    distortion: Distortion, K: "NDArray", width: int, height: int
) -> "NDArray[np.intp]":
    """Which pixels, counted row by row, a lens shows nothing in. Kept, as `pixel_slopes`."""
    return _hidden_pixels(*_key(distortion, K), width, height)


def opencv_limit(radial: Sequence[float]) -> float:
    """Least r at which ``r g(r)`` of k1, ..., k6 stops growing or g has a pole; may be inf."""
    top, bottom = Polynomial([1, *radial[:3]]), Polynomial([1, *radial[3:]])  # of r^2
    s = Polynomial([0, 1])
    growth = top * bottom + 2 * s * (top.deriv() * bottom - top * bottom.deriv())
    return math.sqrt(min(_first_root(growth), _first_root(bottom)))


def fisheye_limit(radial: Sequence[float]) -> float:
    """Least angle [rad] at which the image radius of k1, ..., k4 stops growing; may be inf."""
    factors = zip((3, 5, 7, 9), radial, strict=True)
    return math.sqrt(_first_root(Polynomial([1, *(n * k for n, k in factors)])))


type _Key = tuple[str, tuple[float, ...], tuple[float, ...], float, tuple[float, ...]]


def _key(distortion: Distortion, K: "NDArray") -> _Key:
    lens = distortion
    focal = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    return lens.model, tuple(lens.radial), tuple(lens.tangential), lens.max_angle, focal


def _restored(model: str, radial: tuple, tangential: tuple, max_angle: float) -> Distortion:
    return Distortion(model, list(radial), list(tangential), max_angle)


@lru_cache(maxsize=512)  # each band of a rolling shutter has one
def _native_lens(model, radial, tangential, max_angle, focal, width, height) -> NativeLens:
    distortion = _restored(model, radial, tangential, max_angle)
    limit = distortion.limit
    size = np.array([width, height])
    along = np.linspace(-_MARGIN, 1.0 + _MARGIN, 257)
    edges = [(along, np.full(257, end)) for end in (-_MARGIN, 1.0 + _MARGIN)]
    border = np.concatenate([np.stack(pair, -1) for a, b in edges for pair in ((a, b), (b, a))])
    fx, fy, cx, cy = focal
    points = (border * size - [cx, cy]) / [fx, fy]
    slopes = distortion.slopes(points)
    # Where the border lies beyond what the lens shows, that ends it.
    outward = limit * points / np.maximum(_lengths(points), 1e-12)[:, None]
    slopes = np.where(np.isnan(slopes), outward, slopes)
    numbers = [
        *_padded(distortion.radial, 6),
        *_padded(distortion.tangential, 2),
        min(limit**2, 1e12),
        *slopes.min(axis=0),
        *slopes.max(axis=0),
    ]
    return NativeLens(1 + list(MODELS).index(model), np.array(numbers))


@lru_cache(maxsize=8)
def _pixel_slopes(model, radial, tangential, max_angle, focal, width, height):
    fx, fy, cx, cy = focal
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    points = np.stack([(u - cx) / fx, (v - cy) / fy], -1)
    slopes = _restored(model, radial, tangential, max_angle).slopes(points)
    slopes.setflags(write=False)
    return slopes


@lru_cache(maxsize=8)
def _hidden_pixels(model, radial, tangential, max_angle, focal, width, height):
    slopes = _pixel_slopes(model, radial, tangential, max_angle, focal, width, height)
    return np.flatnonzero(np.isnan(slopes[..., 0]))


def _padded(numbers: Sequence[float], count: int) -> list[float]:
    return [*numbers, *[0.0] * (count - len(numbers))]


def _lengths(points: "NDArray[np.float64]") -> "NDArray[np.float64]":
    return np.hypot(points[..., 0], points[..., 1])


def _first_root(polynomial: Polynomial) -> float:
    """Least positive real root; inf without one."""
    roots = polynomial.trim().roots()
    positive = roots.real[(roots.imag == 0) & (roots.real > 0)]
    return float(np.min(positive, initial=math.inf))
