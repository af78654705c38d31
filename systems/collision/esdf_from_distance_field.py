"""Distance fields on a grid from other distance fields."""

from collections.abc import Iterator

import numpy as np

from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_from_occupancy import grid_shape


def esdf_from_distance_field(field: DistanceField, voxel_size: float) -> Esdf:
    """Samples a distance field at the voxel centres of a grid over its bounds.

    The values are the field's own, so exact at the centres for an analytic field. The grid covers
    the bounds with whole voxels; centres beyond the field's bounds take the value of the nearest
    point inside. States are the field's own.

    Raises:
        ValueError: see `grid_shape`.
    """
    lower_W, upper_W = np.asarray(field.lower_W, float), np.asarray(field.upper_W, float)
    shape = grid_shape(lower_W, upper_W, voxel_size)
    distances = np.empty(shape, dtype=np.float32)
    states = np.empty(shape, dtype=np.uint8)
    x, y, z = (
        np.minimum(lower + voxel_size * (np.arange(n) + 0.5), upper)
        for lower, upper, n in zip(lower_W, upper_W, shape, strict=True)
    )
    for part, p_WQ in cubes_of_points(x, y, z):
        sample = field.query(p_WQ)
        distances[part], states[part] = sample.distance, sample.state
    return Esdf(distances, states, lower_W, voxel_size)


def cubes_of_points(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, edge: int = 16
) -> Iterator[tuple[tuple[slice, slice, slice], np.ndarray]]:
    """The points of the grid x (nx,), y (ny,), z (nz,) in cubes of `edge` points a side: the part
    of the grid that a cube is, and its points (n, n, n, 3).

    Fields find the nearest of many shapes faster for points that lie close together.
    """
    for i in range(0, len(x), edge):
        for j in range(0, len(y), edge):
            for k in range(0, len(z), edge):
                part = np.s_[i : i + edge, j : j + edge, k : k + edge]
                axes = np.meshgrid(x[part[0]], y[part[1]], z[part[2]], indexing="ij")
                yield part, np.stack(axes, axis=-1)
