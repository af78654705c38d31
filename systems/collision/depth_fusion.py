"""Fusion of depth images into truncated signed distances on a grid (Curless and Levoy 1996)."""

import itertools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from pydrake.math import RigidTransform
from scipy.ndimage import distance_transform_edt

from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy, grid_shape
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.lens import pixel_slopes

_BLOCK = 8  # [voxels] edge of a block, the unit in which invisible space is skipped
_CHUNK = 1024  # blocks fused at once
_MIN_COSINE = 0.15  # of incidence
_MARGIN = 0.2  # [m] around all cameras and points seen
_MAX_DEPTH_BEHIND = 2.0  # [truncations] behind a surface in which a pixel counts


class DepthFusion:
    """Weighted averages of truncated signed distances, kept in blocks of _BLOCK^3 voxels."""

    def __init__(self, lower_W: np.ndarray, upper_W: np.ndarray, voxel_size: float) -> None:
        self.shape = grid_shape(lower_W, upper_W, voxel_size)
        self.truncation = 3.0 * voxel_size
        self.blocks = tuple(-(-n // _BLOCK) for n in self.shape)
        count = int(np.prod(self.blocks))
        self.weighted = np.zeros((count, _BLOCK**3), dtype=np.float32)  # sum of weight * distance
        self.weight = np.zeros((count, _BLOCK**3), dtype=np.float32)
        edge = _BLOCK * voxel_size
        block = np.stack(np.unravel_index(np.arange(count), self.blocks), -1)
        voxel = np.stack(np.unravel_index(np.arange(_BLOCK**3), (_BLOCK,) * 3), -1)
        self.block_center_W = np.asarray(lower_W, float) + (block + 0.5) * edge  # (B, 3) [m]
        self.from_center_W = (voxel + 0.5) * voxel_size - 0.5 * edge  # (_BLOCK^3, 3) [m]
        self.block_radius = 0.5 * np.sqrt(3.0) * edge

    def add(self, depth: np.ndarray, K: np.ndarray, X_WC: RigidTransform, max_range: float) -> None:
        """Fuses a depth image (H, W) [m], 0 where unknown."""
        R_CW = X_WC.rotation().matrix().T
        center_C = (self.block_center_W - X_WC.translation()) @ R_CW.T  # (B, 3)
        from_center_C = (self.from_center_W @ R_CW.T).astype(np.float32)
        visible = self.visible_blocks(depth, K, center_C, max_range)
        cosine = _cosine_of_incidence(depth, K).ravel()
        height, width = depth.shape
        depth = depth.ravel()
        truncation = np.float32(self.truncation)
        for start in range(0, len(visible), _CHUNK):
            block = visible[start : start + _CHUNK]
            center = center_C[block].astype(np.float32)
            x, y, z = (center[:, axis, None] + from_center_C[:, axis] for axis in range(3))
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                column = x * (np.float32(K[0, 0]) / z) + np.float32(K[0, 2])
                row = y * (np.float32(K[1, 1]) / z) + np.float32(K[1, 2])
            seen = (z > 0.0) & (x * x + y * y + z * z <= max_range**2)
            seen &= (column >= 0.0) & (column < width) & (row >= 0.0) & (row < height)
            pixel = np.where(seen, row, 0.0).astype(np.intp) * width
            pixel += np.where(seen, column, 0.0).astype(np.intp)
            surface, weight = depth.take(pixel), cosine.take(pixel)
            before = surface - z
            distance = np.minimum(before * weight, truncation)
            seen &= (surface > 0.0) & (distance >= -truncation)
            # Far behind a grazing tangent plane is not behind the surface any more.
            seen &= before >= np.float32(-_MAX_DEPTH_BEHIND) * truncation
            weight *= seen
            self.weight[block] += weight
            distance *= weight
            self.weighted[block] += distance

    def grids(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the average distance (nx, ny, nz) [m] and the mask where it exists."""
        seen = self.weight > 0.0
        np.divide(self.weighted, self.weight, out=self.weighted, where=seen)
        return self._as_grid(self.weighted), self._as_grid(seen)

    def _as_grid(self, values: np.ndarray) -> np.ndarray:
        bx, by, bz = self.blocks
        nx, ny, nz = self.shape
        values = values.reshape(bx, by, bz, _BLOCK, _BLOCK, _BLOCK).transpose(0, 3, 1, 4, 2, 5)
        values = values.reshape(bx * _BLOCK, by * _BLOCK, bz * _BLOCK)
        return np.ascontiguousarray(values[:nx, :ny, :nz])

    def visible_blocks(
        self, depth: np.ndarray, K: np.ndarray, center_C: np.ndarray, max_range: float
    ) -> np.ndarray:
        """Returns the indices of the blocks that may hold a voxel in view.

        The sphere about a block covers at most 2 x 2 pixels at some level of a pyramid of maximum
        depths.
        """
        radius = self.block_radius
        near = center_C[:, 2] - radius
        in_range = np.linalg.norm(center_C, axis=1) < max_range + radius
        possible = np.flatnonzero((center_C[:, 2] + radius > 0.0) & in_range)
        near, z = near[possible], center_C[possible, 2]
        first, last = [], []  # [px] of the sphere in the image, columns and rows
        # In the plane z > 0 the sphere lies between rays of slope (x +- s) / z; one that reaches
        # behind the camera may cover any pixel.
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.where(near > 0.0, radius / near, np.inf)
            for axis, size in enumerate(depth.shape[::-1]):
                x, f = center_C[possible, axis], K[axis, axis]
                spread = f * reach * np.sqrt(1.0 + (x / z) ** 2)
                middle = f * x / z + K[axis, 2]
                around = near <= 0.0
                first.append(np.where(around, 0.0, np.clip(middle - spread, 0.0, size)))
                last.append(np.where(around, size, np.clip(middle + spread, 0.0, size)))
        first, last = np.array(first), np.array(last)  # (2, N)
        in_view = (last > first).all(axis=0)
        possible, near = possible[in_view], near[in_view]
        sides = np.stack([first, last])[..., in_view]  # (2, 2, N)
        level = np.ceil(np.log2(np.maximum((sides[1] - sides[0]).max(axis=0), 1.0))).astype(int)
        seen = np.zeros(len(possible), dtype=bool)
        farthest = depth
        for k in range(int(level.max(initial=0)) + 1):
            some = np.flatnonzero(level == k)
            end = np.array(farthest.shape)[::-1, None] - 1
            columns, rows = np.minimum(sides[..., some] / 2**k, end).astype(int).swapaxes(0, 1)
            for row, column in itertools.product(rows, columns):
                deepest = farthest[row, column] + _MAX_DEPTH_BEHIND * self.truncation
                seen[some] |= near[some] < deepest
            farthest = _halve(farthest)
        return possible[seen]


def _halve(image: np.ndarray) -> np.ndarray:
    """Computes the maximum over squares of 2 x 2 pixels, ((H + 1) // 2, (W + 1) // 2)."""
    image = np.pad(image, [(0, n % 2) for n in image.shape])
    image = np.maximum(image[::2], image[1::2])
    return np.maximum(image[:, ::2], image[:, 1::2])


def _cosine_of_incidence(depth: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Computes n . (u, v, 1) at each pixel: n is the surface's unit normal, (u, v, 1) the ray.

    In normalized image coordinates (u, v) a plane n . X = c has the inverse depth
    w = n . (u, v, 1) / c, so n / c = (w_u, w_v, w - u w_u - v w_v). The smaller slope to a neighbor
    along each axis stays on the pixel's own surface at a silhouette. At least _MIN_COSINE.
    """
    valid = (depth > 0.0) & np.isfinite(depth)
    w = np.where(valid, 1.0 / np.where(valid, depth, 1.0), np.float32(np.nan)).astype(np.float32)
    u, v = np.moveaxis(pixel_slopes(None, K, *depth.shape[::-1]).astype(np.float32), -1, 0)

    def slope(axis: int, focal_length: float) -> np.ndarray:
        missing = np.full_like(w.take([0], axis), np.nan)
        step = np.diff(w, axis=axis) * np.float32(focal_length)
        ahead = np.concatenate([step, missing], axis)
        behind = np.concatenate([missing, step], axis)
        ahead = np.where(np.isnan(ahead), behind, ahead)
        return np.where(np.abs(behind) < np.abs(ahead), behind, ahead)

    w_u, w_v = slope(1, K[0, 0]), slope(0, K[1, 1])
    length = np.sqrt(w_u**2 + w_v**2 + (w - u * w_u - v * w_v) ** 2)
    return np.fmax(w / length, np.float32(_MIN_COSINE))


def esdf_from_depth_images(
    depths: Iterable[np.ndarray],
    K: np.ndarray,
    X_WCs: Sequence[RigidTransform],
    lower_W: np.ndarray,
    upper_W: np.ndarray,
    voxel_size: float,
    max_range: float = 8.0,
    swept_radius: float = 0.0,
) -> Esdf:
    """Fuses depth images into a distance field that marks unobserved space.

    Signed distances to the tangent planes of surfaces are truncated, and averaged with the cosine
    of incidence as weight (Curless and Levoy 1996). A voxel is FREE if on average before a surface,
    OCCUPIED at most 3 voxels behind one or an edge, UNKNOWN if no image saw it.

    Args:
        depths: images (H, W) float [m], planar depth; 0, NaN and negative pixels are unknown,
            infinite ones free space, as before the sky. Held in memory one at a time.
        K: (3, 3) intrinsics [px]; pixel centers lie at +1/2.
        X_WCs: the camera's pose of each image (x right, y down, z forward).
        lower_W, upper_W: (3,) [m], the box to fill, see `bounds_of_depth_images`.
        max_range: [m] of seen space; a surface beyond it still clears the space before it.
        swept_radius: unobserved space within this distance of the cameras' path is FREE [m].
    """
    fusion = DepthFusion(lower_W, upper_W, voxel_size)
    for depth, X_WC in _pair(depths, K, X_WCs, max_range, "fusing depth"):
        fusion.add(depth, np.asarray(K, dtype=float), X_WC, max_range)
    distance, seen = fusion.grids()
    unknown = ~seen
    if swept_radius > 0.0:
        unknown &= ~swept_space(X_WCs, lower_W, fusion.shape, voxel_size, swept_radius)
    occupied = seen & (distance <= 0.0)
    offset = np.where(seen, distance, np.float32(np.nan))
    return esdf_from_occupancy(occupied, unknown, lower_W, voxel_size, offset)


def swept_space(
    X_WCs: Sequence[RigidTransform],
    lower_W: np.ndarray,
    shape: Sequence[int],
    voxel_size: float,
    radius: float,
) -> np.ndarray:
    """Returns the voxels (nx, ny, nz) within `radius` [m] of the path of a camera. Poses farther
    apart than twice the radius are not connected: the path between them is unknown."""
    p_WCs = np.array([X_WC.translation() for X_WC in X_WCs])
    points = [p_WCs]
    for a, b in itertools.pairwise(p_WCs):
        if voxel_size < (length := float(np.linalg.norm(b - a))) <= 2.0 * radius:
            s = np.linspace(0.0, 1.0, 1 + int(np.ceil(length / voxel_size)))[1:-1, None]
            points.append(a + s * (b - a))
    away = np.ones(tuple(shape), dtype=bool)
    index = np.floor((np.concatenate(points) - lower_W) / voxel_size).astype(int)
    index = index[((index >= 0) & (index < shape)).all(axis=1)]
    away[tuple(index.T)] = False
    if not len(index):
        return ~away
    return np.asarray(distance_transform_edt(away, sampling=voxel_size)) <= radius


def bounds_of_depth_images(
    depths: Iterable[np.ndarray],
    K: np.ndarray,
    X_WCs: Sequence[RigidTransform],
    max_range: float = 8.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the corners (3,) [m] of the box of all cameras and points seen, and 0.2 m around it.

    Takes every fourth pixel along both axes; see `esdf_from_depth_images`.
    """
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    for depth, X_WC in _pair(depths, K, X_WCs, max_range, "bounding depth"):
        z = np.where(np.isfinite(depth), depth, 0.0)[::4, ::4]
        slopes = pixel_slopes(None, K, *depth.shape[::-1])[::4, ::4]
        ray = np.dstack([slopes, np.ones_like(z)])
        reach = np.minimum(z, max_range / np.linalg.norm(ray, axis=-1))
        p_CQ = (reach[..., None] * ray)[z > 0.0]
        p_WQ = p_CQ @ X_WC.rotation().matrix().T + X_WC.translation()
        points = np.concatenate([p_WQ, X_WC.translation()[None]])
        lower = np.minimum(lower, points.min(axis=0))
        upper = np.maximum(upper, points.max(axis=0))
    return lower - _MARGIN, upper + _MARGIN


def _pair(
    depths: Iterable[np.ndarray],
    K: np.ndarray,
    X_WCs: Sequence[RigidTransform],
    max_range: float,
    what: str,
) -> Iterator[tuple[np.ndarray, RigidTransform]]:
    """Pairs images, unknown pixels set to 0, with poses; checks all and shows progress."""
    require(0.0 < max_range < np.inf, "max_range", "in (0, inf) m", max_range)
    matrix = np.asarray(K, dtype=float)
    valid = matrix.shape == (3, 3) and np.isfinite(matrix).all() and np.diag(matrix)[:2].min() > 0.0
    require(valid, "K", "a finite (3, 3) matrix with positive focal lengths [px]", matrix.tolist())
    shape, count = None, 0
    for depth in Progress(depths, desc=what, total=len(X_WCs), unit="image", delay=2.0):
        depth = np.asarray(depth, dtype=np.float32)
        shape = depth.shape if shape is None else shape
        valid = depth.ndim == 2 and depth.shape == shape
        require(valid, f"shape of depth image {count}", f"(H, W), the first's {shape}", depth.shape)
        if count < len(X_WCs):
            yield np.where(depth > 0.0, depth, np.float32(0.0)), X_WCs[count]
        count += 1
    require(count == len(X_WCs) and count, "depth images", f"one per pose, {len(X_WCs)}", count)
