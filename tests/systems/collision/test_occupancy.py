import numpy as np
import pytest

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf_build import MAX_VOXELS, esdf_from_occupancy, grid_shape

FREE, OCCUPIED, UNKNOWN, _ = FieldState


def slab() -> np.ndarray:
    """Occupied for x index 10 to 14 of 30."""
    occupied = np.zeros((30, 4, 4), bool)
    occupied[10:15] = True
    return occupied


def test_a_slab_has_its_faces_on_the_voxel_faces():
    field = esdf_from_occupancy(slab(), None, np.array([1.0, 0.0, 0.0]), 0.1)
    x = np.linspace(1.06, 3.94, 50)
    p = np.stack([x, np.full(50, 0.2), np.full(50, 0.2)], -1)
    exact = np.maximum(2.0 - x, x - 2.5)
    # The interpolant rounds off the middle plane of the slab.
    middle = np.abs(x - 2.25) < 0.11
    np.testing.assert_allclose(field.distance(p)[~middle], exact[~middle], atol=1e-6)
    np.testing.assert_array_equal(field.states == OCCUPIED, slab())


def test_offsets_move_the_surface_within_the_voxels():
    x = 1.0 + 0.1 * (np.arange(30) + 0.5)
    offset = np.maximum(2.03 - x, x - 2.46)[:, None, None] + np.zeros((30, 4, 4))
    offset[np.abs(offset) > 0.1] = np.nan
    field = esdf_from_occupancy(offset <= 0.0, None, np.array([1.0, 0.0, 0.0]), 0.1, offset)
    p = np.array([[2.03, 0.2, 0.2], [2.46, 0.2, 0.2], [1.2, 0.2, 0.2], [3.5, 0.2, 0.2]])
    np.testing.assert_allclose(field.distance(p), [0.0, 0.0, 0.83, 1.04], atol=1e-6)


def test_faces_without_offsets_stay_on_the_voxel_faces():
    x = 1.0 + 0.1 * (np.arange(30) + 0.5)
    offset = (2.03 - x)[:, None, None] + np.zeros((30, 4, 4))
    offset[x > 2.1] = np.nan
    occupied = slab()
    field = esdf_from_occupancy(occupied, None, np.array([1.0, 0.0, 0.0]), 0.1, offset)
    p = np.array([[1.2, 0.2, 0.2], [3.5, 0.2, 0.2]])
    np.testing.assert_allclose(field.distance(p), [0.83, 1.0], atol=1e-6)


def test_unknown_voxels_are_marked_and_measured_to_what_was_seen():
    unknown = np.zeros((30, 4, 4), bool)
    unknown[20:] = True
    field = esdf_from_occupancy(slab(), unknown, np.array([1.0, 0.0, 0.0]), 0.1)
    sample = field.query([[3.5, 0.2, 0.2], [1.5, 0.2, 0.2]])
    np.testing.assert_array_equal(sample.state, [UNKNOWN, FREE])
    np.testing.assert_allclose(sample.distance, [1.0, 0.5], atol=1e-6)


def test_a_world_without_obstacles_is_finite():
    field = esdf_from_occupancy(np.zeros((4, 4, 4), bool), None, np.zeros(3), 0.1)
    assert 0.6 < field.distance([0.2, 0.2, 0.2]) < 0.7


def test_contradictions_are_refused():
    occupied, zero = slab(), np.zeros(3)
    with pytest.raises(ValueError, match=r"unknown \(2, 2, 2\)"):
        esdf_from_occupancy(occupied, np.zeros((2, 2, 2), bool), zero, 0.1)
    with pytest.raises(ValueError, match="80 voxels are both"):
        esdf_from_occupancy(occupied, occupied, zero, 0.1)
    with pytest.raises(ValueError, match=r"surface_offset has shape \(3,\)"):
        esdf_from_occupancy(occupied, None, zero, 0.1, np.zeros(3))
    with pytest.raises(ValueError, match="contradicts the occupancy in 80 voxels"):
        esdf_from_occupancy(occupied, None, zero, 0.1, np.full(occupied.shape, 0.05))


def test_grid_shape_covers_the_box_with_whole_voxels():
    assert grid_shape(np.zeros(3), np.array([36.0, 16.0, 6.0]), 0.1) == (360, 160, 60)
    assert grid_shape(np.full(3, -1.0), np.array([0.01, 0.1, 1.0]), 0.25) == (5, 5, 8)


@pytest.mark.parametrize(
    ("upper", "voxel_size", "message"),
    [
        ([1.0, 0.0, 1.0], 0.1, "upper_W must be finite and above"),
        ([1.0, np.inf, 1.0], 0.1, "upper_W must be finite and above"),
        ([1.0, 1.0, 1.0], 0.0, r"voxel_size must be .* got 0.0"),
        ([1.0, 1.0, 0.05], 0.1, "at least 2 voxels"),
        ([1e3, 1e3, 1e3], 0.1, f"at most {MAX_VOXELS:.3g} voxels".replace("+", r"\+")),
    ],
)
def test_impossible_grids_are_refused(upper, voxel_size, message):
    with pytest.raises(ValueError, match=message):
        grid_shape(np.zeros(3), np.array(upper), voxel_size)
