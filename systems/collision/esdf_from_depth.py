"""Distance fields from depth images with poses: fusion of truncated signed distances."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.systems.collision.depth_fusion import DepthFusion, ray_slopes
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_from_occupancy import esdf_from_occupancy
from splatpilot.systems.progress import Progress


def esdf_from_depth_images(
    depths: Iterable[np.ndarray],
    K: np.ndarray,
    X_WCs: Sequence[RigidTransform],
    lower_W: np.ndarray,
    upper_W: np.ndarray,
    voxel_size: float,
    max_range: float = 8.0,
    truncation: float | None = None,
) -> Esdf:
    """Fuses depth images into a distance field that knows what was never seen.

    Each image gives the voxels it sees a signed distance to the surface along the optical axis,
    turned into the distance to the surface's tangent plane by the surface's slope in the image,
    truncated at `truncation` and averaged over the images with the cosine of incidence as weight
    (Curless and Levoy 1996). A voxel is FREE when on average before a surface, OCCUPIED when at
    most `truncation` behind one, UNKNOWN when no image saw it. The average places the surface
    within the voxels, see `esdf_from_occupancy`. Against analytic rooms and on a real capture the
    field near surfaces is unbiased to 0.04 voxel, rms 0.09 to 0.16. What hides less than
    `truncation` behind an edge counts as occupied until another image clears it, which is safe.

    Args:
        depths: images (H, W) float [m], planar depth along the optical axis; 0, NaN and negative
            pixels say nothing, infinite ones that nothing stands in the way, as before the sky. One
            at a time is held in memory.
        K: (3, 3) intrinsics [px]; pixel (row i, column j) is centred at (j + 0.5, i + 0.5).
        X_WCs: the camera's pose of each image (x right, y down, z forward).
        lower_W, upper_W: (3,) [m], the box to fill, see `bounds_of_depth_images`.
        voxel_size: [m].
        max_range: distance from the camera up to which space is seen [m]; a surface beyond it still
            clears the space before it.
        truncation: thickness given to surfaces [m], by default 3 voxels.

    Raises:
        ValueError: for different numbers of images and poses, no images, images of different
            shapes, intrinsics without focal length, ranges that are not positive, a truncation
            below 2 voxels or a box that makes no grid (see `grid_shape`).
    """
    truncation = 3.0 * voxel_size if truncation is None else truncation
    if not truncation >= 2.0 * voxel_size:
        raise ValueError(
            f"esdf_from_depth_images: the truncation is {truncation} m; it must be at least 2 "
            f"voxels, {2.0 * voxel_size} m, or surfaces fall through the grid."
        )
    fusion = DepthFusion(lower_W, upper_W, voxel_size, truncation)
    for depth, X_WC in _pair(depths, X_WCs, "fusing depth"):
        fusion.add(depth, _require_intrinsics(K), X_WC, _require_range(max_range))
    distance, seen = fusion.grids()
    occupied = seen & (distance <= 0.0)
    offset = np.where(seen, distance, np.float32(np.nan))
    return esdf_from_occupancy(occupied, ~seen, lower_W, voxel_size, offset)


def bounds_of_depth_images(
    depths: Iterable[np.ndarray],
    K: np.ndarray,
    X_WCs: Sequence[RigidTransform],
    max_range: float = 8.0,
    margin: float = 0.2,
) -> tuple[np.ndarray, np.ndarray]:
    """The box that holds all points seen within `max_range` [m] and all cameras, and a margin [m].

    Takes every fourth pixel along both axes; arguments as for `esdf_from_depth_images`.

    Returns:
        lower_W, upper_W: (3,) each [m].
    """
    max_range, K = _require_range(max_range), _require_intrinsics(K)
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    for depth, X_WC in _pair(depths, X_WCs, "bounding depth"):
        z = np.where(np.isfinite(depth), depth, 0.0)[::4, ::4]
        x, y = np.meshgrid(*(slopes[::4] for slopes in ray_slopes(depth.shape, K)))
        ray = np.stack([x, y, np.ones_like(x)], -1)
        reach = np.minimum(z, max_range / np.linalg.norm(ray, axis=-1))
        p_CQ = (reach[..., None] * ray)[z > 0.0]
        p_WQ = p_CQ @ X_WC.rotation().matrix().T + X_WC.translation()
        for points in (p_WQ, X_WC.translation()[None]):
            if len(points):
                lower = np.minimum(lower, points.min(axis=0))
                upper = np.maximum(upper, points.max(axis=0))
    return lower - margin, upper + margin


def _pair(
    depths: Iterable[np.ndarray], X_WCs: Sequence[RigidTransform], what: str
) -> Iterator[tuple[np.ndarray, RigidTransform]]:
    """Pairs images, pixels that say nothing set to 0, with poses; checks and shows progress."""
    shape, count = None, 0
    for depth in Progress(depths, desc=what, total=len(X_WCs), unit="image", delay=2.0):
        depth = np.asarray(depth, dtype=np.float32)
        shape = depth.shape if shape is None else shape
        if depth.ndim != 2 or depth.shape != shape:
            raise ValueError(
                f"depth image {count} has shape {depth.shape}; needed is (H, W), the same for all "
                f"images (the first has {shape})."
            )
        if count < len(X_WCs):
            yield np.where(depth > 0.0, depth, np.float32(0.0)), X_WCs[count]
        count += 1
    if count != len(X_WCs) or count == 0:
        raise ValueError(
            f"{len(X_WCs)} poses for {count} depth images; needed is one pose for each image, and "
            "at least one image."
        )


def _require_intrinsics(K: np.ndarray) -> np.ndarray:
    K = np.asarray(K, dtype=float)
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0.0 or K[1, 1] <= 0.0:
        raise ValueError(
            f"depth images: the intrinsics are {K.tolist()}; needed is a finite (3, 3) matrix with "
            "positive focal lengths [px]."
        )
    return K


def _require_range(max_range: float) -> float:
    if not (np.isfinite(max_range) and max_range > 0.0):
        raise ValueError(f"depth images: max_range is {max_range} m; it must be positive.")
    return max_range
