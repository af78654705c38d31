"""The Gaussians from which a reconstruction starts: from depth, from points, or at random."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from splatpilot.systems.progress import Progress, say
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.training.captures.capture import Capture, CaptureFrame
from splatpilot.training.reconstruction.config import HOLD_OUT, ReconstructConfig
from splatpilot.training.reconstruction.depth_gaussians import frame_gaussians, principal_axes
from splatpilot.training.reconstruction.overlap import STRIDE, ThinnedFrame, find_new_pixels
from splatpilot.training.reconstruction.photometry import Photometry
from splatpilot.training.reconstruction.views import ReconstructionViews

# Steps where -1 are asked for.
_STEPS_OF_IMAGE, _LEAST_STEPS, MOST_STEPS = 32, 2000, 7000
# One in so many frames is tried first.
_SOME = 4
# Opacity and size, in distances to the third neighbour, of Gaussians about points.
_POINT_OPACITY, _POINT_SIZE = 0.1, 0.5
# What part of the surfaces must be covered at first for optimisation to close what is open.
_ENOUGH = 0.8
# Opacity with which Gaussians on surfaces start into the optimisation.
_FIRST_OPACITY = 0.9
# Depth of random Gaussians, in extents of the cameras.
_RANDOM_DEPTH = (0.1, 10.0)


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


def _starts(capture: Capture) -> dict[str, bool]:
    """Returns the initializations and whether the capture has them, the best first."""
    return {"depth": capture.has_depth, "points": capture.points is not None, "random": True}


def resolve_config(config: ReconstructConfig, capture: Capture) -> ReconstructConfig:
    """Returns the config with what "auto" and -1 iterations mean for this capture."""
    kind, strategy = config.initialization, config.strategy
    if kind == "auto":
        kind = next(name for name, there in _starts(capture).items() if there)
    if strategy == "auto":
        strategy = "none" if kind == "depth" else "default"
    iterations = config.iterations
    if iterations < 0:
        fitted = len(capture) - len(held_out_frames(capture, config))
        fitting = max(_STEPS_OF_IMAGE * fitted, _LEAST_STEPS)
        iterations = min(fitting, MOST_STEPS) if kind == "depth" else MOST_STEPS
    return replace(config, initialization=kind, strategy=strategy, iterations=iterations)


def held_out_frames(capture: Capture, config: ReconstructConfig) -> list[int]:
    """Returns the frames that have no part in all that fits."""
    if config.iterations == 0 or config.hold_out == 0:
        return []
    if config.hold_out < 0 and capture.held_out is not None:
        return list(capture.held_out)
    return list(range(0, len(capture), config.hold_out if config.hold_out > 0 else HOLD_OUT))


def make_initial_gaussians(
    capture: Capture,
    frames: Sequence,
    photometry: Photometry,
    views: ReconstructionViews,
    config: ReconstructConfig,
) -> GaussianScene:
    """Returns the Gaussians to start from.

    Raises:
        ValueError: if the capture lacks what is asked for.
    """
    kind, has = config.initialization, _starts(capture)
    if not has[kind]:
        raise ValueError(
            f"initialization is {kind!r}, but {capture.name} has none; choose "
            + " or ".join(repr(name) for name, there in has.items() if there)
        )
    if kind == "depth":
        return gaussians_from_depth(frames, photometry, detail_of(config))
    if capture.points is not None and kind == "points":
        points = capture.points
        return gaussians_from_points(points.p_WQ, points.colors)
    _, extent = views.extent()
    near, far = (extent * depth for depth in _RANDOM_DEPTH)
    count = config.initial_gaussians
    return gaussians_from_points(*random_points(frames, count, near, far, config.seed))


def detail_of(config: ReconstructConfig) -> Detail:
    """Returns how finely Gaussians from depth cover surfaces."""
    optimized = config.iterations > 0
    return Detail(
        max_gaussians=config.initial_gaussians if optimized else config.max_gaussians,
        contrast=config.contrast,
        max_cell=config.max_cell,
        max_extent=config.max_extent,
        opacity=_FIRST_OPACITY if optimized else config.opacity,
        optimized=optimized,
    )


def gaussians_from_depth(
    frames: Sequence[CaptureFrame], photometry: Photometry, detail: Detail
) -> GaussianScene:
    """Returns Gaussians on all surfaces that the frames show, each once.

    Args:
        frames: loaded one by one, and more than once.
        photometry: their brightness, in their order.
        detail: how many.

    Raises:
        ValueError: if even the largest cells make too many and they are not to be optimised, or no
            frame has any depth.
    """
    gains = photometry.gains
    # A gain is a rough account of another tone curve, so other images are preferred to odd ones.
    odd = np.flatnonzero(np.abs(np.log(gains / np.median(gains))) > 0.05)
    views = [ThinnedFrame.of(frame) for frame in frames]
    if not any(view.depth.any() for view in views):
        raise ValueError(
            f"no pixel of {len(frames)} frames has a depth that a surface could have; look at the "
            "depth images and their unit, or set initialization=random"
        )
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
    progress = Progress(desc="placing Gaussians", unit="frame")
    while True:
        # Some of the frames tell when it is far too many.
        parts = {k: gaussians_of(k, frames[k]) for k in some}
        progress.update(len(parts))
        estimate = sum(len(p_WQ) for p_WQ, _, _ in parts.values()) * len(frames) / len(some)
        if estimate <= 1.1 * detail.max_gaussians:
            for k in set(range(len(frames))).difference(some):
                parts[k] = gaussians_of(k, frames[k])
                progress.update()
            if sum(len(p_WQ) for p_WQ, _, _ in parts.values()) <= detail.max_gaussians:
                break
        if contrast < 1:
            contrast *= 1.3 if estimate < 2 * detail.max_gaussians else 2.0
        elif detail.optimized:
            # Edges of depth alone make too many: optimisation fills in what is left out here.
            for k in set(range(len(frames))).difference(some):
                parts[k] = gaussians_of(k, frames[k])
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
        areas = np.trace(covariances, axis1=1, axis2=2)
        covered = areas[kept].sum() / areas.sum()
        if covered < _ENOUGH:
            say(
                f"{len(kept)} Gaussians cover {covered:.0%} of the surfaces that the frames show, "
                f"and leave holes in the rest; {len(p_WQ)} would cover them: set initial_gaussians "
                "nearer to that, or use frames of a smaller part of the place"
            )
        p_WQ, covariances, colors = p_WQ[kept], covariances[kept], colors[kept]
    quats, scales = principal_axes(covariances)
    opacities = np.full(len(p_WQ), detail.opacity)
    return GaussianScene.from_colors(p_WQ, quats, scales, opacities, colors)


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
    """Returns at most `count` points p_WQ (n, 3) [m] and colours (n, 3) along random rays of the
    cameras through valid pixels, at depths whose inverse is uniform from `near` to `far` [m],
    coloured as the rays."""
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
        points.append(frame.X_WC.multiply(frame.back_project(u, v, z).T).T)
        colors.append(frame.image[v.astype(int), u.astype(int)] / 255)
    return np.concatenate(points)[:count], np.concatenate(colors)[:count]
