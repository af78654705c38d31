"""Lenses: how a camera bends rays, and the pinhole camera its images are made into."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

_LARGEST = 1 << 16  # [px]
_LONGEST = 1e6  # [px]


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera with its distortion.

    Image coordinates are those of `CaptureFrame`: the first pixel's centre is (0.5, 0.5).
    """

    K: NDArray[np.float64]  # (3, 3) [px], of the camera without its distortion
    width: int  # [px]
    height: int  # [px]
    project: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Takes rays (N, 2), x/z and y/z, to image coordinates (N, 2) [px]; None for a pinhole."""
    radius: float = np.inf
    """[px], distance from the center of the image within which it is used."""
    source: str = "the files"
    """Where the intrinsics come from, for the record."""

    def __post_init__(self) -> None:
        """Raises ValueError for what is no camera."""
        focal, center = np.diag(self.K)[:2], self.K[:2, 2]
        size = np.array([self.width, self.height])
        if not (size >= 1).all() or not (size <= _LARGEST).all():
            raise ValueError(
                f"images of {self.width}x{self.height} pixels; 1 to {_LARGEST} are needed"
            )
        if not ((focal > 0) & (focal <= _LONGEST)).all():
            raise ValueError(
                f"focal lengths of {focal.tolist()} px; more than 0 and at most {_LONGEST:g} px "
                "are needed"
            )
        if not ((center > 0) & (center < size)).all():
            raise ValueError(
                f"the principal point must be in the image of {self.width}x{self.height} px, got "
                f"{center.tolist()} px; intrinsics may be those of images of another size: set "
                "capture.intrinsics"
            )

    def __str__(self) -> str:
        fx, fy, cx, cy = np.round([*np.diag(self.K)[:2], *self.K[:2, 2]], 2).tolist()
        size = f"{self.width}x{self.height}"
        return f"fx {fx}, fy {fy}, cx {cx}, cy {cy} px for {size} px, from {self.source}"

    @property
    def is_eccentric(self) -> bool:
        """Whether the principal point is farther from the center than a quarter of the image."""
        size = np.array([self.width, self.height])
        return bool((np.abs(self.K[:2, 2] - size / 2) > size / 4).any())

    def pixels(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the image coordinates (N, 2) [px] of rays (N, 2), x/z and y/z."""
        if self.project is None:
            return rays @ self.K[:2, :2].T + self.K[:2, 2]
        return self.project(rays)

    def scale_to(self, width: int, height: int) -> "Lens":
        """Returns the lens of the same camera's images at another resolution."""
        a = np.array([width / self.width, height / self.height])
        project = self.project
        return replace(
            self,
            K=np.diag([*a, 1.0]) @ self.K,
            width=width,
            height=height,
            project=None if project is None else lambda rays: project(rays) * a,
            radius=self.radius * float(a.mean()),
        )


def pinhole(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    """Returns the intrinsics (3, 3) [px]."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def back_project(
    K: NDArray[np.float64], u: NDArray, v: NDArray, depth: NDArray
) -> NDArray[np.float64]:
    """Returns the points p_CQ (..., 3) that a pinhole camera sees.

    Args:
        K: (3, 3) [px].
        u, v: (...) [px], image coordinates.
        depth: (...) [m], along the optical axis.
    """
    x = (u - K[0, 2]) / K[0, 0] * depth
    y = (v - K[1, 2]) / K[1, 1] * depth
    return np.stack([x, y, depth], axis=-1)


def opencv_lens(
    K: NDArray[np.float64], width: int, height: int, distortion: Sequence[float]
) -> Lens:
    """Returns a lens of OpenCV's model: k1, k2, p1, p2, k3, ... as `cv2.projectPoints` takes."""
    if not np.any(distortion):
        return Lens(K, width, height)
    coefficients = np.array(distortion, dtype=np.float64)

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        points = np.column_stack([rays, np.ones(len(rays))])
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, coefficients)[0]
        return np.asarray(pixels, dtype=np.float64)[:, 0]

    return Lens(K, width, height, project)


def polynomial_lens(
    K: NDArray[np.float64],
    width: int,
    height: int,
    radial: Sequence[float],
    tangential: Sequence[float],
) -> Lens:
    """Returns a lens of OpenCV's model with radial terms of any number: k1, k2, k3, k4, ... of the
    powers r^2, r^4, r^6, r^8, ..., which OpenCV ends at r^6, and p1, p2."""
    k, (p1, p2) = np.array(radial), tangential

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y = rays.T
        r2 = x**2 + y**2
        stretch = 1 + r2[:, None] ** np.arange(1, len(k) + 1) @ k
        bent = [
            x * stretch + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * stretch + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        ]
        return np.column_stack(bent) @ K[:2, :2].T + K[:2, 2]

    curved = np.any(radial) or np.any(tangential)
    return Lens(K, width, height, project if curved else None)


def fisheye_lens(
    K: NDArray[np.float64], width: int, height: int, distortion: Sequence[float]
) -> Lens:
    """Returns a lens of OpenCV's fisheye model (Kannala and Brandt 2006) with k1 to k4."""
    k = np.array(distortion, dtype=np.float64)

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        r = np.linalg.norm(rays, axis=1, keepdims=True)
        theta = np.arctan(r)
        bent = theta * (1 + theta ** (2 * np.arange(1, 5)) @ k[:, None])
        rays = rays * np.divide(bent, r, out=np.ones_like(r), where=r > 0)
        return rays @ K[:2, :2].T + K[:2, 2]

    return Lens(K, width, height, project)


def common_pinhole(lenses: Sequence[Lens]) -> Lens:
    """Returns the pinhole camera that images of all `lenses` are resampled into.

    It has the size and centre of the first, and the shortest focal length, not below the first's,
    at which every one of its pixels is seen through every lens.
    """
    first = lenses[0]
    edge = _border(first.width, first.height)

    def covers(zoom: float) -> bool:
        rays = (edge - first.K[:2, 2]) / (zoom * np.diag(first.K)[:2])
        for lens in lenses:
            pixels = lens.pixels(rays)
            size = np.array([lens.width, lens.height])
            # Half a pixel outside the first centres is still within the image.
            if not ((pixels > -0.5) & (pixels < size + 0.5)).all():
                return False
            if not (np.linalg.norm(pixels - size / 2, axis=1) <= lens.radius).all():
                return False
        return True

    low, high = 1.0, 1.0
    while not covers(high):
        low, high = high, 1.25 * high
        if high > 4:
            raise ValueError(
                "the cameras of this capture have too little of their view in common: no pinhole "
                "camera sees through all of them; give the frames of one camera alone"
            )
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (low, middle) if covers(middle) else (middle, high)
    K = first.K.copy()
    K[:2, :2] *= high
    return Lens(K, first.width, first.height)


def resampling_maps(lens: Lens, target: Lens) -> tuple[NDArray, NDArray] | None:
    """Returns the maps for `cv2.remap` from images of `lens` to those of the pinhole `target`.

    None if they are the same camera.
    """
    if lens.project is None and np.array_equal(lens.K, target.K):
        return None
    v, u = np.mgrid[0 : target.height, 0 : target.width] + 0.5
    rays = np.stack([u.ravel(), v.ravel()], axis=-1)
    rays = (rays - target.K[:2, 2]) / np.diag(target.K)[:2]
    # cv2.remap counts from the first pixel's centre.
    pixels = (lens.pixels(rays) - 0.5).astype(np.float32).reshape(target.height, target.width, 2)
    return pixels[..., 0], pixels[..., 1]


def _border(width: int, height: int) -> NDArray[np.float64]:
    """Returns image coordinates (N, 2) along the edge of an image."""
    u, v = np.linspace(0, width, 33), np.linspace(0, height, 33)
    return np.concatenate(
        [
            np.column_stack([u, np.zeros(33)]),
            np.column_stack([u, np.full(33, height)]),
            np.column_stack([np.zeros(33), v]),
            np.column_stack([np.full(33, width), v]),
        ]
    )
