"""Queries of the distance field on a grid."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf

FREE, OCCUPIED, UNKNOWN, OUTSIDE = FieldState
LOWER_W = np.array([-1.0, 2.0, 0.5])
VOXEL = 0.1


def grid_of(function, shape=(20, 16, 12), states=None) -> Esdf:
    """A field whose values at the voxel centres are function(x, y, z)."""
    x, y, z = (
        lower + VOXEL * (np.arange(n) + 0.5) for lower, n in zip(LOWER_W, shape, strict=True)
    )
    distances = function(x[:, None, None], y[:, None], z) + np.zeros(shape)
    if states is None:
        states = (distances < 0.0).astype(np.uint8)
    return Esdf(distances.astype(np.float32), states, LOWER_W, VOXEL)


def sphere_field() -> Esdf:
    return grid_of(lambda x, y, z: np.sqrt(x**2 + (y - 2.8) ** 2 + (z - 1.1) ** 2) - 0.35)


def random_field() -> Esdf:
    """Values without any structure: every cell has its own polynomial."""
    values = np.random.default_rng(1).normal(size=(20, 16, 12))
    return Esdf(values.astype(np.float32), np.zeros(values.shape, np.uint8), LOWER_W, VOXEL)


def points_in(field: Esdf, count: int = 500) -> np.ndarray:
    return np.random.default_rng(2).uniform(field.lower_W, field.upper_W, (count, 3))


def test_trilinear_functions_are_reproduced_everywhere_inside_the_bounds():
    """The interpolant of a trilinear function is that function, up to the faces of the box."""

    def function(x, y, z):
        return 1.0 + 0.3 * x - 0.2 * y * z + 0.5 * x * y * z

    field = grid_of(function)
    p = points_in(field)
    p[0], p[1] = field.lower_W, field.upper_W
    np.testing.assert_allclose(field.distance(p), function(*p.T), atol=3e-6)


def test_voxel_centers_hold_the_stored_values():
    """At the centre of a voxel the field has exactly its value and its state."""
    field = random_field()
    x, y, z = field.voxel_centers()
    sample = field.query([x[3], y[15], z[7]])
    assert sample.distance == pytest.approx(field.distances[3, 15, 7], abs=1e-6)
    np.testing.assert_allclose(field.upper_W, [1.0, 3.6, 1.7])


def test_gradient_is_the_derivative_of_the_interpolant():
    """Away from cell faces the gradient equals central differences of the distance."""
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


def test_query_and_distance_agree_bit_for_bit():
    """Both ways to ask give the same distance, in any batch shape, also for a single point."""
    field = sphere_field()
    p = points_in(field, 24).reshape(2, 3, 4, 3)
    sample = field.query(p)
    assert sample.gradient.shape == (2, 3, 4, 3)
    np.testing.assert_array_equal(sample.distance, field.distance(p))
    np.testing.assert_array_equal(sample.distance[1, 2, 3], field.distance(p[1, 2, 3]))
    assert field.distance(np.zeros((0, 3))).shape == (0,)
    assert field.query(p[0, 0, 0]).state.shape == ()


@pytest.mark.parametrize("occupied_outside", [False, True])
def test_query_and_distance_agree_anywhere(occupied_outside):
    """Both have the same bits in, on the faces of and around the box, and where numbers are none;
    whatever the points' memory looks like."""
    field = replace(random_field(), occupied_outside=occupied_outside)
    margin = 5 * VOXEL
    generator = np.random.default_rng(4)
    p = generator.uniform(field.lower_W - margin, field.upper_W + margin, (5000, 3))
    p[:8] = np.array([field.lower_W, field.upper_W])[
        np.indices((2, 2, 2)).reshape(3, -1).T, range(3)
    ]
    p[8:40] = LOWER_W + VOXEL * generator.integers(0, 12, (32, 3))
    p[40], p[41, 1], p[42, 2] = np.nan, np.inf, -np.inf
    expected = field.query(p).distance
    np.testing.assert_array_equal(field.distance(p), expected)
    np.testing.assert_array_equal(field.distance(np.asfortranarray(p)), expected)
    np.testing.assert_array_equal(field.distance(p[::-2]), expected[::-2])
    assert np.isfinite(expected[43:]).mean() > (0.99 if occupied_outside else 0.2)
    with pytest.raises(ValueError, match=r"points have shape \(3, 2\); needed"):
        field.distance(np.zeros((3, 2)))


def test_state_is_that_of_the_voxel_around_the_point():
    """A point has the state of the voxel it lies in, up to the voxel's faces."""
    states = np.random.default_rng(3).integers(0, 3, (20, 16, 12)).astype(np.uint8)
    field = grid_of(lambda x, y, z: x, states=states)
    p = points_in(field)
    i, j, k = np.floor((p - LOWER_W) / VOXEL).astype(int).T
    np.testing.assert_array_equal(field.query(p).state, states[i, j, k])


def test_outside_the_bounds_nothing_is_claimed():
    """Beyond the box, and for NaN points: NaN distance, zero gradient, OUTSIDE; others unharmed."""
    field = sphere_field()
    inside = [0.5, 2.5, 1.0]
    p = np.array(
        [inside, [-1.001, 2.5, 1.0], [0.0, 2.5, 1.701], [np.nan, 2.5, 1.0], [0.0, np.inf, 1.0]]
    )
    sample = field.query(p)
    np.testing.assert_array_equal(sample.state, [FREE] + 4 * [OUTSIDE])
    assert np.isfinite(sample.distance[0]) and np.isnan(sample.distance[1:]).all()
    np.testing.assert_array_equal(sample.gradient[1:], 0.0)
    np.testing.assert_array_equal(np.isnan(field.distance(p)), [False, True, True, True, True])
    assert sample.distance[0] == field.distance(inside)


def test_scaled_field_is_that_of_the_scaled_place():
    """At points times the factor, distances are those times the factor; gradients and states are
    the same."""
    field = sphere_field()
    scaled = field.scaled_by(3.0)
    p = points_in(field)
    sample, expected = scaled.query(3.0 * p), field.query(p)
    np.testing.assert_allclose(sample.distance, 3.0 * expected.distance, atol=1e-6)
    np.testing.assert_allclose(sample.gradient, expected.gradient, atol=1e-6)
    np.testing.assert_array_equal(sample.state, expected.state)
    np.testing.assert_allclose(scaled.upper_W, 3.0 * field.upper_W)


def test_volume_counts_the_voxels_of_a_state():
    """The volume of a state is its number of voxels times theirs."""
    states = np.zeros((20, 16, 12), np.uint8)
    states[:5], states[5:7] = OCCUPIED, UNKNOWN
    field = grid_of(lambda x, y, z: x, states=states)
    assert field.volume(UNKNOWN) == pytest.approx(2 * 16 * 12 * 1e-3)
    assert field.volume(FREE) == pytest.approx(13 * 16 * 12 * 1e-3)


def test_fields_are_read_only():
    """A shared field cannot be changed by one of its users, nor does it freeze its inputs."""
    distances = np.ones((2, 2, 2), np.float32)
    field = Esdf(distances, np.zeros((2, 2, 2), np.uint8), np.zeros(3), 1.0)
    for array in (field.distances, field.states, field.lower_W, field.upper_W):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    distances[0, 0, 0] = 2.0


# A box of free space with an obstacle, and unknown space behind x = 0.6.
def half_known_field() -> Esdf:
    x = LOWER_W[0] + VOXEL * (np.arange(20) + 0.5)
    states = np.zeros((20, 16, 12), np.uint8)
    states[x > 0.6] = UNKNOWN
    field = sphere_field()
    states[(field.distances < 0.0)] = OCCUPIED
    return Esdf(field.distances, states, LOWER_W, VOXEL)


def test_conservative_field_counts_unknown_space_and_the_faces_as_occupied():
    """In free space it is the least distance to the obstacle, unknown space and the box's faces."""
    field = half_known_field()
    p = points_in(field)
    p = p[(p[:, 0] < 0.5) & (field.query(p).state == FREE)]
    to_faces = np.minimum(p - field.lower_W, field.upper_W - p).min(axis=1)
    expected = np.minimum(np.minimum(field.distance(p), 0.6 - p[:, 0]), to_faces)
    # The interpolant cuts the corner where two of them meet.
    error = field.conservative().distance(p) - expected
    assert np.abs(error).max() < 0.75 * VOXEL
    assert np.sqrt(np.mean(error**2)) < 0.15 * VOXEL


def test_conservative_field_leads_out_of_unknown_space():
    """In unknown space it is minus the distance to free space, and its gradient points there."""
    field = half_known_field().conservative()
    p = np.array([[0.75, 2.8, 1.5], [0.85, 2.5, 1.1], [0.95, 3.0, 0.9]])
    sample = field.query(p)
    np.testing.assert_allclose(sample.distance, 0.6 - p[:, 0], atol=0.1 * VOXEL)
    np.testing.assert_allclose(sample.gradient, [[-1.0, 0.0, 0.0]] * 3, atol=0.1)
    np.testing.assert_array_equal(sample.state, UNKNOWN)


def test_conservative_field_has_no_ridge_along_a_wall_seen_from_one_side():
    """Behind a thin wall before unknown space depth goes on growing: no way out but the front."""
    x = LOWER_W[0] + VOXEL * (np.arange(20) + 0.5)
    behind = x[:, None, None] + np.zeros((20, 16, 12))  # the wall's face is at x = 0
    states = np.select([behind < 0.0, behind < 0.3], [FREE, OCCUPIED], UNKNOWN).astype(np.uint8)
    distances = np.where(behind < 0.15, -behind, behind - 0.3).astype(np.float32)
    field = Esdf(distances, states, LOWER_W, VOXEL).conservative()
    x = np.linspace(-0.25, 0.95, 40)
    p = np.stack([x, np.full(40, 2.8), np.full(40, 1.1)], -1)
    np.testing.assert_allclose(field.distance(p), -x, atol=0.05 * VOXEL)


def test_conservative_field_goes_on_outside_the_box():
    """Outside it is finite, minus the distance to a free box, and leads back into the box."""
    field = grid_of(lambda x, y, z: 5.0 + 0.0 * x).conservative()
    p = np.array([[-1.5, 2.8, 1.1], [0.0, 4.6, 1.1], [-1.3, 1.6, 1.1], [3.0, 2.8, 9.0]])
    nearest = np.clip(p, field.lower_W, field.upper_W)
    away = np.linalg.norm(p - nearest, axis=1)
    sample = field.query(p)
    np.testing.assert_allclose(sample.distance[:2], -away[:2], atol=1e-6)  # before a face
    np.testing.assert_allclose(sample.distance[2:], -away[2:], atol=0.76 * VOXEL)  # at an edge
    towards_box = np.sum(sample.gradient * (nearest - p), axis=1) / away
    np.testing.assert_allclose(towards_box, 1.0, atol=1e-9)
    np.testing.assert_array_equal(sample.state, OUTSIDE)
    np.testing.assert_array_equal(sample.distance, field.distance(p))


def test_conservative_field_is_continuous_through_the_faces():
    """Across a face of the box the value does not jump, whatever lies behind it."""
    field = half_known_field().conservative()
    random = np.random.default_rng(4)
    p = random.uniform(field.lower_W, field.upper_W, (600, 3))
    axis, side = random.integers(0, 3, 600), random.integers(0, 2, 600)
    rows = np.arange(600)
    p[rows, axis] = np.where(side, field.upper_W[axis], field.lower_W[axis])
    outwards = np.zeros_like(p)
    outwards[rows, axis] = 2.0 * side - 1.0
    jump = field.distance(p + 1e-9 * outwards) - field.distance(p - 1e-9 * outwards)
    assert np.abs(jump).max() < 1e-7


@settings(deadline=None, max_examples=200)
@given(st.integers(0, 2**32 - 1))
def test_conservative_field_is_lipschitz(seed):
    """It grows no faster than the distance travelled, but for the interpolant's corners."""
    field = CONSERVATIVE
    random = np.random.default_rng(seed)
    p = random.uniform(field.lower_W - 0.5, field.upper_W + 0.5, (64, 3))
    q = p + random.normal(size=(64, 3)) * 10.0 ** random.uniform(-3, 0, (64, 1))
    travelled = np.linalg.norm(p - q, axis=1)
    inside = ((np.stack([p, q]) > field.lower_W) & (np.stack([p, q]) < field.upper_W)).all((0, 2))
    # Before a face with unknown space behind it depth grows both along and across it, see
    # Esdf.conservative.
    limit = np.where(inside, 1.35, 1.5)
    assert (np.abs(field.distance(p) - field.distance(q)) <= limit * travelled + 1e-6).all()


CONSERVATIVE = half_known_field().conservative()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"distances": np.zeros((4, 4), np.float32)}, r"shape \(4, 4\)"),
        ({"distances": np.zeros((1, 4, 4), np.float32)}, "at least 2 voxels"),
        ({"distances": np.full((2, 2, 2), np.nan, np.float32)}, "8 of 8 distances are NaN"),
        ({"states": np.zeros((2, 2, 3), np.uint8)}, r"shape \(2, 2, 3\)"),
        ({"states": np.zeros((2, 2, 2), int)}, "int64"),
        ({"states": np.full((2, 2, 2), 3, np.uint8)}, "the value 3"),
        ({"voxel_size": 0.0}, "voxel size is 0.0 m; it must be positive"),
        ({"voxel_size": np.nan}, "voxel size is nan"),
        ({"lower_W": np.zeros(2)}, "3 finite coordinates"),
        ({"lower_W": np.array([0.0, np.inf, 0.0])}, "3 finite coordinates"),
        ({"lower_W": np.full(3, 1e20)}, "make no box"),
    ],
)
def test_bad_grids_are_refused(change, message):
    """Each wrong argument ends with a message that names it and its value."""
    good = {
        "distances": np.ones((2, 2, 2), np.float32),
        "states": np.zeros((2, 2, 2), np.uint8),
        "lower_W": np.zeros(3),
        "voxel_size": 0.1,
    }
    Esdf(**good)
    with pytest.raises(ValueError, match=message):
        Esdf(**good | change)


def test_points_must_have_three_coordinates():
    """Points of another last dimension are refused."""
    with pytest.raises(ValueError, match=r"\(5, 2\)"):
        sphere_field().distance(np.zeros((5, 2)))
