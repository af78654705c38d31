"""Distance fields on a grid from other distance fields."""

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
    # Cubes of voxels rather than slices: fields find the nearest of many shapes faster for points
    # that lie close together.
    cube = 8
    for i in range(0, shape[0], cube):
        for j in range(0, shape[1], cube):
            for k in range(0, shape[2], cube):
                part = np.s_[i : i + cube, j : j + cube, k : k + cube]
                p_WQ = np.stack(np.meshgrid(x[part[0]], y[part[1]], z[part[2]], indexing="ij"), -1)
                sample = field.query(p_WQ)
                distances[part], states[part] = sample.distance, sample.state
    return Esdf(distances, states, lower_W, voxel_size)
