"""Paths of a camera through free space, and the poses on them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.ndimage import gaussian_filter1d
from scipy.sparse.csgraph import connected_components, dijkstra

from splatpilot.diagrams.worlds.feasibility import grid_graph
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.validation import require

_STEP = 0.05  # [m], of a path while it is smoothed
_ROUNDING = 0.4  # [m], standard deviation of the smoothing of corners


def visiting_path(
    esdf: Esdf,
    lower_W: NDArray[np.float64],
    upper_W: NDArray[np.float64],
    clearance: float,
    apart: float,
) -> NDArray[np.float64]:
    """Returns a path (N, 3) [m] that visits all the free space of a box.

    In the largest connected part of the space with `clearance` [m], stops are chosen farthest from
    those before, along paths, until none is farther than `apart` [m] from one. The path begins at
    the stop in the middle, so that later cameras see its surroundings too, and continues to the
    nearest stop not visited yet, by shortest paths.
    """
    spacing = max(esdf.voxel_size, 0.2)
    axes = [
        low + spacing * (np.arange(max(int((high - low) / spacing), 1)) + 0.5)
        for low, high in zip(lower_W, upper_W, strict=True)
    ]
    p_WN = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)  # (nx, ny, nz, 3)
    found = esdf.conservative().distance(p_WN)
    if np.count_nonzero(found > clearance) < 2:
        raise ValueError(
            f"no camera path: the largest clearance from {np.round(lower_W, 1).tolist()} to "
            f"{np.round(upper_W, 1).tolist()} is {found.max():.2f} m, {clearance} m is required; "
            "require less clearance, or allow other heights"
        )
    graph, nodes = grid_graph(found > clearance, spacing)
    p_WF = p_WN.reshape(-1, 3)[nodes]
    _, label = connected_components(graph, directed=False)
    part = label == np.bincount(label).argmax()

    def lengths_from(node: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        lengths, before = dijkstra(graph, directed=False, indices=node, return_predecessors=True)
        lengths[~part] = -1
        return lengths, before

    stops = [int(np.argmax(lengths_from(int(np.argmax(part)))[0]))]
    tables = [lengths_from(stops[0])]
    nearest = tables[0][0].copy()
    while nearest.max() > apart:
        stops.append(int(np.argmax(nearest)))
        tables.append(lengths_from(stops[-1]))
        np.minimum(nearest, tables[-1][0], out=nearest)

    here = min(range(len(stops)), key=lambda k: tables[k][0].max())
    path, left = [stops[here]], set(range(len(stops))) - {here}
    while left:
        lengths, before = tables[here]
        here = min(left, key=lambda k: (lengths[stops[k]], k))
        leg = [stops[here]]
        while leg[-1] != path[-1]:
            leg.append(int(before[leg[-1]]))
        path += leg[-2::-1]
        left.remove(here)
    return p_WF[path]


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


def move_left(X_WC: RigidTransform, offset: float) -> RigidTransform:
    """Returns the pose moved by `offset` [m] to the camera's left, looking where it looked."""
    return RigidTransform(
        X_WC.rotation(), X_WC.translation() - offset * X_WC.rotation().matrix()[:, 0]
    )


def resample(path: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Returns points of a polyline, evenly spaced by about `spacing` [m], ends included."""
    lengths = np.append(0.0, np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum())
    if lengths[-1] == 0:
        return path[:1]
    desired = np.linspace(0, lengths[-1], max(round(lengths[-1] / spacing), 1) + 1)
    return np.stack([np.interp(desired, lengths, column) for column in path.T], axis=1)
