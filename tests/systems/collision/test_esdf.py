import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.ndimage import gaussian_filter

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import (
    Esdf,
    distance_to_voxels,
    distances_from_band,
    occupancy_distances,
)
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, Capsule, Sphere

FREE, OCCUPIED, UNKNOWN, OUTSIDE = FieldState
LOWER_W = np.array([-1.0, 2.0, 0.5])
VOXEL = 0.1


def grid_of(function) -> Esdf:
    """A field whose values at the voxel centers are function(x, y, z)."""
    steps = VOXEL * (np.indices((20, 16, 12)) + 0.5)
    distances = function(*(LOWER_W[:, None, None, None] + steps)).astype(np.float32)
    return Esdf(distances, (distances < 0.0).astype(np.uint8), LOWER_W, VOXEL)


def sphere_field() -> Esdf:
    return grid_of(lambda x, y, z: np.sqrt(x**2 + (y - 2.8) ** 2 + (z - 1.1) ** 2) - 0.35)


def random_field(occupied_outside: bool = False) -> Esdf:
    """Values without any structure: every cell has its own polynomial."""
    random = np.random.default_rng(1)
    values = random.normal(size=(20, 16, 12)).astype(np.float32)
    states = random.integers(0, 3, values.shape).astype(np.uint8)
    return Esdf(values, states, LOWER_W, VOXEL, occupied_outside)


def points_in(field: Esdf, count: int = 500) -> np.ndarray:
    return np.random.default_rng(2).uniform(field.lower_W, field.upper_W, (count, 3))


def test_trilinear_functions_are_reproduced_everywhere_inside_the_bounds():
    def function(x, y, z):
        return 1.0 + 0.3 * x - 0.2 * y * z + 0.5 * x * y * z

    field = grid_of(function)
    p = points_in(field)
    p[0], p[1] = field.lower_W, field.upper_W
    np.testing.assert_allclose(field.distance(p), function(*p.T), atol=3e-6)


def test_gradient_is_the_derivative_of_the_interpolant():
    field = random_field()
    p = points_in(field)
    step = 1e-4  # large: along an axis the interpolant is a straight line
    in_cell = np.mod((p - LOWER_W) / VOXEL - 0.5, 1.0)
    p = p[((in_cell > 0.01) & (in_cell < 0.99)).all(axis=1)]
    p = p[((p > LOWER_W + step) & (p < field.upper_W - step)).all(axis=1)]
    assert len(p) > 300
    differences = [
        (field.distance(p + step * axis) - field.distance(p - step * axis)) / (2 * step)
        for axis in np.eye(3)
    ]
    np.testing.assert_allclose(field.query(p).gradient, np.stack(differences, -1), atol=1e-6)


@pytest.mark.parametrize("occupied_outside", [False, True])
def test_queries_agree_anywhere_and_have_the_state_of_the_voxel(occupied_outside):
    field, margin = random_field(occupied_outside), 5 * VOXEL
    generator = np.random.default_rng(4)
    p = generator.uniform(field.lower_W - margin, field.upper_W + margin, (5000, 3))
    p[:8] = np.array([field.lower_W, field.upper_W])[
        np.indices((2, 2, 2)).reshape(3, -1).T, range(3)
    ]
    p[8:40] = LOWER_W + VOXEL * generator.integers(0, 12, (32, 3))
    p[40], p[41, 1], p[42, 2] = np.nan, np.inf, -np.inf
    expected, gradient, state = field.query(p)
    np.testing.assert_array_equal(field.distance(p), expected)
    np.testing.assert_array_equal(field.distance(np.asfortranarray(p)), expected)
    np.testing.assert_array_equal(field.distance(p[::-2]), expected[::-2])
    inside = ((p >= field.lower_W) & (p <= field.upper_W)).all(axis=1)
    assert inside.mean() > 0.2 and np.isfinite(expected[inside]).all()
    np.testing.assert_array_equal(np.isfinite(expected[43:]), inside[43:] | occupied_outside)
    assert not gradient[~np.isfinite(expected)].any()
    i, j, k = np.minimum((p[inside] - LOWER_W) / VOXEL, [19, 15, 11]).astype(int).T
    np.testing.assert_array_equal(state[inside][40:], field.states[i, j, k][40:])
    assert (state[~inside] == OUTSIDE).all()
    with pytest.raises(ValueError, match=r"shape of points .* got \(3, 2\)"):
        field.distance(np.zeros((3, 2)))


def test_scaled_field_is_that_of_the_scaled_scene():
    field = sphere_field()
    scaled = field.scaled_by(3.0)
    p = points_in(field)
    sample, expected = scaled.query(3.0 * p), field.query(p)
    np.testing.assert_allclose(sample.distance, 3.0 * expected.distance, atol=1e-6)
    np.testing.assert_allclose(sample.gradient, expected.gradient, atol=1e-6)
    np.testing.assert_array_equal(sample.state, expected.state)
    np.testing.assert_allclose(scaled.upper_W, 3.0 * field.upper_W)


def half_known_field() -> Esdf:
    """A sphere in free space, and unknown space behind x = 0.6."""
    field = sphere_field()
    states = np.zeros(field.shape, np.uint8)
    states[field.voxel_centers()[0] > 0.6] = UNKNOWN
    states[field.distances < 0.0] = OCCUPIED
    return Esdf(field.distances, states, LOWER_W, VOXEL)


def test_conservative_field_counts_unknown_space_and_the_faces_as_occupied():
    field = half_known_field()
    p = points_in(field)
    p = p[(p[:, 0] < 0.5) & (field.query(p).state == FREE)]
    to_faces = np.minimum(p - field.lower_W, field.upper_W - p).min(axis=1)
    expected = np.minimum(np.minimum(field.distance(p), 0.6 - p[:, 0]), to_faces)
    # The interpolant cuts the corner where two of them meet.
    error = field.conservative().distance(p) - expected
    assert np.abs(error).max() < 0.75 * VOXEL and np.sqrt(np.mean(error**2)) < 0.15 * VOXEL

    p = np.array([[0.75, 2.8, 1.5], [0.85, 2.5, 1.1], [0.95, 3.0, 0.9]])  # in unknown space
    sample = field.conservative().query(p)
    np.testing.assert_allclose(sample.distance, 0.6 - p[:, 0], atol=0.1 * VOXEL)
    np.testing.assert_allclose(sample.gradient, [[-1.0, 0.0, 0.0]] * 3, atol=0.1)
    np.testing.assert_array_equal(sample.state, UNKNOWN)


def test_conservative_field_has_no_ridge_along_a_wall_seen_from_one_side():
    behind = LOWER_W[0] + VOXEL * (np.indices((20, 16, 12))[0] + 0.5)  # the wall's face is at x = 0
    states = np.select([behind < 0.0, behind < 0.3], [FREE, OCCUPIED], UNKNOWN).astype(np.uint8)
    distances = np.where(behind < 0.15, -behind, behind - 0.3).astype(np.float32)
    field = Esdf(distances, states, LOWER_W, VOXEL).conservative()
    x = np.linspace(-0.25, 0.95, 40)
    p = np.stack([x, np.full(40, 2.8), np.full(40, 1.1)], -1)
    np.testing.assert_allclose(field.distance(p), -x, atol=0.05 * VOXEL)


def test_conservative_field_continues_outside_the_box():
    field = grid_of(lambda x, y, z: 5.0 + 0.0 * x).conservative()
    p = np.array([[-1.5, 2.8, 1.1], [0.0, 4.6, 1.1], [-1.3, 1.6, 1.1], [3.0, 2.8, 9.0]])
    nearest = np.clip(p, field.lower_W, field.upper_W)
    away = np.linalg.norm(p - nearest, axis=1)
    sample = field.query(p)
    np.testing.assert_allclose(sample.distance[:2], -away[:2], atol=1e-6)  # before a face
    np.testing.assert_allclose(sample.distance[2:], -away[2:], atol=0.76 * VOXEL)  # at an edge
    toward_box = np.sum(sample.gradient * (nearest - p), axis=1) / away
    np.testing.assert_allclose(toward_box, 1.0, atol=1e-9)
    np.testing.assert_array_equal(sample.state, OUTSIDE)
    np.testing.assert_array_equal(sample.distance, field.distance(p))


def test_conservative_field_is_lipschitz():
    field, random = half_known_field().conservative(), np.random.default_rng(0)
    p = random.uniform(field.lower_W - 0.5, field.upper_W + 0.5, (20_000, 3))
    q = p + random.normal(size=p.shape) * 10.0 ** random.uniform(-3, 0, (len(p), 1))
    traveled = np.linalg.norm(p - q, axis=1)
    inside = ((np.stack([p, q]) > field.lower_W) & (np.stack([p, q]) < field.upper_W)).all((0, 2))
    # Before a face with unknown space behind it depth grows both along and across it.
    limit = np.where(inside, 1.35, 1.5)
    assert (np.abs(field.distance(p) - field.distance(q)) <= limit * traveled + 1e-6).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"distances": np.zeros((4, 4), np.float32)}, r"got \(4, 4\)"),
        ({"distances": np.zeros((1, 4, 4), np.float32)}, "at least 2 voxels"),
        ({"distances": np.full((2, 2, 2), np.nan, np.float32)}, "8 of 8 NaN"),
        ({"states": np.zeros((2, 2, 3), np.uint8)}, r"got uint8 of \(2, 2, 3\)"),
        ({"states": np.full((2, 2, 2), 3, np.uint8)}, "got 3"),
        ({"voxel_size": 0.0}, "voxel_size must be .* got 0.0"),
        ({"lower_W": np.array([0.0, np.inf, 0.0])}, "3 finite coordinates"),
        ({"lower_W": np.full(3, 1e20)}, "voxel_size must be .* lower_W"),
    ],
)
def test_bad_grids_are_refused(change, message):
    good = {"distances": np.ones((2, 2, 2), np.float32), "states": np.zeros((2, 2, 2), np.uint8)}
    good |= {"lower_W": np.zeros(3), "voxel_size": 0.1}
    Esdf(**good)
    with pytest.raises(ValueError, match=message):
        Esdf(**good | change)


def test_a_saved_field_comes_back_the_same(tmp_path):
    field = random_field(occupied_outside=True)
    field.save(tmp_path / "esdf.npz")
    loaded = Esdf.load(tmp_path / "esdf.npz")
    for name in ("distances", "states", "lower_W", "voxel_size", "occupied_outside"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(field, name))
    assert [path.name for path in tmp_path.iterdir()] == ["esdf.npz"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"states": None}, "states must be .* got nothing"),
        ({"version": np.int64(99)}, "version must be 1, got 99"),
        ({"distances": np.zeros((20, 16, 12), int)}, "distances must be .* got int64"),
        ({"voxel_size": np.float64(-0.05)}, "voxel_size must be .* got -0.05"),
        ({"states": np.array([[[{}]]], dtype=object)}, "not a readable numpy archive"),
    ],
)
def test_wrong_entries_are_refused(tmp_path, change, message):
    path = tmp_path / "esdf.npz"
    random_field().save(path)
    with np.load(path) as archive:
        entries = {**archive, **change}
    np.savez(path, **{name: value for name, value in entries.items() if value is not None})
    with pytest.raises(ValueError, match=f"{path}.*{message}"):
        Esdf.load(path)


@pytest.mark.parametrize("field", [random_field(), random_field().conservative()])
def test_tensors_have_the_answers_of_numpy_and_exact_gradients(field):
    random = np.random.default_rng(1)
    p = random.uniform(field.lower_W - 0.3, field.upper_W + 0.3, (4, 50, 3))
    tensor = torch.from_numpy(p).requires_grad_()
    expected, sample, distance = field.query(p), field.query(tensor), field.distance(tensor)
    for got, array in zip((*sample, distance), (*expected, expected.distance), strict=True):
        np.testing.assert_allclose(got.detach(), array, atol=1e-6)
    distance.nansum().backward()
    np.testing.assert_allclose(tensor.grad, expected.gradient, atol=1e-9)
    single = field.query(torch.from_numpy(p[0, 0]).float())
    assert single.distance.dtype == torch.float32 and single.distance.shape == ()
    np.testing.assert_allclose(single.distance, expected.distance[0, 0], atol=1e-4)


def test_grids_without_a_surface_have_finite_distances():
    none = np.zeros((3, 4, 12), bool)
    assert distance_to_voxels(none, 0.5).min() == pytest.approx(6.5)
    band = np.full(none.shape, np.nan, np.float32)
    for voxels, sign in ((none, 1.0), (~none, -1.0)):
        assert (sign * occupancy_distances(voxels, 0.5)).min() > 6.0
        assert sign * distances_from_band(voxels, band, 0.5).min() == pytest.approx(6.5)


@pytest.mark.parametrize("share", [0.003, 0.3, "blobs"])
def test_occupancy_is_never_farther_than_its_voxels(share):
    rng = np.random.default_rng(0)
    noise = rng.random((70, 24, 18))
    occupied = noise < share if share != "blobs" else gaussian_filter(noise, 2.0) > 0.52
    field = Esdf(occupancy_distances(occupied, 1.0), occupied.astype(np.uint8), np.zeros(3), 1.0)
    p = rng.uniform(0.5, np.array(occupied.shape) - 0.5, (1000, 3))
    centers = np.argwhere(occupied) + 0.5
    beyond = (np.maximum(np.abs(q - centers) - 0.5, 0.0) for q in p)
    outside = np.array([np.sqrt((each**2).sum(axis=1).min()) for each in beyond])
    error = field.distance(p) - outside
    assert error[outside > 0.0].max() < 1e-3
    assert -0.5 < error[outside > 0.0].mean() < 0.0
    assert field.distance(p[outside == 0.0]).max(initial=0.0) <= 0.0
    np.testing.assert_array_equal(field.distances < 0.0, occupied)


def test_occupancy_is_exact_beside_walls():
    wall = np.zeros((40, 8, 8), bool)
    wall[10:15] = True
    x = np.arange(40)[:, None, None] + 0.5
    expected = np.broadcast_to(0.2 * np.maximum(10.0 - x, x - 15.0), wall.shape)
    np.testing.assert_allclose(occupancy_distances(wall, 0.2), expected, atol=1e-6)


@pytest.mark.parametrize(
    "solids",
    [
        [Sphere([24.3, 23.1, 25.7], 9.3)],
        [Capsule([22.3, 25.2, -20.0], [26.1, 22.9, 90.0], 2.7)],
        [Box(RigidTransform(RollPitchYaw(0.5, 0.4, 1.1), [23.2, 24.4, 23.8]), [9.0, 14.0, 20.0])],
        [Sphere([12.3, 12.1, 22.7], 6.0), Sphere([36.0, 32.0, 26.0], 4.5)],
    ],
)
def test_the_surface_within_the_voxels_makes_the_field_accurate(solids):
    p = np.moveaxis(np.indices((48, 48, 48)) + 0.5, 0, -1)
    phi = AnalyticDistanceField(solids, np.zeros(3), np.full(3, 48.0)).distance(p)
    phi = phi.astype(np.float32)
    band = np.where(np.abs(phi) < 1.0, phi, np.float32(np.nan))
    distances = distances_from_band(phi < 0.0, band, 1.0)
    error = distances - phi
    for part in (phi > 0.0, phi < 0.0):
        assert np.sqrt(np.mean(error[part] ** 2)) < 0.2
        assert abs(error[part].mean()) < 0.15
    near = np.abs(phi) < 2.0
    assert np.sqrt(np.mean(error[near] ** 2)) < 0.15
    assert abs(error[near & (phi > 0.0)].mean()) < 0.1
    # A voxel of the band keeps its own value.
    assert np.abs(error[np.isfinite(band)]).max() < 1e-4
    np.testing.assert_array_equal(distances < 0.0, phi < 0.0)
