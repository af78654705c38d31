import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.collision.observations import ConfirmedSurfaces, Observations

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
