"""The Gaussians from which a reconstruction starts: from depth, from points, or at random."""

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from splatpilot.systems.common.processes import run_apart
from splatpilot.systems.common.progress import Progress, say
from splatpilot.systems.splats.background import FAR
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.captures.capture import Capture, CaptureFrame, SfmPoints
from splatpilot.training.captures.colmap import import_pycolmap
from splatpilot.training.reconstruction.config import HOLD_OUT, ReconstructConfig
from splatpilot.training.reconstruction.photometry import (
    STRIDE,
    Photometry,
    ThinnedFrame,
    find_new_pixels,
)
from splatpilot.training.reconstruction.views import ReconstructionViews

# A cell is flat if its inverse depth differs from a plane by less than this fraction (rms).
_FLATNESS = 2e-3
# And if its surface's slope against the ray, sideways to forward, is less than one to this.
_STEEPEST = 10.0
# Standard deviation of a Gaussian as a fraction of the edge of its cell: small keeps texture sharp,
# and large leaves no gaps to look through.
_SPREAD = 0.4
_UNDERLAY_SPREAD = 0.6
_SPREAD_ALONE = 0.5
# How much farther from the camera than the surface the underlay stands, as a fraction of depth:
# enough that it is drawn behind; on oblique surfaces more, up to _MAX_SETBACK. Cells of it have
# at least _UNDERLAY_SIZE pixels.
_UNDERLAY_SETBACK = 0.03
_MAX_SETBACK = 0.2
_UNDERLAY_SIZE = 4
# Thickness of a Gaussian as a fraction of its other standard deviations.
_THICKNESS = 0.1
# Longest to shortest side of a cell on its surface, for surfaces seen at grazing angles.
_MAX_STRETCH = 8.0


@dataclass(frozen=True, eq=False)
class Cells:
    """Square cells of an image, each of which becomes one Gaussian.

    Inverse depth in a cell is w + w_u (u - u_c) + w_v (v - v_c) about its centre (u_c, v_c) [px].
    """

    u: NDArray[np.float64]  # (n,) [px], centre
    v: NDArray[np.float64]  # (n,) [px]
    size: NDArray[np.float64]  # (n,) [px]
    w: NDArray[np.float64]  # (n,) [1/m]
    w_u: NDArray[np.float64]  # (n,) [1/(m px)]
    w_v: NDArray[np.float64]  # (n,)
    color: NDArray[np.float64]  # (n, 3)

    def select(self, mask: NDArray[np.bool_]) -> "Cells":
        """Returns some of the cells."""
        return Cells(**{field.name: getattr(self, field.name)[mask] for field in fields(self)})

    def move_back(self, factor: NDArray[np.float64]) -> "Cells":
        """Returns the same cells on surfaces `factor` (n,) times as far away."""
        w, w_u, w_v = (slope / factor for slope in (self.w, self.w_u, self.w_v))
        return replace(self, w=w, w_u=w_u, w_v=w_v)


class BlockMeans:
    """Means over the square blocks of an image, for every power of two as their edge [px].

    Args:
        frame: the depth.
        image: (H, W, 3), the colours to use, in 0 to 1.
        wanted: (H, W), where Gaussians are wanted.
        max_size: the largest edge [px], a power of two.
    """

    def __init__(
        self,
        frame: CaptureFrame,
        image: NDArray[np.float32],
        wanted: NDArray[np.bool_],
        max_size: int,
    ):
        pad = [(0, -n % max_size) for n in frame.depth.shape]
        depth = np.pad(frame.depth, pad).astype(np.float64)
        valid = (depth > 0) & (depth < FAR)
        w = np.where(valid, 1 / np.where(valid, depth, 1), 0)
        v, u = np.indices(w.shape) + 0.5
        color = np.pad(image, [*pad, (0, 0)]).transpose(2, 0, 1).astype(np.float64)
        channels = [valid, np.pad(wanted, pad) & valid, w, w * w, w * u, w * v, *color, *color**2]
        means = np.stack(channels)  # (12, H, W), float64
        self._focal_length = frame.K[0, 0]
        self._means = {1: means}
        size = 1
        while size < max_size:
            means = means[:, ::2] + means[:, 1::2]
            means = (means[..., ::2] + means[..., 1::2]) / 4
            size *= 2
            self._means[size] = means

    def split(self, contrast: float, max_size: int, fraction: float, max_extent: float) -> Cells:
        """Covers the wanted pixels with square cells, as large as surface and texture allow.

        A quadtree: cells of `max_size` pixels are split while depth is missing somewhere in them,
        less than a `fraction` of them is wanted, their surface is not flat, they extend on it for
        more than `max_extent` times the depth, or their colours vary by a standard deviation of
        more than `contrast`; colours alone do not split a cell of 2 pixels. Single pixels remain
        along the edges of things.
        """
        parts: list[tuple[NDArray, ...]] = []
        size = max_size
        undecided = np.ones(self._means[size].shape[1:], dtype=bool)
        while size >= 1:
            valid, wanted, w, ww, wu, wv, *moments = self._means[size]
            color, square = np.array(moments[:3]), np.array(moments[3:])
            v, u = (np.indices(w.shape) + 0.5) * size
            # Least-squares plane through the inverse depths of the block.
            spread = (size**2 - 1) / 12  # variance of the pixel coordinates
            w_u, w_v = (
                ((wu - w * u) / spread, (wv - w * v) / spread) if size > 1 else (0 * w, 0 * w)
            )
            residual = ww - w**2 - spread * (w_u**2 + w_v**2)
            leaf = undecided & (valid == 1) & (wanted >= fraction)
            if size > 1:
                leaf &= residual < (_FLATNESS * w) ** 2
                # A step in depth between two columns of pixels is a plane too, but a steep one.
                tilt = self._focal_length * np.hypot(w_u, w_v) / np.maximum(w, 1e-12)
                leaf &= tilt < _STEEPEST
                tilt = np.minimum(tilt, _MAX_STRETCH)
                leaf &= size / self._focal_length * np.hypot(1, tilt) < max_extent
            if size > 2:
                leaf &= (square - color**2).max(axis=0) < contrast**2
            edge = np.full(np.count_nonzero(leaf), float(size))
            parts.append((u[leaf], v[leaf], edge, w[leaf], w_u[leaf], w_v[leaf], color[:, leaf].T))
            undecided = (undecided & ~leaf).repeat(2, axis=0).repeat(2, axis=1)
            size //= 2
        return Cells(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def frame_gaussians(
    frame: CaptureFrame,
    image: NDArray[np.float32],
    wanted: NDArray[np.bool_],
    contrast: float,
    max_size: int,
    max_extent: float,
    underlay: bool = True,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Returns centres p_WQ (n, 3) [m], covariances in W (n, 3, 3) [m^2] and colours (n, 3).

    Arguments as for `BlockMeans` and `BlockMeans.split`. The Gaussians of the cells are narrow, for
    narrow ones stay sharp; so that nothing shines through between them and where frames meet, wide
    ones from larger cells, whatever their texture, lie a little behind: the underlay. Without it
    the Gaussians of the cells are wider, for optimisation to sharpen.
    """
    means = BlockMeans(frame, image, wanted, 2 * max_size)
    surface = means.split(contrast, max_size, 0.75, max_extent)
    if not underlay:
        return *cell_gaussians(frame, surface, _SPREAD_ALONE), surface.color
    under = means.split(np.inf, 2 * max_size, 0.05, 2 * max_extent)
    under = under.select(under.size >= _UNDERLAY_SIZE)
    # Gaussians are drawn in order of the depths of their centres, so an underlay must be farther
    # than the surface of the neighbouring cells.
    across = under.size * np.hypot(under.w_u, under.w_v) / under.w
    under = under.move_back(1 + _UNDERLAY_SETBACK + np.minimum(0.75 * across, _MAX_SETBACK))
    p_WQ, covariances = cell_gaussians(frame, surface, _SPREAD)
    p_WU, under_covariances = cell_gaussians(frame, under, _UNDERLAY_SPREAD)
    return (
        np.concatenate([p_WQ, p_WU]),
        np.concatenate([covariances, under_covariances]),
        np.concatenate([surface.color, under.color]),
    )


def cell_gaussians(
    frame: CaptureFrame, cells: Cells, spread: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the centres p_WQ (n, 3) [m] and covariances in W (n, 3, 3) [m^2] of flat Gaussians.

    A cell's edges on the surface are t_u = s dP/du and t_v = s dP/dv, with P = r / w along the
    pixel's ray r; `spread` times them are the standard deviations, plus a little thickness across.
    """
    f_u, f_v = frame.K[0, 0], frame.K[1, 1]
    z = 1 / cells.w
    P = frame.back_project(cells.u, cells.v, z)  # (n, 3)
    # Limit the slope of surfaces that are seen edge on.
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
    """Returns quaternions wxyz (n, 4) and standard deviations (n, 3) of covariances (n, 3, 3).

    The smallest comes last: the third axis of a flat Gaussian is its normal, as of surfels.
    """
    variances, R = np.linalg.eigh(covariances)
    variances, R = variances[:, ::-1], R[:, :, ::-1].copy()
    R[np.linalg.det(R) < 0, :, 0] *= -1
    smallest = 1e-6 * variances[:, :1]
    return _quaternions(R), np.sqrt(np.maximum(variances, smallest))


def _quaternions(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns unit quaternions wxyz (n, 4) of rotation matrices (n, 3, 3).

    The matrix 4 q q^T is linear in R; its row with the largest diagonal is a multiple of q.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(R, 0, -1)
    outer = np.array(
        [
            [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
        ]
    )  # (4, 4, n)
    row = np.argmax(np.einsum("iin->in", outer), axis=0)
    q = outer[row, :, np.arange(len(R))]
    return q / np.linalg.norm(q, axis=1, keepdims=True)


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


if TYPE_CHECKING:
    import pycolmap

_OVERLAP = 10  # images after each one that it is matched with
_FEATURES = 2048  # at most, of an image


def triangulate(capture: Capture, numbers: Sequence[int]) -> SfmPoints:
    """Returns the points that pycolmap triangulates between some frames of a capture, whose poses
    and intrinsics are taken as they are.

    SIFT features of each frame are matched with those of the next ten in order.

    Raises:
        ValueError: if fewer than 100 points are found.
        OSError: if the images cannot be read, or copied into the system's temporary folder, or that
            has no room for what pycolmap keeps there.
    """
    with tempfile.TemporaryDirectory(prefix="splatpilot-") as folder:
        images = Path(folder) / "images"
        for part in (images, images.parent / "masks"):
            part.mkdir()
        names = [f"{k:06d}.png" for k in range(len(numbers))]
        for name, i in zip(Progress(names, "copying frames", unit="frame"), numbers, strict=True):
            image = capture.load_image(i)
            if not cv2.imwrite(str(images / name), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
                raise OSError(f"{images / name}: cannot be written; is the disk full?")
            valid = np.broadcast_to(capture.load_valid(i), (capture.height, capture.width))
            mask = images.parent / "masks" / f"{name}.png"
            if not cv2.imwrite(str(mask), 255 * valid.astype(np.uint8)):
                raise OSError(f"{mask}: cannot be written; is the disk full?")
        poses = {
            name: capture.X_WCs[i].inverse().GetAsMatrix34()
            for name, i in zip(names, numbers, strict=True)
        }
        say(f"triangulating points between {len(names)} images")
        work = Path(folder), capture.K, poses
        p_WQ, colors = run_apart(f"{folder}: triangulation", _triangulated, work)
    if len(p_WQ) < 100:
        raise ValueError(
            f"{capture.source}: only {len(p_WQ)} points can be triangulated between its images, "
            "100 are needed; it has too little texture or its frames see too different things"
        )
    # Threads hand images and matches over in any order, and points are numbered by it.
    order = np.lexsort(p_WQ.T)
    return SfmPoints(p_WQ[order], colors[order])


def _triangulated(
    work: tuple[Path, NDArray[np.float64], dict[str, NDArray[np.float64]]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns points (n, 3) and their colours (n, 3), 0 to 1.

    Args:
        work: a folder with `images`, their intrinsics (3, 3) [px], and their poses X_CW (3, 4) by
            name.
    """
    folder, K, poses = work
    pycolmap = import_pycolmap()
    # COLMAP logs every image on standard error.
    pycolmap.logging.minloglevel = max(pycolmap.logging.minloglevel, 2)
    pycolmap.set_random_seed(0)
    database, images = folder / "database.db", folder / "images"
    model = _make_posed_model(K, poses, database, images)
    pairing = pycolmap.SequentialPairingOptions(overlap=_OVERLAP, quadratic_overlap=False)
    # One thread each: others would make the order of images and matches, and with it the last
    # digits of the points, a matter of chance.
    matching = pycolmap.FeatureMatchingOptions(num_threads=1)
    pycolmap.match_sequential(database, matching, pairing)
    (folder / "model").mkdir()
    options = pycolmap.IncrementalPipelineOptions(extract_colors=True, num_threads=1, random_seed=0)
    model = pycolmap.triangulate_points(model, database, images, folder / "model", options=options)
    points = list(model.points3D.values())
    p_WQ = np.array([point.xyz for point in points]).reshape(-1, 3)
    return p_WQ, np.array([point.color for point in points]).reshape(-1, 3) / 255


def _make_posed_model(
    K: NDArray[np.float64], poses: dict[str, NDArray[np.float64]], database: Path, images: Path
) -> "pycolmap.Reconstruction":
    """Extracts features into the database and returns a model of the cameras, without points."""
    pycolmap = import_pycolmap()
    parameters = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = _FEATURES
    extraction.num_threads = 1
    pycolmap.extract_features(
        database,
        images,
        list(poses),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=pycolmap.ImageReaderOptions(
            camera_model="PINHOLE",
            camera_params=",".join(f"{x:.17g}" for x in parameters),
            mask_path=images.parent / "masks",
        ),
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as content:
        (camera,) = content.read_all_cameras()
        model.add_camera_with_trivial_rig(camera)
        for image in content.read_all_images():
            model.add_image_with_trivial_frame(
                pycolmap.Image(
                    name=image.name, camera_id=camera.camera_id, image_id=image.image_id
                ),
                pycolmap.Rigid3d(poses[image.name]),
            )
    return model
