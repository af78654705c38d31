import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.collision.observations import (
    ConfirmedSurfaces,
    Observations,
    frontier_faces,
    hidden_frontier,
    reachable_space,
    with_obstacles,
)

K = np.array([[80.0, 0.0, 80.0], [0.0, 80.0, 60.0], [0.0, 0.0, 1.0]])
AHEAD = RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
WALL = np.array([[2.0, 0.0, 0.0], [2.0, 0.5, 0.3]])  # on the wall x = 2 m


@pytest.fixture(scope="module")
def wall() -> Observations:
    """A wall 2 m ahead, seen by three cameras at the origin."""
    depth = np.full((120, 160), 2.0, np.float32)
    depth[:10] = np.inf
    X_WC = RigidTransform(AHEAD, np.zeros(3))
    return Observations.from_depth_images([depth] * 3, K, [X_WC] * 3, 0.1)


def test_counts_of_images(wall):
    assert (wall.counts == 3).all()
    seen = {tuple(voxel) for voxel in wall.voxels}
    assert all(tuple(voxel) in seen for voxel in np.floor((WALL + 0.01) / 0.1))


def test_views_agree_from_the_observed_side_within_a_voxel_of_the_surface(wall):
    for p_WC, agrees in ([0.0, 0.0, 0.0], True), ([1.0, 0.8, 0.0], True), ([4.0, 0.0, 0.0], False):
        assert wall.agree_with(WALL, p_WC).tolist() == [agrees, agrees]
    offsets = np.array([[0.1, 0.0, 0.0], [0.25, 0.0, 0.0]])
    assert wall.agree_with(WALL[0] + offsets, np.zeros(3)).tolist() == [True, False]
    assert wall.scaled_by(2.0).agree_with(2.0 * WALL, np.zeros(3)).all()


def test_surfaces_are_confirmed_by_three_images_from_different_directions():
    depth = np.full((120, 160), 2.03, np.float32)
    depth[:10] = np.inf
    wrong = np.full_like(depth, 3.03)
    wrong[60] = 0.0

    def kept(aside: list[float], shown: np.ndarray) -> np.ndarray:
        X_WCs = [RigidTransform(AHEAD, np.array([0.0, y, 0.0])) for y in aside]
        depths = [depth] * (len(aside) - 1) + [shown]
        surfaces = ConfirmedSurfaces(depths, K, X_WCs, 0.1)
        return surfaces.keep(shown, X_WCs[-1])

    middle = slice(20, 50), slice(40, 120)
    assert (kept([-0.4, 0.4, 0.0], depth)[middle] == depth[middle]).all()
    for aside, shown in ([0.4, 0.0], depth), ([0.0, 0.02, 0.04], depth), ([-0.4, 0.4, 0.0], wrong):
        assert not kept(aside, shown)[middle].any()
    assert (kept([-0.4, 0.4, *20 * [0.0]], depth)[middle] == depth[middle]).all()
    assert np.isinf(kept([-0.4, 0.4, 0.0], depth)[:10]).all()
    nothing = ConfirmedSurfaces([np.zeros_like(depth)], K, [RigidTransform()], 0.1)
    assert not nothing.keep(wrong, RigidTransform()).any()


def test_a_file_comes_back_the_same(wall, tmp_path):
    wall.save(tmp_path / "observations.npz")
    read = Observations.load(tmp_path / "observations.npz")
    for name in ("voxels", "counts", "directions", "view_points", "unobserved", "voxel_size"):
        np.testing.assert_array_equal(getattr(read, name), getattr(wall, name))


@pytest.mark.parametrize(
    ("change", "message"),
    [({"version": 9}, "version.*got 9"), ({"counts": np.zeros(1, np.uint16)}, "counts")],
)
def test_damaged_files(wall, tmp_path, change, message):
    file = tmp_path / "observations.npz"
    wall.save(file)
    np.savez(file, **(dict(np.load(file)) | change))
    with pytest.raises(ValueError, match=message):
        Observations.load(file)


def half_seen_room(closet: bool = False) -> Esdf:
    """A room of 4 x 2 x 2 m with walls of 0.2 m, in voxels of 0.1 m from the origin. The last 1.5 m
    along x are unknown, except for a closet of 0.4 m behind a wall."""
    occupied = np.ones((44, 24, 24), bool)
    occupied[2:42, 2:22, 2:22] = False
    unknown = np.zeros_like(occupied)
    unknown[27:] = ~occupied[27:]
    if closet:
        occupied[34:38, 10:14, 10:14] = unknown[34:38, 10:14, 10:14] = False
    return esdf_from_occupancy(occupied, unknown, np.zeros(3), 0.1)


def test_reachable_space_holds_the_vehicle():
    field = half_seen_room(closet=True)
    free = field.states == FieldState.FREE
    expected = free.copy()
    expected[27:] = False
    np.testing.assert_array_equal(reachable_space(field, 0.35), expected)
    assert not reachable_space(field, 1.1).any()
    assert free[27:].any()


def test_obstacles_begin_two_voxels_behind_seen_space():
    field = half_seen_room()
    reachable = reachable_space(field, 0.35)
    hidden, before, _ = hidden_frontier(field, reachable, [], K, [])
    assert set(np.argwhere(hidden)[:, 0]) == {28}
    assert hidden[28, 2:22, 2:22].all()
    centers, normals = frontier_faces(before, hidden)
    assert len(centers) == 20 * 20
    np.testing.assert_array_equal(centers[:, 0], 28.0)
    np.testing.assert_array_equal(normals, np.tile([-1.0, 0.0, 0.0], (400, 1)))

    closed = with_obstacles(field, hidden)
    p_WQ = np.array([[2.0, 1.2, 1.2], [2.5, 1.0, 1.2], [0.5, 1.2, 1.2], [2.65, 0.3, 1.2]])
    np.testing.assert_allclose(closed.distance(p_WQ), [0.8, 0.3, 0.3, 0.1], atol=0.01)
    assert closed.query([2.85, 1.2, 1.2]).state == FieldState.OCCUPIED
    free = field.states == FieldState.FREE
    np.testing.assert_allclose(
        closed.conservative().distances[free], field.conservative().distances[free], atol=1e-6
    )


@pytest.mark.parametrize(("seen", "surface"), [(np.inf, False), (1000.0, False), (50.0, True)])
def test_space_before_the_sky_and_far_surfaces_stays_open(seen, surface):
    field = half_seen_room()
    R_WC = RollPitchYaw(0.0, np.pi / 2, 0.0).ToRotationMatrix()  # x of the image is -z
    X_WC = RigidTransform(R_WC, [0.8, 1.2, 1.2])
    depth = np.zeros((120, 160))
    depth[:, :80] = seen
    hidden, _, before_surface = hidden_frontier(
        field, reachable_space(field, 0.35), [depth], K, [X_WC]
    )
    assert before_surface is surface
    assert hidden[28, 2:22, 2:11].all()
    assert not hidden[28, 2:22, 13:].any()
