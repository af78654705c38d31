import numpy as np
import pytest
from scipy.ndimage import label
from scipy.spatial.transform import Rotation

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import (
    density_on_grid,
    esdf_from_distance_field,
    esdf_from_gaussians,
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


@pytest.mark.parametrize(("spacing", "opacity"), [(0.06, 0.9), (0.04, 0.5), (0.1, 0.95)])
def test_a_shell_of_flat_gaussians_is_seen_a_little_too_near(spacing, opacity):
    field = esdf_from_gaussians(shell(1.2, spacing, opacity), VOXEL)
    p = np.stack(np.meshgrid(*field.voxel_centers(), indexing="ij"), -1)
    height = np.linalg.norm(p, axis=-1) - 1.2
    error = (field.distances - np.abs(height)) / VOXEL
    for part in (height > VOXEL, height < -VOXEL):
        assert -0.65 < error[part].mean() < -0.4
        assert error[part].std() < 0.1
        assert error[part].max() < 0.1


def test_a_shell_has_no_holes():
    field = esdf_from_gaussians(shell(), VOXEL)
    components = np.zeros(field.shape, int)
    label(field.states == FieldState.FREE, output=components)
    middle = tuple(n // 2 for n in field.shape)
    assert components[middle] != components[0, 0, 0]
    assert components[middle] > 0 and components[0, 0, 0] > 0


@pytest.mark.parametrize("threshold", [0.5, 0.1, 0.01])
def test_a_cloud_thicker_than_a_voxel_reaches_to_its_threshold(threshold):
    scene = gaussians(np.zeros((1, 3)), [[1.0, 0.0, 0.0, 0.0]], [[0.3, 0.3, 0.3]], [1.0])
    box = np.full(3, 1.6)
    field = esdf_from_gaussians(scene, 0.05, -box, box, threshold)
    expected = np.sqrt(-2.0 * np.log(threshold) * (0.3**2 + 0.025**2))
    assert field.distance([1.4, 0.0, 0.0]) == pytest.approx(1.4 - expected, abs=0.01)
    assert field.query([0.0, 0.0, 0.0]).state == FieldState.OCCUPIED


def test_transparent_gaussians_are_no_obstacle():
    scene = gaussians(np.zeros((1, 3)), [[1.0, 0.0, 0.0, 0.0]], [[0.3, 0.3, 0.3]], [0.3])
    field = esdf_from_gaussians(scene, VOXEL)
    assert (field.states == FieldState.FREE).all()


def test_what_was_not_observed_is_unknown_unless_occupied():
    scene = shell()
    free = esdf_from_gaussians(scene, VOXEL)
    observed = np.zeros(free.shape, bool)
    observed[: free.shape[0] // 2] = True
    field = esdf_from_gaussians(scene, VOXEL, observed=observed)
    occupied = free.states == FieldState.OCCUPIED
    np.testing.assert_array_equal(field.states == FieldState.OCCUPIED, occupied)
    np.testing.assert_array_equal(field.states == FieldState.UNKNOWN, ~observed & ~occupied)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"threshold": 0.0}, r"threshold must be .* got 0.0"),
        ({"threshold": 1.0}, r"threshold must be .* got 1.0"),
        ({"observed": np.ones((2, 2, 2), bool)}, r"shape of observed must be .* got \(2, 2, 2\)"),
        ({"voxel_size": -0.1}, r"voxel_size must be .* got -0.1"),
        ({"upper_W": np.full(3, 1e4)}, "use larger voxels"),
    ],
)
def test_bad_arguments_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        esdf_from_gaussians(shell(), **{"voxel_size": VOXEL} | change)


def test_values_at_the_voxel_centers_are_the_fields_own():
    pillar = Cylinder(np.array([0.4, 0.3, -1.0]), np.array([0.5, 0.5, 3.0]), 0.2)
    field = AnalyticDistanceField(
        [HalfSpace(np.array([0.0, 0.0, 1.0]), 0.07), pillar],
        np.array([-0.5, 0.0, 0.0]),
        np.array([1.5, 1.1, 0.75]),
    )
    grid = esdf_from_distance_field(field, 0.1)
    assert grid.shape == (20, 11, 8)
    p = np.stack(np.meshgrid(*grid.voxel_centers(), indexing="ij"), -1)
    p[..., 2] = np.minimum(p[..., 2], 0.75)  # the last layer's centers lie on the bounds
    np.testing.assert_allclose(grid.distances, field.distance(p), atol=1e-6)
    np.testing.assert_array_equal(grid.states, field.query(p).state)
    assert (grid.states == FieldState.OCCUPIED).any()


def test_unknown_space_stays_unknown():
    states = np.zeros((8, 8, 8), np.uint8)
    states[4:] = FieldState.UNKNOWN
    coarse = Esdf(np.ones((8, 8, 8), np.float32), states, np.zeros(3), 0.2)
    fine = esdf_from_distance_field(coarse, 0.1)
    assert fine.shape == (16, 16, 16)
    assert fine.volume(FieldState.UNKNOWN) == coarse.volume(FieldState.UNKNOWN)
