"""A capture: what a camera saw of a place, from known poses."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.common import files as environment
from splatpilot.systems.common.files import remove_leftovers
from splatpilot.training.captures.capture_config import CaptureConfig

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


# [m], stands for "beyond range" while points are moved; far enough that no baseline matters.
_FAR = 1e9


def register_depth(
    depth: NDArray[np.floating],
    K_D: NDArray[np.float64],
    X_CD: RigidTransform,
    K_C: NDArray[np.float64],
    width: int,
    height: int,
) -> NDArray[np.float32]:
    """Carries a depth image into the pixels of another camera.

    Each pixel of D becomes a point, or several where C resolves more finely; each pixel of C takes
    the nearest point that falls into it.

    Args:
        depth: (h, w) [m] along the optical axis of D; 0 unknown, inf beyond range.
        K_D: (3, 3) [px], intrinsics of D.
        X_CD: pose of D in C.
        K_C: (3, 3) [px], intrinsics of C.
        width, height: [px], of C's image.

    Returns:
        (height, width) [m] along the optical axis of C; 0 unknown, inf beyond range.
    """
    # At least one point a pixel of C, so that surfaces behind do not shine through.
    finer = max(1, int(np.ceil(1.05 * K_C[0, 0] / K_D[0, 0])))
    z = np.where(np.isinf(depth), _FAR, depth).repeat(finer, axis=0).repeat(finer, axis=1)
    rows, columns = np.nonzero(z > 0)
    z = z[rows, columns].astype(np.float64)
    p_DQ = back_project(K_D, (columns + 0.5) / finer, (rows + 0.5) / finer, z)
    x, y, z = X_CD.multiply(p_DQ.T)
    front = z > 0
    x, y, z = x[front], y[front], z[front]
    u = np.floor(K_C[0, 0] * x / z + K_C[0, 2])
    v = np.floor(K_C[1, 1] * y / z + K_C[1, 2])
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = v[inside].astype(np.intp) * width + u[inside].astype(np.intp)
    nearest = np.full(height * width, np.inf)
    np.minimum.at(nearest, index, z[inside])
    hit = np.zeros(height * width, dtype=bool)
    hit[index] = True
    nearest[nearest > _FAR / 2] = np.inf
    return np.where(hit, nearest, 0).astype(np.float32).reshape(height, width)


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """One photograph with its depth.

    The centre of the pixel in column i and row j has the image coordinates (i + 0.5, j + 0.5).
    """

    image: NDArray[np.uint8]  # (H, W, 3) red, green, blue
    depth: NDArray[np.float32]  # (H, W) [m], along the optical axis; 0 unknown, inf beyond range
    X_WC: RigidTransform  # pose of the camera (x right, y down, z forward) in the world
    K: NDArray[np.float64]  # (3, 3) [px], pinhole intrinsics
    valid: NDArray[np.bool_] = field(default_factory=lambda: _EVERYWHERE)
    """(H, W), the pixels that are used: no other has depth, is fitted or is measured."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "valid", np.broadcast_to(self.valid, self.depth.shape))

    def back_project(self, columns: NDArray, rows: NDArray, depth: NDArray) -> NDArray[np.floating]:
        """Returns the points p_CQ, (..., 3) [m], at image coordinates [px] and depths [m]."""
        return back_project(self.K, columns, rows, depth)


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """A camera that measures depth, beside the one that takes colour."""

    K: NDArray[np.float64]  # (3, 3) [px]
    width: int  # [px]
    height: int  # [px]
    X_CD: RigidTransform  # pose of the depth camera D in the colour camera C


@dataclass(frozen=True, eq=False)
class SfmPoints:
    """Coloured points of the place, from structure from motion or a scan."""

    p_WQ: NDArray[np.float64]  # (N, 3) [m]
    colors: NDArray[np.float64]  # (N, 3) red, green, blue, 0 to 1


@dataclass(frozen=True, eq=False)
class FileAxes:
    """The axes in which the files of a capture gave their poses, before they were read as X_WC.

    With the pose X_FB of a body B in a world F as the files have it, X_WC = R_WF X_FB R_BC.
    """

    name: str
    """What they are called in messages."""
    R_WF: RotationMatrix
    R_BC: RotationMatrix


OPTICAL_AXES = FileAxes("optical: x right, y down, z forward", RotationMatrix(), RotationMatrix())
OPENGL_AXES = FileAxes(
    "OpenGL: x right, y up, z back", RotationMatrix(), RotationMatrix(np.diag([1.0, -1.0, -1.0]))
)


_EVERYWHERE = np.ones((1, 1), dtype=bool)


def no_depth(i: int) -> None:
    """The `Capture.load_depth` of a capture without depth."""


def all_valid(i: int) -> NDArray[np.bool_]:
    """The `Capture.load_valid` of a capture whose pixels are all used."""
    return _EVERYWHERE


@dataclass(frozen=True, eq=False)
class Capture:
    """A sequence of posed images, with depth if there is any, loaded frame by frame when asked for.

    Cameras are pinholes: loaders undistort. World W has z up and, unless `metric` is false, is in
    metres.
    """

    name: str
    source: str
    """Where it was read from, for the record."""
    K: NDArray[np.float64]  # (3, 3) [px], of the colour camera
    width: int  # [px]
    height: int  # [px]
    X_WCs: Sequence[RigidTransform]
    load_image: Callable[[int], NDArray[np.uint8]]
    """Returns the image of frame i, (height, width, 3), or raises an error that names the file."""
    load_depth: Callable[[int], NDArray[np.float32] | None] = no_depth
    """Returns the depth of frame i [m] in the pixels of the camera that measured it, None if that
    frame has none, or raises an error that names the file. 0 is unknown, inf is beyond range."""
    load_valid: Callable[[int], NDArray[np.bool_]] = all_valid
    """Returns the pixels of the image of frame i that are used, (height, width) or (1, 1)."""
    depth_camera: DepthCamera | None = None
    """The camera that measured depth; None if depth has the pixels of the images."""
    points: SfmPoints | None = None
    """Points known of the place, if any."""
    metric: bool = True
    """Whether lengths are metres; if not, their unit is unknown and nothing can fly there."""
    frame_names: Sequence[str] = ()
    """Path of each image as the files give it; empty if only numbers are known."""
    dropped: Sequence[str] = ()
    """Why frames were left out, one message each that names the file."""
    held_out: Sequence[int] | None = None
    """The frames that the files hold out from training; None if they do not say."""
    notes: Sequence[str] = ()
    """What was assumed or not used when the files were read, one sentence each."""
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """(3,) [m], position of W's origin in the world of the files, upright and in metres."""
    axes: FileAxes | None = None
    """The axes of the files, for those who doubt that they were read rightly."""
    folder: str = ""
    """The absolute path from which `read_capture` opens it again, with `config`; empty if it does
    not come from there as it is."""
    config: CaptureConfig = field(default_factory=CaptureConfig)
    """What was said when it was read of what its files leave open."""

    def __len__(self) -> int:
        return len(self.X_WCs)

    @property
    def has_depth(self) -> bool:
        """Whether any frame has depth."""
        return self.load_depth is not no_depth

    def measured_depth(self, i: int) -> NDArray[np.float32] | None:
        """Returns what `load_depth` does; 0 in invalid pixels if it has the pixels of the images.

        Raises:
            OSError, ValueError: if its file cannot be read or is of another size.
        """
        depth = self.load_depth(i)
        if depth is None or self.depth_camera is not None:
            return depth
        return np.where(self.load_valid(i), depth, np.float32(0))

    def registered_depth(self, i: int) -> NDArray[np.float32]:
        """Returns the depth (height, width) [m] of frame i in the pixels of its image.

        0 where it is unknown or the pixel is invalid, everywhere if the frame has none.

        Raises:
            OSError, ValueError: if its file cannot be read or is of another size.
        """
        depth, camera = self.measured_depth(i), self.depth_camera
        if depth is None:
            return np.zeros((self.height, self.width), np.float32)
        if camera is None:
            return depth
        depth = register_depth(depth, camera.K, camera.X_CD, self.K, self.width, self.height)
        return np.where(self.load_valid(i), depth, np.float32(0))

    def frame(self, i: int) -> CaptureFrame:
        """Loads frame i, 0 <= i < len(self), with its registered depth.

        Raises:
            IndexError: if there is no such frame.
            OSError, ValueError: if its files cannot be read or are of another size.
        """
        if not 0 <= i < len(self):
            raise IndexError(f"frame {i} of {self.name}: it has the frames 0 to {len(self) - 1}")
        return CaptureFrame(
            self.load_image(i), self.registered_depth(i), self.X_WCs[i], self.K, self.load_valid(i)
        )

    def frames(self) -> Iterator[CaptureFrame]:
        """Loads one frame after the other."""
        return (self.frame(i) for i in range(len(self)))


# Depths within a pixel that differ by more than this fraction belong to different surfaces.
_ONE_SURFACE = 0.1


def shrink_factor(width: int, wanted: int) -> int:
    """Returns by which whole factor to shrink images of `width` [px] to about `wanted`, 0: 1."""
    return max(1, round(width / wanted)) if wanted else 1


def shrink_mask(valid: NDArray[np.bool_], factor: int) -> NDArray[np.bool_]:
    """Returns which pixels of a shrunken image replace valid ones alone."""
    return _blocks(valid, factor).all(axis=-1)


def _blocks(pixels: NDArray, factor: int) -> NDArray:
    """(h, w, factor^2) from (H, W): what each shrunken pixel replaces."""
    height, width = (n // factor for n in pixels.shape)
    blocks = pixels[: height * factor, : width * factor].reshape(height, factor, width, factor)
    return blocks.swapaxes(1, 2).reshape(height, width, factor**2)


def shrink(frame: CaptureFrame, factor: int) -> CaptureFrame:
    """Returns the frame with each factor x factor pixels made one; what remains at the right and at
    the bottom is cut off.

    Colours are averaged. Depth is averaged as its inverse, which is exact on planes, where it is of
    one surface; at the edges of things it is the (lower) median, a depth that was seen. It is
    unknown (0) where most of it is, and infinite where it is beyond range. A pixel is valid if all
    that it replaces are.
    """
    if factor == 1:
        return frame
    height, width = (n // factor for n in frame.depth.shape)
    image = frame.image[: height * factor, : width * factor]
    image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)

    blocks, valid = _blocks(frame.depth, factor), shrink_mask(frame.valid, factor)
    known = blocks > 0
    count = known.sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(known, 1 / blocks, 0)
        most = inverse.max(axis=-1)
        spread = most - np.where(known, inverse, np.inf).min(axis=-1)
        mean = count / inverse.sum(axis=-1)
        # Sorted, the unknown ones come last.
        ordered = np.sort(np.where(known, blocks, np.nan), axis=-1)
        middle = np.maximum(count - 1, 0)[..., None] // 2
        median = np.take_along_axis(ordered, middle, axis=-1)[..., 0]
        depth = np.where(spread <= _ONE_SURFACE * most, mean, median)
    depth = np.where((2 * count > factor**2) & valid, depth, 0).astype(np.float32)
    K = frame.K.copy()
    K[:2] /= factor
    return CaptureFrame(np.asarray(image, dtype=np.uint8), depth, frame.X_WC, K, valid)


def cache_folder(config: CaptureConfig, *parts: str) -> Path:
    """The folder that a capture keeps what is made of it in: what it names, or in the user's."""
    if config.cache:
        return Path(config.cache)
    return environment.cache_folder(*parts)


def cache_key(files: Iterable[Path], *others: object) -> str:
    """A name for what is made of files, by their paths, sizes and times, and of what else decides
    it."""
    key = hashlib.sha256(repr(others).encode())
    for file in files:
        status = file.stat()
        key.update(f"{file.resolve()} {status.st_size} {status.st_mtime_ns}".encode())
    return key.hexdigest()[:16]


def prepare_cache(folder: Path) -> None:
    """Makes a folder to keep things in, and removes what was left half written there.

    Raises:
        OSError: if it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(
            f"{folder}: cannot be written ({error.strerror}); set capture.cache to a folder that "
            "can"
        ) from None
    remove_leftovers(folder)
