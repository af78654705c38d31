"""The surface that closes a captured place where nobody looked any further."""

import functools
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.diagrams.worlds.solids.surfaces import Surfels, to_gaussians
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import bounds_of_depth_images, esdf_from_depth_images
from splatpilot.systems.collision.frontier import (
    frontier_faces,
    hidden_frontier,
    reachable_space,
    with_obstacles,
)
from splatpilot.systems.splats.background import FAR
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS

_CELL = 2
"""[-] Voxels along the edge of the cells whose faces one surfel covers."""

_SUNK = 0.5
"""[-] Voxels from the faces into what is hidden, so that no edge of a surfel hangs out of it."""

_COVERAGE = 0.55
"""Standard deviation of a surfel over the edge of its square. Less than in generated worlds, whose
patches may hang over edges a little more: here that would hide what was captured."""

_WIDTH = 160
"""[px], about as wide depth images are thinned to."""

_FAR_VOXEL, _FAR_VOXELS = 2, 2e6
"""[-] Edge of the voxels in which the frontier beyond the field's range is found, in voxels of the
field, and how many there may be."""

_STRIPE = 0.4
"""[m], period of the hatching along each axis."""

_SHADES = np.array([0.62, 0.42])
"""Grey of its two tones, 0 to 1."""


def close_frontier(
    esdf: Esdf, depths: Iterable[np.ndarray], K: np.ndarray, X_WCs: Sequence[RigidTransform]
) -> tuple[Esdf, GaussianScene | None]:
    """Closes a captured scene where space that the vehicle can look into ends in unknown space.

    Without it nothing would be seen there, and flights would end all the same. What nobody looked
    into begins with obstacles, and hatched surfels are drawn on them. Space before the sky, and
    before what was captured beyond the field's range, stays open. There the surfels begin where
    the images saw no farther, on a coarse grid of its own: none hides what was captured.

    Args:
        esdf: the distance field of the scene.
        depths, K, X_WCs: what it was made of, see `esdf_from_depth_images`.

    Returns:
        The distance field with these obstacles, and the surfels; `esdf` and None where there is
        nothing to close.
    """
    images = []
    for depth in depths:
        step = max(depth.shape[1] // _WIDTH, 1)
        images.append(depth[step // 2 :: step, step // 2 :: step])
        if len(images) == 1:
            K = np.diag([1 / step, 1 / step, 1.0]) @ K
    views = images, K, X_WCs
    hidden, before, beyond = hidden_frontier(esdf, reachable_space(esdf, VEHICLE_RADIUS), *views)
    parts = []
    if hidden.any():
        parts.append(_draw(esdf, *frontier_faces(before, hidden)))
    if beyond:
        parts.append(_far_frontier(_FAR_VOXEL * esdf.voxel_size, *views))
    if not parts:
        return esdf, None
    return with_obstacles(esdf, hidden), functools.reduce(GaussianScene.merged_with, parts)


def _far_frontier(
    voxel_size: float, images: Sequence[np.ndarray], K: np.ndarray, X_WCs: Sequence[RigidTransform]
) -> GaussianScene:
    """Draws the frontier of all that images show, on a grid of at least `voxel_size` [m]."""
    reach = 2.0 * max(float(image[image < FAR].max(initial=0.0)) for image in images)  # [m]
    lower_W, upper_W = bounds_of_depth_images(images, K, X_WCs, reach)
    voxel_size = max(voxel_size, float(np.cbrt(np.prod(upper_W - lower_W) / _FAR_VOXELS)))
    far = esdf_from_depth_images(images, K, X_WCs, lower_W, upper_W, voxel_size, reach)
    reachable = reachable_space(far, VEHICLE_RADIUS)
    hidden, before, _ = hidden_frontier(far, reachable, images, K, X_WCs)
    return _draw(far, *frontier_faces(before, hidden))


def _draw(esdf: Esdf, centers: NDArray[np.float64], normals: NDArray[np.float64]) -> GaussianScene:
    """Faces of voxels (F, 3), (F, 3), see `frontier_faces`, as surfels: one for those in each cell,
    of their mean and their spread, so that it lies across the steps of a slanted frontier."""
    _, cell = np.unique((centers // _CELL).astype(int), axis=0, return_inverse=True)
    count = np.bincount(cell)

    def mean(values: NDArray) -> NDArray[np.float64]:
        return np.bincount(cell, values) / count

    middle, normal = (np.stack([mean(x) for x in v.T], axis=-1) for v in (centers, normals))
    offset = centers - middle[cell]
    covariance = np.empty((len(count), 3, 3))
    for i in range(3):
        for j in range(3):
            covariance[:, i, j] = mean(offset[:, i] * offset[:, j])
        covariance[:, i, i] += mean(normals[:, i] == 0.0) / 12.0  # of faces along axis i
    variance, R_WP = np.linalg.eigh(covariance)  # ascending
    p = esdf.lower_W + esdf.voxel_size * (middle - _SUNK * normal)
    # A square of edge a has the deviation a / sqrt(12); a surfel of _COVERAGE a covers it.
    extent = _COVERAGE * np.sqrt(12.0 * variance[:, [2, 1]]) * esdf.voxel_size
    surfels = Surfels(p, R_WP[:, :, 0], R_WP[:, :, 2], extent)
    shade = _SHADES[np.floor(2.0 * p.sum(axis=1) / _STRIPE).astype(int) % 2]
    return to_gaussians(surfels, np.repeat(shade[:, None], 3, axis=1), 0.99)
