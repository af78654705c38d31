"""Camera poses: planned to see the surfaces around a free space, or along a path."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.ndimage import gaussian_filter1d, label
from scipy.spatial import KDTree

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.validation import require
from splatpilot.training.captures.capture import project

_MAX_NODES = 1_000_000  # of the grid in which free space is found
_REACH = (4.0, 10.0)  # [m], of a camera that sees a surface well: indoors, and at most outdoors
_FARTHER = 1.3  # times the distance of the nearest camera, from which remote surfaces are seen
_STOPS = 4  # positions of the camera along `reach`
_PATCHES = 10  # patches of surfaces along `reach`
_YAWS = np.deg2rad(np.arange(0.0, 360.0, 45.0))
_PITCHES = np.deg2rad([-20.0, 15.0])
_GRAZING = 0.2  # cosine between normal and line of sight below which a surface is not seen
_OUTSIDE = 0.1  # min. volume of an enclosed space, relative to that which the border bounds
_WORTH = 0.03  # gain of a frame relative to the first, below which frames are not worth it
_LEGEND = 100  # [px], height of the legend of a picture
_SMALL = 4.0  # [m^2] of free space that is left out without a word
_CHUNK = 400_000  # lines of sight that are tested at once


@dataclass(frozen=True, eq=False)
class CapturePlan:
    """Camera poses, and the patches of surfaces that they see."""

    X_WCs: list[RigidTransform]
    p_WQ: NDArray[np.float64]  # (N, 3) [m], patches that can be seen from the free space
    views: NDArray[np.intp]  # (N,) number of directions from which each is seen
    possible: NDArray[np.intp]  # (N,) the same if there were a camera at all free positions
    required: int  # number of directions
    reach: float  # [m] from which surfaces are seen
    more_frames: int  # that would be worth it beyond the maximum number
    free_area: float  # [m^2], of the free space from above
    # [m^2] and a point (3,) [m] of each part of free space that only the clearance cuts off.
    others: list[tuple[float, NDArray[np.float64]]]

    @property
    def coverage(self) -> float:
        """Share of the patches that are seen from the required number of directions."""
        return float(np.mean(self.views >= self.required))

    def picture(self) -> NDArray[np.uint8]:
        """Draws a top view (H, W, 3), red, green, blue, of patches and cameras; see its legend."""
        lower, upper = self.p_WQ.min(axis=0)[:2], self.p_WQ.max(axis=0)[:2]
        scale = 1000 / max(upper - lower)  # [px/m]
        radius = max(2, int(0.4 * scale * self.reach / _PATCHES))
        width, height = (scale * (upper - lower)).astype(int) + 2 * radius + 1
        image = np.full((height + _LEGEND, max(width, 6 * _LEGEND), 3), 255, np.uint8)

        def pixel(p_WQ: NDArray) -> tuple[int, int]:
            x, y = scale * (p_WQ[:2] - lower) + radius
            return int(x), int(height - 1 - y)

        # Those that are seen least last, so that nothing hides them.
        for k in np.argsort(-self.views, kind="stable"):
            part = min(self.views[k] / self.required, 1)
            color = (190, 190, 190) if part == 1 else (220, int(220 * part), 0)
            cv2.circle(image, pixel(self.p_WQ[k]), radius, color, -1)
        for X_WC in self.X_WCs:
            here, ahead = X_WC.translation(), X_WC.rotation().matrix()[:, 2]
            cv2.line(image, pixel(here), pixel(here + 0.5 * ahead), (30, 60, 220), 1)
            cv2.circle(image, pixel(here), 2, (30, 60, 220), -1)
        legend = {
            "never seen": (220, 0, 0),
            f"from too few of {self.required} directions": (220, 150, 0),
            "seen from enough": (150, 150, 150),
            "cameras": (30, 60, 220),
        }
        for k, (name, color) in enumerate(legend.items()):
            row = height + (k + 1) * _LEGEND // 5
            cv2.putText(image, name, (radius, row), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color)
        return image


def plan_capture(
    esdf: Esdf,
    K: NDArray[np.float64],
    size: tuple[int, int],
    heights: tuple[float, float],
    clearance: float,
    views: int = 3,
    reach: float = 0.0,
    max_frames: int = 600,
    inside: NDArray[np.float64] | None = None,
) -> CapturePlan:
    """Plans the poses of a camera, in the order of a short path.

    The free space is that between two heights above the surface below, its largest connected part
    that does not touch the border of the field, unless that is small. Each pose is the one that
    sees most patches of surfaces from a direction that they still need (greedy set cover).

    Args:
        K, size: (3, 3) intrinsics, width and height [px].
        heights: [m] above the surface below.
        clearance: [m] of the camera from surfaces.
        views: number of directions, at least some 45 degrees apart, from which each is seen.
        reach: [m] from which surfaces are seen; 0 for 4 m in rooms and up to 10 m in the open.
            What no camera approaches so far is seen from farther away.
        max_frames: maximum number of poses.
        inside: (3,) [m], a point of the space; None to choose as above.
    """
    p_WN, spacing, others = _free_space(esdf, heights, clearance, inside)
    reach = reach or float(np.clip(_openness(esdf, p_WN), *_REACH))
    stops = p_WN[_one_per_cell(p_WN, reach / _STOPS)]
    p_WQ, normals = _patches(esdf, reach / _PATCHES)
    stop, patch = _lines_of_sight(esdf, stops, p_WQ, normals, reach)
    seen, patch = np.unique(patch, return_inverse=True)
    p_WQ = p_WQ[seen]
    toward = stops[stop] - p_WQ[patch]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    direction = (np.round(toward).astype(int) + 1) @ np.array([1, 3, 9])  # one of 26
    possible = _count(patch, direction, len(p_WQ))
    candidates = _candidates(stops, stop, toward, K, size)
    required = np.minimum(possible, views)
    chosen, more = _cover(candidates, patch, direction, required, max_frames)
    lines = np.concatenate([candidates[k][1] for k in chosen]) if chosen else np.zeros(0, int)
    counts = _count(patch[lines], direction[lines], len(p_WQ))
    X_WCs = _in_order([candidates[k][0] for k in chosen])
    area = _area(p_WN, spacing)
    return CapturePlan(X_WCs, p_WQ, counts, possible, views, reach, more, area, others)


def _area(p_WN: NDArray, spacing: float) -> float:
    """Returns the area [m^2] of nodes (N, 3) from above."""
    return len(np.unique(p_WN[:, :2], axis=0)) * spacing**2


def _count(patch: NDArray, direction: NDArray, size: int) -> NDArray[np.intp]:
    """Counts the directions (size,) from which patches are seen, of lines of sight (L,)."""
    return np.bincount(np.unique(27 * patch + direction) // 27, minlength=size)


def _free_space(
    esdf: Esdf, heights: tuple[float, float], clearance: float, inside: NDArray | None
) -> tuple[NDArray[np.float64], float, list[tuple[float, NDArray[np.float64]]]]:
    """Returns nodes (N, 3) [m] of the camera's space, their spacing [m], and other parts of it."""
    extent = esdf.upper_W - esdf.lower_W
    spacing = max(esdf.voxel_size, 0.2, float(np.cbrt(np.prod(extent) / _MAX_NODES)))
    shape = np.maximum((extent / spacing).astype(int), 1).tolist()
    p_WN = esdf.lower_W + spacing * (np.stack(np.indices(shape), axis=-1) + 0.5)
    found = esdf.distance(p_WN)
    above = p_WN[..., 2] - _surface_below(esdf, p_WN, spacing)
    low, high = heights
    between = (above >= low) & (above <= high)
    usable = between & (found > clearance)
    parts, count = cast(Any, label(usable, np.ones((3, 3, 3))))
    if count == 0:
        raise ValueError(
            f"poses between {low:g} and {high:g} m above surfaces with a clearance of more than "
            f"{clearance} m must exist, got none in {' x '.join(f'{x:.3g}' for x in extent)} m; "
            "correct the scale if this size is wrong, require less clearance, or allow other "
            "heights"
        )
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    sizes[0] = 0
    if inside is not None:
        nodes = np.argwhere(usable)
        nearest = nodes[np.linalg.norm(p_WN[usable] - inside, axis=1).argmin()]
        part = parts[tuple(nearest)]
    else:
        border = np.concatenate([parts[[0, -1]].ravel(), parts[:, [0, -1]].ravel()])
        enclosed = sizes.copy()
        enclosed[np.unique(border)] = 0
        part = sizes.argmax() if enclosed.max() < _OUTSIDE * sizes.max() else enclosed.argmax()
    wider, _ = cast(Any, label(between & (found > min(clearance, esdf.voxel_size))))
    numbers = np.unique(parts[np.isin(wider, wider[parts == part])])
    left = [p_WN[parts == other] for other in numbers if other not in (0, part)]
    others = [(_area(nodes, spacing), nodes[len(nodes) // 2]) for nodes in left]
    others = sorted((each for each in others if each[0] > _SMALL), key=lambda each: -each[0])
    return p_WN[parts == part], spacing, others


def _surface_below(esdf: Esdf, p_WN: NDArray, spacing: float) -> NDArray[np.float64]:
    """Returns the heights [m] of the next surfaces below the nodes of a grid; -inf for none."""
    shape = p_WN.shape[:3]
    voxels = np.argwhere(esdf.states == FieldState.OCCUPIED)
    cells = np.minimum(
        ((voxels + 0.5) * esdf.voxel_size / spacing).astype(int), np.array(shape) - 1
    )
    below = np.full(shape, -np.inf)
    # Ground at the lower end of the field fills no voxel.
    lowest = p_WN[:, :, 0].copy()
    lowest[..., 2] = esdf.lower_W[2] + 0.5 * esdf.voxel_size
    below[esdf.distance(lowest) < esdf.voxel_size, 0] = esdf.lower_W[2]
    np.maximum.at(below, tuple(cells.T), esdf.lower_W[2] + esdf.voxel_size * (voxels[:, 2] + 1))
    return np.maximum.accumulate(below, axis=2)


def _openness(esdf: Esdf, p_WN: NDArray) -> float:
    """Returns the median distance [m] of what level views from free nodes show, up to 20 m."""
    some = p_WN[:: max(len(p_WN) // 200, 1)]
    rays = np.stack([np.cos(_YAWS), np.sin(_YAWS), 0 * _YAWS], axis=1)
    origins, rays = np.repeat(some, len(rays), axis=0), np.tile(rays, (len(some), 1))
    return float(np.median(_march(esdf, origins, rays, np.full(len(rays), 20.0))))


def _march(esdf: Esdf, p_WQ: NDArray, rays: NDArray, lengths: NDArray) -> NDArray[np.float64]:
    """Returns how far [m] rays (n, 3) of given lengths get from points (n, 3) in free space."""
    reached, active = np.zeros(len(rays)), np.arange(len(rays))
    while len(active):
        found = esdf.distance(p_WQ[active] + reached[active, None] * rays[active])
        # Beyond the field, where distance is NaN, nothing stops a ray.
        free = ~(found < 0.25 * esdf.voxel_size)
        active, found = active[free], found[free]
        reached[active] += np.fmax(found, 0.5 * esdf.voxel_size)
        active = active[reached[active] < lengths[active]]
    return np.minimum(reached, lengths)


def _one_per_cell(p_WN: NDArray, size: float) -> NDArray[np.intp]:
    """Returns the index of a node in each cell of `size` [m], the one nearest to its middle."""
    cell = np.floor(p_WN / size)
    order = np.argsort(np.linalg.norm(p_WN / size - cell - 0.5, axis=1), kind="stable")
    _, first = np.unique(cell[order], axis=0, return_index=True)
    return np.sort(order[first])


def _patches(esdf: Esdf, size: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns points (N, 3) [m] before surfaces, and their normals: one per normal and cell of
    `size` [m], if its faces are at least a fifth of a square."""
    occupied = esdf.states == FieldState.OCCUPIED
    voxel = esdf.voxel_size
    points, normals = [], []
    for axis in range(3):
        for sign in (1, -1):
            beside = np.roll(occupied, -sign, axis)
            beside[(slice(None),) * axis + (-1 if sign == 1 else 0,)] = True
            faces = np.argwhere(occupied & ~beside)
            normal = sign * np.eye(3)[axis]
            p_WQ = esdf.lower_W + voxel * (faces + 0.5 + 1.5 * normal)
            _, cell, count = np.unique(
                np.floor(p_WQ / size).astype(int), axis=0, return_inverse=True, return_counts=True
            )
            mean = np.stack([np.bincount(cell, x) for x in p_WQ.T], axis=1) / count[:, None]
            # The point nearest to the mean, since that may lie behind a curved surface.
            offset = np.linalg.norm(p_WQ - mean[cell], axis=1)
            order = np.lexsort((offset, cell))
            nearest = order[np.searchsorted(cell[order], np.arange(len(count)))]
            kept = nearest[count * voxel**2 > 0.2 * size**2]
            points.append(p_WQ[kept])
            normals.append(np.tile(normal, (len(kept), 1)))
    return np.concatenate(points), np.concatenate(normals)


def _lines_of_sight(
    esdf: Esdf, stops: NDArray, p_WQ: NDArray, normals: NDArray, reach: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Returns the stops and patches of all free lines of sight."""
    tree = KDTree(stops)
    nearest, _ = tree.query(p_WQ)
    limits = np.clip(_FARTHER * nearest, reach, 3 * reach)
    found = tree.query_ball_point(p_WQ, limits)
    patch = np.repeat(np.arange(len(p_WQ)), [len(each) for each in found])
    stop = np.concatenate([np.asarray(each, dtype=np.intp) for each in found])
    free = np.zeros(len(stop), dtype=bool)
    for first in range(0, len(stop), _CHUNK):
        some = np.arange(first, min(first + _CHUNK, len(stop)))
        rays = stops[stop[some]] - p_WQ[patch[some]]
        lengths = np.linalg.norm(rays, axis=1)
        rays /= lengths[:, None]
        facing = (rays * normals[patch[some]]).sum(axis=1) > _GRAZING
        some, rays, lengths = some[facing], rays[facing], lengths[facing]
        free[some] = _march(esdf, p_WQ[patch[some]], rays, lengths) >= lengths
    return stop[free], patch[free]


def _candidates(
    stops: NDArray, stop: NDArray, toward: NDArray, K: NDArray, size: tuple[int, int]
) -> list[tuple[RigidTransform, NDArray[np.intp]]]:
    """Returns the poses of cameras at the stops, and the lines of sight (n,) that each sees."""
    order = np.argsort(stop, kind="stable")
    edges = np.searchsorted(stop[order], np.arange(len(stops) + 1))
    candidates = []
    for yaw in _YAWS:
        for pitch in _PITCHES:
            R_WC = look_along(np.zeros(3), yaw, pitch).rotation().matrix()
            x, y, z = (-toward @ R_WC).T
            u, v = project(K, x, y, z)
            seen = (z > 0) & (u >= 0) & (v >= 0) & (u <= size[0]) & (v <= size[1])
            for k, p_WC in enumerate(stops):
                lines = order[edges[k] : edges[k + 1]]
                lines = lines[seen[lines]]
                if len(lines):
                    candidates.append((look_along(p_WC, yaw, pitch), lines))
    return candidates


def _cover(
    candidates: list[tuple[RigidTransform, NDArray[np.intp]]],
    patch: NDArray[np.intp],
    direction: NDArray[np.intp],
    required: NDArray[np.intp],
    max_frames: int,
) -> tuple[list[int], int]:
    """Returns at most `max_frames` candidates that are worth it, and the number of the others."""
    missing, has = required.copy(), np.zeros((len(required), 27), dtype=bool)
    # Gains only shrink: a candidate whose present gain is the largest bound is the best.
    queue = [(-len(lines), index) for index, (_, lines) in enumerate(candidates)]
    heapq.heapify(queue)
    worth = max(3.0, -_WORTH * queue[0][0]) if queue else 0.0
    chosen = []
    while queue and -queue[0][0] >= worth:
        _, index = heapq.heappop(queue)
        lines = candidates[index][1]
        lines = lines[(missing[patch[lines]] > 0) & ~has[patch[lines], direction[lines]]]
        if queue and len(lines) < -queue[0][0]:
            heapq.heappush(queue, (-len(lines), index))
            continue
        chosen.append(index)
        has[patch[lines], direction[lines]] = True
        np.subtract.at(missing, patch[lines], 1)
    return chosen[:max_frames], len(chosen[max_frames:])


def _in_order(X_WCs: list[RigidTransform]) -> list[RigidTransform]:
    """Returns poses in the order of a path that continues to the nearest one not yet visited."""
    if not X_WCs:
        return []
    p_WC = np.array([X_WC.translation() for X_WC in X_WCs])
    left, order = np.ones(len(X_WCs), dtype=bool), [int(p_WC.sum(axis=1).argmin())]
    left[order[0]] = False
    while left.any():
        distance = np.where(left, np.linalg.norm(p_WC - p_WC[order[-1]], axis=1), np.inf)
        order.append(int(distance.argmin()))
        left[order[-1]] = False
    return [X_WCs[k] for k in order]


_STEP = 0.05  # [m], of a path while it is smoothed
_ROUNDING = 0.4  # [m], standard deviation of the smoothing of corners


def poses_along(
    path: NDArray[np.float64], spacing: float, yaws: Sequence[float], pitch: float
) -> list[RigidTransform]:
    """Returns the poses X_WC of a camera that stops every `spacing` [m] on a path (N, 3) [m], with
    rounded corners, and turns to `yaws` [deg], to the left from the direction of travel, at a
    `pitch` [deg], upward. A single point is one stop that travels along x."""
    path = np.asarray(path, dtype=np.float64)
    valid = path.ndim == 2 and path.shape[1] == 3 and len(path) and np.isfinite(path).all()
    require(valid, "path", "of finite points x, y, z", f"shape {path.shape}")
    p_WP = resample(path, _STEP)
    if len(p_WP) > 1:
        # Padded point-symmetrically, so that the ends do not move.
        more = min(len(p_WP) - 1, int(4 * _ROUNDING / _STEP))
        p_WP = np.pad(p_WP, ((more, more), (0, 0)), mode="reflect", reflect_type="odd")
        p_WP = gaussian_filter1d(p_WP, _ROUNDING / _STEP, axis=0)[more : len(p_WP) - more]
    p_WP = resample(p_WP, spacing)
    tangent = np.gradient(p_WP, axis=0) if len(p_WP) > 1 else np.array([[1.0, 0, 0]])
    # On climbs the heading stays.
    level = np.linalg.norm(tangent[:, :2], axis=1) > 0.1 * np.linalg.norm(tangent, axis=1)
    last = np.maximum.accumulate(np.where(level, np.arange(len(tangent)), 0))
    headings = np.arctan2(tangent[last, 1], tangent[last, 0])
    return [
        look_along(p, heading + np.deg2rad(yaw), np.deg2rad(pitch))
        for p, heading in zip(p_WP, headings, strict=True)
        for yaw in yaws
    ]


def look_along(p_WC: NDArray[np.float64], yaw: float, pitch: float) -> RigidTransform:
    """Returns the pose X_WC of an upright camera that looks along yaw and up by pitch [rad]."""
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    return RigidTransform(
        RotationMatrix(np.column_stack([right, np.cross(ahead, right), ahead])), p_WC
    )


def resample(path: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Returns points of a polyline, evenly spaced by about `spacing` [m], ends included."""
    lengths = np.append(0.0, np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum())
    if lengths[-1] == 0:
        return path[:1]
    desired = np.linspace(0, lengths[-1], max(round(lengths[-1] / spacing), 1) + 1)
    return np.stack([np.interp(desired, lengths, column) for column in path.T], axis=1)
