"""Initial Gaussians of a reconstruction: from depth, from points, or random."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from splatpilot.systems.common.progress import Progress, say
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.background import FAR
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.captures.capture import Capture, CaptureFrame, back_project
from splatpilot.training.captures.photographs import triangulate
from splatpilot.training.reconstruction.config import HOLD_OUT, ReconstructConfig
from splatpilot.training.reconstruction.photometry import (
    Photometry,
    ThinnedFrame,
    find_new_pixels,
    widen,
)

MAX_STEPS = 7000
"""Default maximum of the steps."""
_MIN_STEPS, _STEPS_PER_IMAGE = 2000, 32

# A cell is flat if its inverse depth differs from a plane by less than this fraction (rms), and its
# slope against the ray, sideways to forward, is below the second number.
_FLATNESS, _MAX_SLOPE = 2e-3, 10.0
_MAX_STRETCH = 30.0  # longest to shortest side of a cell on its surface
_DISAGREEMENT = 0.2  # of the slopes to the two neighbors of a pixel on one plane
# Standard deviation relative to the edge of a cell, with an underlay, of the underlay and without
# one. A small one keeps texture sharp, a large one leaves no gaps.
_SPREAD, _UNDERLAY_SPREAD, _SPREAD_ALONE = 0.4, 0.6, 0.65
_THICKNESS = 0.1  # relative to the other standard deviations
# Distance of the underlay behind the surface as a fraction of depth, more on slanted surfaces up to
# a maximum, so that it is drawn behind; and minimum size of its cells [px].
_UNDERLAY_SETBACK, _MAX_SETBACK, _UNDERLAY_SIZE = 0.03, 0.2, 4
_MAX_ODDITY = 0.05  # of the logarithm of a gain, beyond which other images are preferred
_SUBSET = 4  # one in so many frames is tried first
_LARGEST_CELL = 64  # [px]
_MIN_COVERED = 0.8  # fraction of the surfaces, below which optimization leaves holes
_OPACITY = 0.99  # on surfaces
_BEHIND = 0.1  # relative difference of depth, above which another surface shows
_POINT_OPACITY, _POINT_SIZE = 0.1, 0.5  # size relative to the distance of the three closest others
_RANDOM_DEPTH = (0.1, 10.0)  # in extents of the cameras
_MAX_FROM_DEPTH, _MAX_ADDED, _RANDOM = 1_000_000, 180_000, 120_000  # numbers of Gaussians


@dataclass(frozen=True, eq=False)
class Cells:
    """Square cells of an image. Inverse depth in a cell is w + w_u (u - u_c) + w_v (v - v_c) about
    its center (u_c, v_c) [px]."""

    u: NDArray[np.float64]  # (n,) [px], center
    v: NDArray[np.float64]  # (n,) [px]
    size: NDArray[np.float64]  # (n,) [px]
    w: NDArray[np.float64]  # (n,) [1/m]
    w_u: NDArray[np.float64]  # (n,) [1/(m px)]
    w_v: NDArray[np.float64]  # (n,)
    color: NDArray[np.float64]  # (n, 3)

    def select(self, mask: NDArray[np.bool_]) -> "Cells":
        return Cells(**{name: values[mask] for name, values in vars(self).items()})


class BlockMeans:
    """Means over the square blocks of a frame, for powers of two up to `max_size` as edge [px]:
    depth, colors of `image` (H, W, 3) in [0, 1], and `mask` (H, W), the pixels to cover."""

    def __init__(self, frame: CaptureFrame, image: NDArray, mask: NDArray, max_size: int):
        pad = [(0, -n % max_size) for n in frame.depth.shape]
        depth = np.pad(frame.depth, pad).astype(np.float64)
        valid = (depth > 0) & (depth < FAR)
        w = np.where(valid, 1 / np.where(valid, depth, 1), 0)
        v, u = np.indices(w.shape) + 0.5
        color = np.pad(image, [*pad, (0, 0)]).transpose(2, 0, 1).astype(np.float64)
        channels = [valid, np.pad(mask, pad) & valid, w, w * w, w * u, w * v, *color, *color**2]
        means = np.stack(channels)  # (12, H, W), float64
        self._focal_length = frame.K[0, 0]
        self._slopes = [_pixel_slope(w, axis) for axis in (1, 0)]
        self._means = {1: means}
        while (size := 2 * max(self._means)) <= max_size:
            means = means[:, ::2] + means[:, 1::2]
            means = (means[..., ::2] + means[..., 1::2]) / 4
            self._means[size] = means

    def split(self, contrast: float, max_size: int, fraction: float, max_extent: float) -> Cells:
        """Covers the masked pixels with square cells as large as surface and texture allow.

        A quadtree splits cells of `max_size` pixels while depth is missing in them, less than a
        `fraction` of them is masked, their surface is not flat or longer than `max_extent` times
        the depth, or their colors, except in 2 x 2 pixels, vary by a standard deviation above
        `contrast`. Single pixels remain at edges.
        """
        parts: list[tuple[NDArray, ...]] = []
        size = max_size
        undecided = np.ones(self._means[size].shape[1:], dtype=bool)
        while size >= 1:
            valid, masked, w, ww, wu, wv, *moments = self._means[size]
            color, square = np.array(moments[:3]), np.array(moments[3:])
            v, u = (np.indices(w.shape) + 0.5) * size
            # Least-squares plane through the inverse depths of the block.
            spread = (size**2 - 1) / 12  # variance of the pixel coordinates
            w_u, w_v = self._slopes
            if size > 1:
                w_u, w_v = (wu - w * u) / spread, (wv - w * v) / spread
            residual = ww - w**2 - spread * (w_u**2 + w_v**2)
            leaf = undecided & (valid == 1) & (masked >= fraction)
            if size > 1:
                leaf &= residual < (_FLATNESS * w) ** 2
                # A step in depth between two columns of pixels is a plane too, but a steep one.
                tilt = self._focal_length * np.hypot(w_u, w_v) / np.maximum(w, 1e-12)
                leaf &= tilt < _MAX_SLOPE
                tilt = np.minimum(tilt, _MAX_STRETCH)
                leaf &= size / self._focal_length * np.hypot(1, tilt) < max_extent
            if size > 2:
                leaf &= (square - color**2).max(axis=0) < contrast**2
            edge = np.full(np.count_nonzero(leaf), float(size))
            parts.append((u[leaf], v[leaf], edge, w[leaf], w_u[leaf], w_v[leaf], color[:, leaf].T))
            undecided = (undecided & ~leaf).repeat(2, axis=0).repeat(2, axis=1)
            size //= 2
        return Cells(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _pixel_slope(w: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Returns the slope of inverse depth along an axis [1/(m px)], 0 where neighbors disagree."""
    step = np.diff(w, axis=axis)
    zero = np.zeros_like(w.take([0], axis))
    before, after = np.concatenate([zero, step], axis), np.concatenate([step, zero], axis)
    agree = np.abs(after - before) < _DISAGREEMENT * np.abs(after + before)
    return np.where(agree, (before + after) / 2, 0)


def frame_gaussians(
    frame: CaptureFrame,
    image: NDArray,
    mask: NDArray,
    contrast: float,
    max_size: int,
    max_extent: float,
    underlay: bool = True,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Returns centers p_WQ (n, 3) [m], covariances in W (n, 3, 3) [m^2] and colors (n, 3).

    An underlay, wide Gaussians of larger cells a little behind, fills the gaps between narrow ones.
    Without it they are wider, for optimization to sharpen. See `BlockMeans` for the arguments.
    """
    means = BlockMeans(frame, image, mask, 2 * max_size)
    surface = means.split(contrast, max_size, 0.75, max_extent)
    if not underlay:
        return *cell_gaussians(frame, surface, _SPREAD_ALONE), surface.color
    under = means.split(np.inf, 2 * max_size, 0.05, 2 * max_extent)
    under = under.select(under.size >= _UNDERLAY_SIZE)
    # Gaussians are drawn in order of the depths of their centers, so an underlay must be farther
    # than the surface of the neighboring cells.
    across = under.size * np.hypot(under.w_u, under.w_v) / under.w
    factor = 1 + _UNDERLAY_SETBACK + np.minimum(0.75 * across, _MAX_SETBACK)
    under = replace(under, w=under.w / factor, w_u=under.w_u / factor, w_v=under.w_v / factor)
    parts = (surface, _SPREAD), (under, _UNDERLAY_SPREAD)
    return _concatenate((*cell_gaussians(frame, *part), part[0].color) for part in parts)


def _concatenate(parts: Iterable[tuple[NDArray, NDArray, NDArray]]) -> tuple:
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def cell_gaussians(
    frame: CaptureFrame, cells: Cells, spread: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the centers p_WQ (n, 3) [m] and covariances in W (n, 3, 3) [m^2] of flat Gaussians,
    whose standard deviations are `spread` times the cell's edges on the surface, t_u = s dP/du and
    t_v = s dP/dv, with P = r / w along the pixel's ray r."""
    f_u, f_v = frame.K[0, 0], frame.K[1, 1]
    z = 1 / cells.w
    P = back_project(frame.K, cells.u, cells.v, z)  # (n, 3)
    # Limits the slope of surfaces at grazing angles.
    tilt = z * np.hypot(f_u * cells.w_u, f_v * cells.w_v)
    limit = np.minimum(1, _MAX_STRETCH / np.maximum(tilt, 1e-12))
    edge = (cells.size * z)[:, None]
    t_u = edge * (np.array([1 / f_u, 0, 0]) - P * (cells.w_u * limit)[:, None])
    t_v = edge * (np.array([0, 1 / f_v, 0]) - P * (cells.w_v * limit)[:, None])
    normal = np.cross(t_u, t_v)
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    across = _THICKNESS * (cells.size * z / f_u)[:, None] * normal / np.maximum(area, 1e-300)
    axes = spread * np.stack([t_u, t_v, across], axis=-1)  # (n, 3, 3), columns
    axes = frame.X_WC.rotation().matrix() @ axes
    return frame.X_WC.multiply(P.T).T, axes @ axes.transpose(0, 2, 1)


def principal_axes(
    covariances: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns quaternions wxyz (n, 4) and standard deviations (n, 3), the smallest last, of
    covariances (n, 3, 3): the third axis of a flat Gaussian is its normal, as of surfels."""
    variances, R = np.linalg.eigh(covariances)
    variances, R = variances[:, ::-1], R[:, :, ::-1].copy()
    R[np.linalg.det(R) < 0, :, 0] *= -1
    smallest = 1e-6 * variances[:, :1]
    quats = Rotation.from_matrix(R).as_quat(scalar_first=True)
    return quats, np.sqrt(np.maximum(variances, smallest))


def resolve_config(config: ReconstructConfig, capture: Capture) -> ReconstructConfig:
    """Returns the config with values for "auto" and -1 iterations."""
    kind, strategy, iterations = config.initialization, config.strategy, config.iterations
    if kind == "auto":
        kind = "depth" if capture.has_depth else "points"
    if strategy == "auto":
        strategy = "none" if kind == "depth" else "default"
    if iterations < 0:
        fitted = len(capture) - len(held_out_frames(capture, config))
        iterations = min(max(_STEPS_PER_IMAGE * fitted, _MIN_STEPS), MAX_STEPS)
        iterations = iterations if kind == "depth" else MAX_STEPS
    most = config.max_gaussians
    if not most:
        all_at_first = kind == "depth" and strategy == "none" and iterations > 0
        most = max(config.initial_gaussians, _MAX_FROM_DEPTH) if all_at_first else _MAX_ADDED
    steps = {"strategy": strategy, "iterations": iterations, "max_gaussians": most}
    return replace(config, initialization=kind, **steps)


def held_out_frames(capture: Capture, config: ReconstructConfig) -> list[int]:
    """Returns the indices of the held-out frames."""
    if config.iterations == 0 or config.hold_out == 0:
        return []
    if config.hold_out < 0 and capture.held_out is not None:
        return list(capture.held_out)
    return list(range(0, len(capture), config.hold_out if config.hold_out > 0 else HOLD_OUT))


def make_initial_gaussians(
    capture: Capture,
    frames: Sequence[CaptureFrame],
    photometry: Photometry,
    extent: float,
    config: ReconstructConfig,
) -> GaussianScene:
    """Makes the Gaussians that `config` starts from; `extent` [m] is that of the cameras."""
    kind, most = config.initialization, config.max_gaussians
    count = min(config.initial_gaussians or most, most)
    if kind == "depth":
        condition = f"points or random for {capture.name}"
        require(capture.has_depth, "initialization", condition, kind)
        return gaussians_from_depth(frames, photometry, count, config.contrast, optimized=True)
    if kind == "points":
        points = capture.points
        try:
            points = points or triangulate(capture, getattr(frames, "numbers", range(len(capture))))
        except (ValueError, ModuleNotFoundError) as error:
            if capture.has_depth:  # points were chosen
                raise
            say(f"{error}; starting from random points")
        if points is not None:
            order = np.random.default_rng(config.seed).permutation(len(points.p_WQ))
            kept = np.sort(order[:count])
            return gaussians_from_points(points.p_WQ[kept], points.colors[kept])
    near, far = (extent * depth for depth in _RANDOM_DEPTH)
    count = min(config.initial_gaussians or _RANDOM, most)
    return gaussians_from_points(*random_points(frames, count, near, far, config.seed))


def gaussians_from_depth(
    frames: Sequence[CaptureFrame],
    photometry: Photometry,
    max_gaussians: int,
    contrast: float,
    *,
    optimized: bool,
    max_cell: int = 16,
    max_extent: float = 0.06,
) -> GaussianScene:
    """Covers all surfaces of the frames, which are loaded repeatedly, with Gaussians, each once.

    `contrast`, `max_cell` and `max_extent` are of the finest cells, see `BlockMeans.split`; cells
    become coarser until the Gaussians fit: first by more contrast, then by size. If they will be
    `optimized`, Gaussians are wider, without an underlay and, if too many, sampled; else more fill
    the gaps that the frames show between them.
    """
    views = [ThinnedFrame.of(frame) for frame in frames]
    if not any(view.depth.any() for view in views):
        raise ValueError(
            f"no pixel of {len(frames)} frames has a depth that a surface could have; check the "
            "depth images and their unit, or set initialization=random"
        )
    # A gain approximates another tone curve, so other images are preferred to odd ones.
    oddity = np.abs(np.log(photometry.gains) - np.log(np.median(photometry.gains)))
    last = np.flatnonzero(oddity > _MAX_ODDITY).tolist()
    new = find_new_pixels(views, last)
    progress = Progress(desc="placing Gaussians", unit="frame")
    parts: dict[int, tuple[NDArray, NDArray, NDArray]] = {}

    def cover(indices: Iterable[int]) -> int:
        for k in indices:
            frame = frames[k]
            height, width = frame.depth.shape
            factor = photometry.factor(k, height, width)
            image = (frame.image / (255 * factor[..., None])).astype(np.float32)
            mask = widen(new[k], views[k].stride, height, width)
            parts[k] = frame_gaussians(
                frame, image, mask, contrast, max_cell, max_extent, underlay=not optimized
            )
            progress.update()
        return sum(len(p_WQ) for p_WQ, _, _ in parts.values())

    # A subset of the frames tells early that the Gaussians are far too many.
    subset = range(0, len(frames), _SUBSET)
    rest = [k for k in range(len(frames)) if k not in subset]
    while True:
        parts.clear()
        estimate = cover(subset) * len(frames) / len(subset)
        if estimate <= 1.1 * max_gaussians and cover(rest) <= max_gaussians:
            break
        if contrast < 1:
            contrast *= 1.3 if estimate < 2 * max_gaussians else 2.0
        elif optimized:
            cover(k for k in rest if k not in parts)
            break
        elif max_cell < _LARGEST_CELL:
            max_cell, max_extent = 2 * max_cell, 2 * max_extent
        else:
            raise ValueError(
                f"{max_gaussians} Gaussians are too few for {len(frames)} frames, even with "
                f"cells of {max_cell} pixels; allow more, or use fewer frames"
            )
    surfaces = _concatenate(parts[k] for k in range(len(frames)))
    if optimized and len(surfaces[0]) < max_gaussians:
        scene = BakedScene(_opaque_gaussians(*surfaces))
        new = find_new_pixels(
            [_gaps(scene, *pair) for pair in zip(frames, views, strict=True)], last, smooth=False
        )
        cover(k for k in range(len(frames)) if new[k].any())
        surfaces = _concatenate([surfaces, *(parts[k] for k in parts if new[k].any())])
    progress.close()
    p_WQ, covariances, colors = surfaces
    if len(p_WQ) > max_gaussians:
        areas = np.trace(covariances, axis1=1, axis2=2)
        # Drawn in proportion to their radius (Efraimidis and Spirakis 2006).
        keys = np.log(np.random.default_rng(0).uniform(size=len(areas))) / np.sqrt(areas)
        kept = np.sort(np.argpartition(-keys, max_gaussians)[:max_gaussians])
        covered = areas[kept].sum() / areas.sum()
        if covered < _MIN_COVERED:
            say(
                f"{len(kept)} Gaussians cover {covered:.0%} of the surfaces that the frames show, "
                f"and leave holes in the rest; {len(p_WQ)} would cover them: set initial_gaussians "
                "closer to that, or use frames of a smaller part of the scene"
            )
        p_WQ, covariances, colors = p_WQ[kept], covariances[kept], colors[kept]
    return _opaque_gaussians(p_WQ, covariances, colors)


def _opaque_gaussians(p_WQ: NDArray, covariances: NDArray, colors: NDArray) -> GaussianScene:
    quats, scales = principal_axes(covariances)
    opacities = np.full(len(p_WQ), _OPACITY)
    return GaussianScene.from_colors(p_WQ, quats, scales, opacities, colors)


def _gaps(scene: BakedScene, frame: CaptureFrame, view: ThinnedFrame) -> ThinnedFrame:
    """Returns the thinned frame with depth only where the scene shows nothing or what is behind."""
    height, width = frame.depth.shape
    depth = scene.render_depth(frame.K, width, height, frame.X_WC)
    surface = (frame.depth > 0) & (frame.depth < FAR)
    gap = surface & ((depth == 0) | (depth > (1 + _BEHIND) * frame.depth))
    s = view.stride
    gap = cv2.dilate(gap.astype(np.uint8), np.ones((s, s), np.uint8), anchor=(0, 0))[::s, ::s]
    return replace(view, depth=np.where(gap, view.depth, 0))


def gaussians_from_points(p_WQ: NDArray, colors: NDArray) -> GaussianScene:
    """Returns round Gaussians at the points (N, 3) [m] with colors (N, 3)."""
    if len(p_WQ) < 4:
        raise ValueError(f"{len(p_WQ)} points are too few to start from, at least 4 are required")
    distances, _ = KDTree(p_WQ).query(p_WQ, k=4)
    size = np.maximum(_POINT_SIZE * distances[:, 1:].mean(axis=1), 1e-6)
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(p_WQ), 1))
    opacities = np.full(len(p_WQ), _POINT_OPACITY)
    return GaussianScene.from_colors(p_WQ, quats, size[:, None].repeat(3, 1), opacities, colors)


def random_points(
    frames: Iterable[CaptureFrame], count: int, near: float, far: float, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns at most `count` points p_WQ (n, 3) [m] and colors (n, 3) on random rays through valid
    pixels, uniform in inverse depth from `near` to `far` [m], in the color of the pixel."""
    rng = np.random.default_rng(seed)
    frames = list(frames)
    each = -(-count // len(frames))
    points, colors = [], []
    for frame in frames:
        height, width = frame.depth.shape
        u, v = rng.uniform(0, width, each), rng.uniform(0, height, each)
        z = 1 / rng.uniform(1 / far, 1 / near, each)
        valid = frame.valid[v.astype(int), u.astype(int)]
        u, v, z = u[valid], v[valid], z[valid]
        points.append(frame.X_WC.multiply(back_project(frame.K, u, v, z).T).T)
        colors.append(frame.image[v.astype(int), u.astype(int)] / 255)
    return np.concatenate(points)[:count], np.concatenate(colors)[:count]
