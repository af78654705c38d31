import tracemalloc

import numpy as np
import pytest
from scipy.ndimage import label
from scipy.spatial.transform import Rotation

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf_build import (
    MAX_VOXELS,
    density_on_grid,
    esdf_from_distance_field,
    esdf_from_gaussians,
    esdf_from_occupancy,
    grid_shape,
)
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Cylinder, HalfSpace
from splatpilot.systems.splats.scene import GaussianScene

VOXEL = 0.1


def gaussians(means, quats, scales, opacities) -> GaussianScene:
    colors = np.full((len(means), 3), 0.5)
    return GaussianScene.from_colors(means, quats, scales, opacities, colors)


def shell(radius: float = 1.2, spacing: float = 0.06, opacity: float = 0.9) -> GaussianScene:
    """A sphere of flat Gaussians that lie in its surface."""
    n = int(4.0 * np.pi * radius**2 / spacing**2)
    i = np.arange(n) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * i / n), np.pi * (1.0 + 5.0**0.5) * i
    normal = np.stack(
        [np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], -1
    )
    quats = np.c_[1.0 + normal[:, 2], np.cross([0.0, 0.0, 1.0], normal)]
    scales = np.tile([spacing, spacing, 0.004], (n, 1))
    return gaussians(radius * normal, quats, scales, np.full(n, opacity))


def test_density_is_the_sum_of_all_gaussians():
    random = np.random.default_rng(0)
    n, shape = 60, (24, 18, 15)
    means = random.uniform(-0.3, [2.7, 2.1, 1.8], (n, 3))
    quats = Rotation.random(n, rng=np.random.default_rng(1)).as_quat(scalar_first=True)
    scales = np.exp(random.normal(-2.0, 0.7, (n, 3)))
    scene = gaussians(means, quats, scales, random.uniform(0.1, 1.0, n))
    p = VOXEL * (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1) + 0.5)
    expected = np.zeros(shape)
    for mean, quat, scale, opacity in zip(
        scene.means, scene.quats, scene.scales, scene.opacities, strict=True
    ):
        R = Rotation.from_quat(quat, scalar_first=True).as_matrix()
        covariance = R @ np.diag(np.square(scale, dtype=float) + (VOXEL / 2) ** 2) @ R.T
        squared = np.einsum("...i,ij,...j", p - mean, np.linalg.inv(covariance), p - mean)
        expected += np.where(squared < 3.5**2, opacity * np.exp(-0.5 * squared), 0.0)
    density = density_on_grid(scene, np.zeros(3), shape, VOXEL)
    # A voxel on the rim of a Gaussian's support may fall on either side of it.
    error = np.abs(density - expected)
    assert np.count_nonzero(error > 1e-5) <= 3
    assert error.max() < 0.003


def test_memory_does_not_grow_with_the_size_of_a_gaussian():
    scene = gaussians([[8.0, 8.0, 8.0]], [[1.0, 0.0, 0.0, 0.0]], [[10.0] * 3], [0.8])
    tracemalloc.start()
    density = density_on_grid(scene, np.zeros(3), (160, 160, 160), VOXEL)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 400e6
    assert density[80, 80, 80] == pytest.approx(0.8, abs=1e-4)
    far = 0.5 * 3 * (7.95 / 10) ** 2
    assert density[0, 0, 0] == pytest.approx(0.8 * np.exp(-far), abs=1e-4)


@pytest.mark.parametrize(("spacing", "opacity"), [(0.06, 0.9), (0.04, 0.5), (0.1, 0.95)])
def test_a_shell_of_flat_gaussians_is_seen_a_little_too_near_without_holes(spacing, opacity):
    scene = shell(1.2, spacing, opacity)
    box = scene.means.min(axis=0) - 0.5, scene.means.max(axis=0) + 0.5
    field = esdf_from_gaussians(scene, VOXEL, *box)
    p = np.stack(np.meshgrid(*field.voxel_centers(), indexing="ij"), -1)
    height = np.linalg.norm(p, axis=-1) - 1.2
    error = (field.distances - np.abs(height)) / VOXEL
    for part in (height > VOXEL, height < -VOXEL):
        assert -0.65 < error[part].mean() < -0.4
        assert error[part].std() < 0.1
        assert error[part].max() < 0.1
    components, count = np.asarray(label(field.states == FieldState.FREE), dtype=object)
    middle = components[tuple(n // 2 for n in field.shape)]
    assert count == 2 and middle > 0 and middle != components[0, 0, 0] > 0


def test_a_cloud_thicker_than_a_voxel_reaches_to_half_of_its_density():
    scene = gaussians(np.zeros((1, 3)), [[1.0, 0.0, 0.0, 0.0]], [[0.3, 0.3, 0.3]], [1.0])
    box = np.full(3, 1.6)
    field = esdf_from_gaussians(scene, 0.05, -box, box)
    expected = np.sqrt(-2.0 * np.log(0.5) * (0.3**2 + 0.025**2))
    assert field.distance([1.4, 0.0, 0.0]) == pytest.approx(1.4 - expected, abs=0.01)
    assert field.query([0.0, 0.0, 0.0]).state == FieldState.OCCUPIED


def test_values_at_the_voxel_centers_are_the_fields_own():
    solids = [HalfSpace([0.0, 0.0, 1.0], 0.07), Cylinder([0.4, 0.3, -1.0], [0.5, 0.5, 3.0], 0.2)]
    field = AnalyticDistanceField(solids, [-0.5, 0.0, 0.0], [1.5, 1.1, 0.75])
    grid = esdf_from_distance_field(field, 0.1)
    assert grid.shape == (20, 11, 8)
    p = np.stack(np.meshgrid(*grid.voxel_centers(), indexing="ij"), -1)
    p[..., 2] = np.minimum(p[..., 2], 0.75)  # the last layer's centers lie on the bounds
    np.testing.assert_allclose(grid.distances, field.distance(p), atol=1e-6)
    np.testing.assert_array_equal(grid.states, field.query(p).state)
    assert (grid.states == FieldState.OCCUPIED).any()


X = 1.0 + 0.1 * (np.arange(30)[:, None, None] + 0.5) + np.zeros((30, 4, 4))  # [m]
SLAB = (X > 2.0) & (X < 2.5)
LOWER_W = np.array([1.0, 0.0, 0.0])


def distances_along_x(field, *x: float) -> np.ndarray:
    return field.distance([[each, 0.2, 0.2] for each in x])


def test_offsets_move_the_surface_within_the_voxels():
    offset = np.maximum(2.03 - X, X - 2.46)
    offset[np.abs(offset) > 0.1] = np.nan
    field = esdf_from_occupancy(offset <= 0.0, None, LOWER_W, 0.1, offset)
    found = distances_along_x(field, 2.03, 2.46, 1.2, 3.5)
    np.testing.assert_allclose(found, [0.0, 0.0, 0.83, 1.04], atol=1e-6)


def test_faces_without_offsets_stay_on_the_voxel_faces():
    offset = np.where(X > 2.1, np.nan, 2.03 - X)
    field = esdf_from_occupancy(SLAB, None, LOWER_W, 0.1, offset)
    np.testing.assert_allclose(distances_along_x(field, 1.2, 3.5), [0.83, 1.0], atol=1e-6)


def test_unknown_voxels_are_marked_and_measured_to_what_was_seen():
    field = esdf_from_occupancy(SLAB, X > 3.0, LOWER_W, 0.1)
    states = field.query([[3.5, 0.2, 0.2], [1.5, 0.2, 0.2]]).state
    np.testing.assert_array_equal(states, [FieldState.UNKNOWN, FieldState.FREE])
    np.testing.assert_allclose(distances_along_x(field, 3.5, 1.5), [1.0, 0.5], atol=1e-6)


@pytest.mark.parametrize(
    ("unknown", "offset", "message"),
    [
        (np.zeros((2, 2, 2), bool), None, r"shape of unknown .* got \(2, 2, 2\)"),
        (SLAB, None, "both occupied and unknown must be 0, got 80"),
        (None, np.zeros(3), r"shape of surface_offset .* got \(3,\)"),
        (None, np.full(SLAB.shape, 0.05), "surface_offset must be .* got 80 voxels"),
    ],
)
def test_contradictions_are_refused(unknown, offset, message):
    with pytest.raises(ValueError, match=message):
        esdf_from_occupancy(SLAB, unknown, LOWER_W, 0.1, offset)


def test_grid_shape_covers_the_box_with_whole_voxels():
    assert grid_shape(np.zeros(3), np.array([36.0, 16.0, 6.0]), 0.1) == (360, 160, 60)
    assert grid_shape(np.full(3, -1.0), np.array([0.01, 0.1, 1.0]), 0.25) == (5, 5, 8)


@pytest.mark.parametrize(
    ("upper", "voxel_size", "message"),
    [
        ([1.0, 0.0, 1.0], 0.1, "upper_W must be finite and above"),
        ([1.0, 1.0, 1.0], 0.0, r"voxel_size must be .* got 0.0"),
        ([1.0, 1.0, 0.05], 0.1, "at least 2 voxels"),
        ([1e3, 1e3, 1e3], 0.1, f"at most {MAX_VOXELS:.3g} voxels".replace("+", r"\+")),
    ],
)
def test_impossible_grids_are_refused(upper, voxel_size, message):
    with pytest.raises(ValueError, match=message):
        grid_shape(np.zeros(3), np.array(upper), voxel_size)
