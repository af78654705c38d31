"""The Gaussians from which a reconstruction starts: from depth, from points, or at random."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from tqdm import tqdm

from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.depth_gaussians import frame_gaussians, principal_axes
from splatpilot.training.reconstruction.overlap import STRIDE, View, find_new_pixels
from splatpilot.training.reconstruction.photometry import Photometry

# Where what is beyond range is put [m]: at this distance of the camera that saw it.
SHELL = 150.0
# One in so many frames is tried first.
_SOME = 4
# Opacity and size, in distances to the third neighbour, of Gaussians about points.
_POINT_OPACITY, _POINT_SIZE = 0.1, 0.5


@dataclass(frozen=True, kw_only=True)
class Detail:
    """How finely `gaussians_from_depth` covers surfaces; see `frame_gaussians`."""

    max_gaussians: int
    contrast: float
    max_cell: int  # [px]
    max_extent: float
    opacity: float
    optimized: bool = False
    """Whether they are to be optimised: wider ones then, without an underlay."""


def with_shell(frame: CaptureFrame) -> CaptureFrame:
    """Returns the frame with all depth of more than `SHELL`, infinite depth too, on a sphere of
    that radius about the camera, on which other cameras nearby see the same far things."""
    height, width = frame.depth.shape
    rows, columns = np.mgrid[0:height, 0:width] + 0.5
    ray = frame.back_project(columns, rows, np.ones_like(rows))
    planar = (SHELL / np.linalg.norm(ray, axis=-1)).astype(np.float32)
    return replace(frame, depth=np.where(frame.depth > SHELL, planar, frame.depth))


def gaussians_from_depth(
    frames: Sequence[CaptureFrame], photometry: Photometry, detail: Detail
) -> tuple[GaussianScene, tuple[float, float, float]]:
    """Returns Gaussians on all surfaces that the frames show, each once, and their mean colour.

    Args:
        frames: loaded one by one, and more than once.
        photometry: their brightness, in their order.
        detail: how many.

    Raises:
        ValueError: if even the largest cells make too many and they are not to be optimised.
    """
    gains = photometry.gains
    # A gain is a rough account of another tone curve, so other images are preferred to odd ones.
    odd = np.flatnonzero(np.abs(np.log(gains / np.median(gains))) > 0.05)
    views = [View.of(with_shell(frame)) for frame in frames]
    new = find_new_pixels(views, last=odd.tolist())

    def gaussians_of(k: int, frame: CaptureFrame) -> tuple[NDArray, NDArray, NDArray]:
        height, width = frame.depth.shape
        factor = photometry.factor(k, height, width)
        image = (frame.image / (255 * factor[..., None])).astype(np.float32)
        wanted = new[k].repeat(STRIDE, axis=0).repeat(STRIDE, axis=1)[:height, :width]
        return frame_gaussians(
            frame, image, wanted, contrast, max_cell, max_extent, underlay=not detail.optimized
        )

    # Fewer, coarser cells until the Gaussians fit: first where texture asks for fine ones, then
    # everywhere.
    contrast, max_cell, max_extent = detail.contrast, detail.max_cell, detail.max_extent
    some = range(0, len(frames), _SOME)
    progress = tqdm(desc="Gaussians", unit="frame")
    while True:
        # Some of the frames tell when it is far too many.
        parts = {k: gaussians_of(k, with_shell(frames[k])) for k in some}
        progress.update(len(parts))
        estimate = sum(len(p_WQ) for p_WQ, _, _ in parts.values()) * len(frames) / len(some)
        if estimate <= 1.1 * detail.max_gaussians:
            for k in set(range(len(frames))).difference(some):
                parts[k] = gaussians_of(k, with_shell(frames[k]))
                progress.update()
            if sum(len(p_WQ) for p_WQ, _, _ in parts.values()) <= detail.max_gaussians:
                break
        if contrast < 1:
            contrast *= 1.3 if estimate < 2 * detail.max_gaussians else 2.0
        elif detail.optimized:
            # Edges of depth alone make too many: optimisation fills in what is left out here.
            for k in set(range(len(frames))).difference(some):
                parts[k] = gaussians_of(k, with_shell(frames[k]))
                progress.update()
            break
        elif max_cell < 64:
            max_cell, max_extent = 2 * max_cell, 2 * max_extent
        else:
            raise ValueError(
                f"{detail.max_gaussians} Gaussians are too few for {len(frames)} frames, even with "
                f"cells of {max_cell} pixels; allow more, or use fewer frames"
            )
    progress.close()
    in_order = [parts[k] for k in range(len(frames))]
    p_WQ, covariances, colors = (np.concatenate(column) for column in zip(*in_order, strict=True))
    if len(p_WQ) > detail.max_gaussians:
        kept = _mostly_large(covariances, detail.max_gaussians)
        p_WQ, covariances, colors = p_WQ[kept], covariances[kept], colors[kept]
    quats, scales = principal_axes(covariances)
    opacities = np.full(len(p_WQ), detail.opacity)
    red, green, blue = np.clip(colors.mean(axis=0), 0, 1)
    scene = GaussianScene.from_colors(p_WQ, quats, scales, opacities, colors)
    return scene, (float(red), float(green), float(blue))


def _mostly_large(covariances: NDArray, count: int) -> NDArray[np.intp]:
    """Draws `count` Gaussians without replacement, each with a chance in proportion to its radius
    (Efraimidis and Spirakis 2006); in their order."""
    radii = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    keys = np.log(np.random.default_rng(0).uniform(size=len(radii))) / radii
    return np.sort(np.argpartition(-keys, count)[:count])


def gaussians_from_points(p_WQ: NDArray, colors: NDArray) -> GaussianScene:
    """Returns round Gaussians about the points (N, 3) [m] with colours (N, 3), as large as the
    distances to the three nearest others are on average.

    Raises:
        ValueError: if there are fewer than four points.
    """
    if len(p_WQ) < 4:
        raise ValueError(f"{len(p_WQ)} points are too few to start from, at least 4 are needed")
    distances, _ = KDTree(p_WQ).query(p_WQ, k=4)
    size = np.maximum(_POINT_SIZE * distances[:, 1:].mean(axis=1), 1e-6)
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(p_WQ), 1))
    opacities = np.full(len(p_WQ), _POINT_OPACITY)
    return GaussianScene.from_colors(p_WQ, quats, size[:, None].repeat(3, 1), opacities, colors)


def random_points(
    frames: Iterable[CaptureFrame], count: int, near: float, far: float, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns about `count` points p_WQ (n, 3) [m] and colours (n, 3) along random rays of the
    cameras, at depths whose inverse is uniform from `near` to `far` [m], coloured as the rays."""
    rng = np.random.default_rng(seed)
    frames = list(frames)
    each = -(-count // len(frames))
    points, colors = [], []
    for frame in frames:
        height, width = frame.depth.shape
        u, v = rng.uniform(0, width, each), rng.uniform(0, height, each)
        z = 1 / rng.uniform(1 / far, 1 / near, each)
        points.append(frame.X_WC.multiply(frame.back_project(u, v, z).T).T)
        colors.append(frame.image[v.astype(int), u.astype(int)] / 255)
    return np.concatenate(points)[:count], np.concatenate(colors)[:count]
