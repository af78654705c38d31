"""A capture: posed images of a scene, with the cameras that took them."""

import hashlib
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.lens import Distortion, pixel_slopes
from splatpilot.training.captures.capture_config import CaptureConfig

_MAX_SIZE = 1 << 16  # [px]
_MAX_FOCAL = 1e6  # [px]
_MAX_ZOOM = 4.0
_FAR = 1e9  # [m], depth beyond range while points are moved: no baseline matters there
_ONE_SURFACE = 0.1
"""Relative difference of inverse depths in a pixel above which they are of different surfaces."""


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera with its distortion. Image coordinates are those of `CaptureFrame`: the first
    pixel's center is (0.5, 0.5)."""

    K: NDArray[np.float64]  # (3, 3) [px], of the camera without its distortion
    width: int  # [px]
    height: int  # [px]
    project: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Takes rays (N, 2), x/z and y/z, to image coordinates (N, 2) [px], NaN where the lens folds
    them; None for a pinhole."""
    radius: float = np.inf  # [px], distance from the image's center within which it is used
    source: str = "the files"  # of the intrinsics, for messages

    def __post_init__(self) -> None:
        focal, center = np.diag(self.K)[:2], self.K[:2, 2]
        size = np.array([self.width, self.height])
        shape = f"{self.width}x{self.height}"
        remedy = "intrinsics may be those of images of another size: set capture.intrinsics"
        inside, valid = (size >= 1) & (size <= _MAX_SIZE), (focal > 0) & (focal <= _MAX_FOCAL)
        centered = (center > 0) & (center < size)
        require(inside.all(), "the image size", f"in [1, {_MAX_SIZE}] px", shape)
        require(valid.all(), "focal lengths", f"in (0, {_MAX_FOCAL:g}] px", focal.tolist())
        condition = f"in the image of {shape} px"
        require(centered.all(), "the principal point", condition, f"{center.tolist()} px", remedy)

    def __str__(self) -> str:
        fx, fy, cx, cy = np.round([*np.diag(self.K)[:2], *self.K[:2, 2]], 2).tolist()
        size = f"{self.width}x{self.height}"
        return f"fx {fx}, fy {fy}, cx {cx}, cy {cy} px for {size} px, from {self.source}"

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


def centered_pinhole(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    """Returns the intrinsics (3, 3) [px] if cx and cy count from the first pixel's center."""
    return pinhole(fx, fy, cx + 0.5, cy + 0.5)


def opencv_lens(
    K: NDArray[np.float64], width: int, height: int, distortion: Sequence[float], k4: float = 0.0
) -> Lens:
    """Returns a lens of OpenCV's rational model with k1, k2, p1, p2, k3, ... in OpenCV's order, and
    `k4`, the radial term of r^8."""
    if not np.any(distortion) and not k4:
        return Lens(K, width, height)
    radial = [*distortion[:2], *distortion[4:]]
    return _bent_lens(K, width, height, Distortion("opencv", radial, [*distortion[2:4]]), k4)


def fisheye_lens(
    K: NDArray[np.float64], width: int, height: int, distortion: Sequence[float]
) -> Lens:
    """Returns a lens of OpenCV's fisheye model (Kannala and Brandt 2006) with k1 to k4."""
    return _bent_lens(K, width, height, Distortion("fisheye", [*distortion]))


def _bent_lens(
    K: NDArray[np.float64], width: int, height: int, bend: Distortion, k4: float = 0.0
) -> Lens:
    bend.validate()

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        bent = bend.project(rays)
        if k4:
            bent += k4 * (rays**2).sum(axis=1, keepdims=True) ** 4 * rays
        return bent * np.diag(K)[:2] + K[:2, 2]

    return Lens(K, width, height, project)


def common_pinhole(lenses: Sequence[Lens]) -> Lens:
    """Returns the pinhole camera that images of all `lenses` are resampled into: of the first's
    size and center and the shortest focal length, not below its, that every lens covers."""
    first = lenses[0]
    s, zero, one = np.linspace(0, 1, 33), np.zeros(33), np.ones(33)
    sides = np.stack([[s, zero], [s, one], [zero, s], [one, s]])  # (4, 2, 33)
    edge = sides.transpose(0, 2, 1).reshape(-1, 2) * [first.width, first.height]

    def covers(zoom: float) -> bool:
        rays = (edge - first.K[:2, 2]) / (zoom * np.diag(first.K)[:2])
        for lens in lenses:
            pixels, size = lens.pixels(rays), np.array([lens.width, lens.height])
            # Half a pixel outside the first centers is still within the image.
            inside = ((pixels > -0.5) & (pixels < size + 0.5)).all(axis=1)
            if not (inside & (np.linalg.norm(pixels - size / 2, axis=1) <= lens.radius)).all():
                return False
        return True

    zooms = np.geomspace(1, _MAX_ZOOM, 1400)
    index = bisect_left(zooms, True, key=covers)
    if index == len(zooms):
        raise ValueError(
            "no pinhole camera sees through all cameras of this capture, which share too little of "
            "their view; give the frames of one camera alone"
        )
    K = first.K.copy()
    K[:2, :2] *= zooms[index]
    return Lens(K, first.width, first.height)


def resampling_maps(lens: Lens, target: Lens) -> tuple[NDArray, NDArray] | None:
    """Returns the maps for `cv2.remap` from images of `lens` to `target`, None if equal."""
    if lens.project is None and np.array_equal(lens.K, target.K):
        return None
    rays = pixel_rays(target.K, target.width, target.height)[..., :2].reshape(-1, 2)
    # cv2.remap counts from the first pixel's center.
    pixels = (lens.pixels(rays) - 0.5).astype(np.float32).reshape(target.height, target.width, 2)
    return pixels[..., 0], pixels[..., 1]


def back_project(
    K: NDArray[np.float64], u: NDArray, v: NDArray, depth: NDArray
) -> NDArray[np.float64]:
    """Returns the points p_CQ (..., 3) [m] that a pinhole camera K (3, 3) [px] sees at image
    coordinates u, v (...) [px] and depths (...) [m] along the optical axis."""
    x = (u - K[0, 2]) / K[0, 0] * depth
    y = (v - K[1, 2]) / K[1, 1] * depth
    return np.stack([x, y, depth], axis=-1)


def pixel_rays(K: NDArray[np.float64], width: int, height: int) -> NDArray[np.float64]:
    """Returns the rays (H, W, 3) of all pixels, with depth 1."""
    v, u = np.mgrid[:height, :width] + 0.5
    return back_project(K, u, v, np.ones_like(u))


def depth_points(
    K: NDArray[np.float64], depth: NDArray, step: int = 1, start: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.intp]]:
    """Returns the points p_CQ (N, 3) [m] of pixels of known, finite depth (H, W) [m], and their
    rows and columns, which begin at `start`."""
    part = depth[start::step, start::step]
    rows, columns = start + step * np.argwhere((part > 0) & np.isfinite(part)).T
    z = depth[rows, columns].astype(np.float64)
    return back_project(K, columns + 0.5, rows + 0.5, z), rows, columns


def project(
    K: NDArray[np.float64], x: NDArray, y: NDArray, z: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the image coordinates u, v (...) [px] of points p_CQ."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]


def project_points(
    K: NDArray[np.float64], p_CQ: NDArray[np.float64], width: int, height: int
) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:
    """Returns which points (N, 3) fall into an image, and rows and columns (n,) of their pixels."""
    (u, v), z = project(K, *p_CQ.T), p_CQ[:, 2]
    inside = (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return inside, v[inside].astype(np.intp), u[inside].astype(np.intp)


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """A depth camera apart from the color camera."""

    K: NDArray[np.float64]  # (3, 3) [px]
    width: int  # [px]
    height: int  # [px]
    X_CD: RigidTransform  # pose of the depth camera D in the color camera C


def register_depth(
    depth: NDArray[np.floating],
    camera: DepthCamera,
    K: NDArray[np.float64],
    width: int,
    height: int,
) -> NDArray[np.float32]:
    """Returns the nearest depth [m] in each pixel of the color camera; 0 unknown, inf too far."""
    # At least one point per pixel of C, so that surfaces behind do not shine through.
    finer = max(1, int(np.ceil(1.05 * K[0, 0] / camera.K[0, 0])))
    z = np.where(np.isinf(depth), _FAR, depth).repeat(finer, axis=0).repeat(finer, axis=1)
    p_DQ, _, _ = depth_points(np.diag([finer, finer, 1]) @ camera.K, z)
    p_CQ = camera.X_CD.multiply(p_DQ.T).T
    inside, rows, columns = project_points(K, p_CQ, width, height)
    nearest = np.full((height, width), np.inf)
    np.minimum.at(nearest, (rows, columns), p_CQ[inside, 2])
    nearest[np.isinf(nearest)] = 0
    nearest[nearest > _FAR / 2] = np.inf
    return nearest.astype(np.float32)


_EVERYWHERE = np.ones((1, 1), dtype=bool)


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """One photograph with its depth. The center of the pixel in column i and row j has the image
    coordinates (i + 0.5, j + 0.5)."""

    image: NDArray[np.uint8]  # (H, W, 3) red, green, blue
    depth: NDArray[np.float32]  # (H, W) [m], along the optical axis; 0 unknown, inf beyond range
    X_WC: RigidTransform  # pose of the camera (x right, y down, z forward) in the world
    K: NDArray[np.float64]  # (3, 3) [px], pinhole intrinsics
    valid: NDArray[np.bool_] = field(default_factory=lambda: _EVERYWHERE)
    """(H, W), the pixels that are used; no other has depth."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "valid", np.broadcast_to(self.valid, self.depth.shape))

    @property
    def slopes(self) -> NDArray[np.float64]:
        """The slopes (H, W, 2) of the pixels, see `pixel_slopes`."""
        return pixel_slopes(None, self.K, *self.depth.shape[::-1])


@dataclass(frozen=True, eq=False)
class SfmPoints:
    """Colored points of the scene, from structure from motion or a scan."""

    p_WQ: NDArray[np.float64]  # (N, 3) [m]
    colors: NDArray[np.float64]  # (N, 3) red, green, blue, 0 to 1


@dataclass(frozen=True, eq=False)
class FileAxes:
    """The axes in which the files of a capture give their poses. With the pose X_FB of a body B in
    a world F as the files have it, X_WC = R_WF X_FB R_BC."""

    name: str
    R_WF: RotationMatrix
    R_BC: RotationMatrix


OPTICAL_AXES = FileAxes("optical: x right, y down, z forward", RotationMatrix(), RotationMatrix())
OPENGL_AXES = FileAxes(
    "OpenGL: x right, y up, z back", RotationMatrix(), RotationMatrix(np.diag([1.0, -1.0, -1.0]))
)


def no_depth(i: int) -> None:
    """The `Capture.load_depth` of a capture without depth."""


def all_valid(i: int) -> NDArray[np.bool_]:
    """The `Capture.load_valid` of a capture whose pixels are all used."""
    return _EVERYWHERE


@dataclass(frozen=True, eq=False)
class Capture:
    """A sequence of posed images, with depth if there is any, loaded frame by frame on demand.
    Cameras are pinholes: readers undistort. World W has z up and, if `metric`, is in meters."""

    name: str
    source: str  # format and path, for messages
    K: NDArray[np.float64]  # (3, 3) [px], of the color camera
    width: int  # [px]
    height: int  # [px]
    X_WCs: Sequence[RigidTransform]
    load_image: Callable[[int], NDArray[np.uint8]]
    """Returns the image of frame i, (height, width, 3), or raises an error that names the file."""
    load_depth: Callable[[int], NDArray[np.float32] | None] = no_depth
    """Returns the depth of frame i [m] in the pixels of the camera that measured it, None if the
    frame has none, or raises an error that names the file. 0 is unknown, inf is beyond range."""
    load_valid: Callable[[int], NDArray[np.bool_]] = all_valid
    """Returns the pixels of the image of frame i that are used, (height, width) or (1, 1)."""
    depth_camera: DepthCamera | None = None  # None if depth has the pixels of the images
    points: SfmPoints | None = None
    metric: bool = True  # if lengths are in meters; otherwise nothing can fly in the scene
    frame_names: Sequence[str] = ()  # path of each image as the files give it; empty if unknown
    dropped: Sequence[str] = ()  # reasons why frames were left out, each names its file
    held_out: Sequence[int] | None = None
    """The frames that the files hold out from training; None if they do not say."""
    notes: Sequence[str] = ()  # assumptions of the reader and what it ignored
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """(3,) [m], position of W's origin in the world of the files, upright and in meters."""
    axes: FileAxes = OPTICAL_AXES
    folder: str = ""  # absolute path from which `read_capture` opens it again, if any
    config: CaptureConfig = field(default_factory=CaptureConfig)  # that it was read with

    def __len__(self) -> int:
        return len(self.X_WCs)

    def camera_digest(self) -> str:
        """Returns a digest of the cameras and their poses."""
        parts = [self.K, *(X_WC.GetAsMatrix34() for X_WC in self.X_WCs)]
        if self.depth_camera is not None:
            parts += [self.depth_camera.K, self.depth_camera.X_CD.GetAsMatrix34()]
        return hashlib.sha256(b"".join(each.tobytes() for each in parts)).hexdigest()

    @property
    def has_depth(self) -> bool:
        """True if any frame has depth."""
        return self.load_depth is not no_depth

    def measured_depth(self, i: int) -> NDArray[np.float32] | None:
        """Returns `load_depth(i)`, 0 in invalid pixels if it has the pixels of the images."""
        depth = self.load_depth(i)
        if depth is None or self.depth_camera is not None:
            return depth
        return np.where(self.load_valid(i), depth, np.float32(0))

    def registered_depth(self, i: int) -> NDArray[np.float32]:
        """Returns the depth (height, width) [m] of the pixels of image i; 0 if invalid, unknown."""
        depth, camera = self.measured_depth(i), self.depth_camera
        if depth is None:
            return np.zeros((self.height, self.width), np.float32)
        if camera is None:
            return depth
        depth = register_depth(depth, camera, self.K, self.width, self.height)
        return np.where(self.load_valid(i), depth, np.float32(0))

    def frame(self, i: int) -> CaptureFrame:
        """Loads frame i, 0 <= i < len(self), with its registered depth."""
        if not 0 <= i < len(self):
            raise IndexError(f"frame {i} of {self.name}: it has the frames 0 to {len(self) - 1}")
        return CaptureFrame(
            self.load_image(i), self.registered_depth(i), self.X_WCs[i], self.K, self.load_valid(i)
        )

    def frames(self) -> Iterator[CaptureFrame]:
        """Loads one frame after the other."""
        return (self.frame(i) for i in range(len(self)))


def shrink_factor(width: int, desired: int) -> int:
    """Returns the integer factor that shrinks images of `width` [px] to about `desired`, 0: 1."""
    return max(1, round(width / desired)) if desired else 1


def shrink_mask(valid: NDArray[np.bool_], factor: int) -> NDArray[np.bool_]:
    """Returns the pixels of a shrunken image that replace only valid ones."""
    return _blocks(valid, factor).all(axis=-1)


def _blocks(pixels: NDArray, factor: int) -> NDArray:
    """Returns (h, w, factor^2) from (H, W): the pixels that each shrunken one replaces."""
    height, width = (n // factor for n in pixels.shape)
    blocks = pixels[: height * factor, : width * factor].reshape(height, factor, width, factor)
    return blocks.swapaxes(1, 2).reshape(height, width, factor**2)


def shrink(frame: CaptureFrame, factor: int) -> CaptureFrame:
    """Returns the frame with each factor x factor pixels made one; the remainder is cut off.

    Colors are averaged. Inverse depth of one surface is averaged, exactly on planes; at edges depth
    is the (lower) median. It is 0 where most of it is. A pixel is valid if all it replaces are.
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
        largest = inverse.max(axis=-1)
        spread = largest - np.where(known, inverse, np.inf).min(axis=-1)
        mean = count / inverse.sum(axis=-1)
        # Sorted, the unknown ones come last.
        ordered = np.sort(np.where(known, blocks, np.nan), axis=-1)
        middle = np.maximum(count - 1, 0)[..., None] // 2
        median = np.take_along_axis(ordered, middle, axis=-1)[..., 0]
        depth = np.where(spread <= _ONE_SURFACE * largest, mean, median)
    depth = np.where((2 * count > factor**2) & valid, depth, 0).astype(np.float32)
    K = frame.K.copy()
    K[:2] /= factor
    return CaptureFrame(np.asarray(image, dtype=np.uint8), depth, frame.X_WC, K, valid)
