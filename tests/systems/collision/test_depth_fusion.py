import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from splatpilot.systems.collision.depth_fusion import (
    DepthFusion,
    bounds_of_depth_images,
    esdf_from_depth_images,
)
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.shapes import (
    AnalyticDistanceField,
    Box,
    Cylinder,
    HalfSpace,
    Sphere,
)

FREE, OCCUPIED, UNKNOWN, _ = FieldState
K = np.array([[60.0, 0.0, 60.0], [0.0, 60.0, 45.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 120, 90
# From a camera's axes to those of a body that looks along its x axis.
R_BC = RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


WALLS = ([1, 0, 0], 0.0), ([-1, 0, 0], -4.0), ([0, 1, 0], 0.0), ([0, -1, 0], -3.0)
FLOOR_AND_CEILING = ([0, 0, 1], 0.0), ([0, 0, -1], -2.5)
X_CRATE = RigidTransform(RollPitchYaw(0.0, 0.0, 0.5), np.array([3.2, 0.6, 0.3]))
# 4 x 3 x 2.5 m with a sphere, a pillar and a crate.
ROOM = AnalyticDistanceField(
    [
        *(HalfSpace(*plane) for plane in (*WALLS, *FLOOR_AND_CEILING)),
        Sphere([2.5, 1.5, 0.8], 0.5),
        Cylinder([1.2, 2.2, 0.0], [1.3, 2.2, 2.5], 0.15),
        Box(X_CRATE, [0.6, 0.4, 0.6]),
    ],
    np.full(3, -1.0),
    np.array([5.0, 4.0, 3.5]),
)
# Before a wall 1.5 m ahead of a camera at the origin.
BOX = np.array([-0.5, -0.4, 0.2]), np.array([0.5, 0.4, 2.4])


@pytest.fixture(scope="module")
def capture() -> tuple[list[np.ndarray], list[RigidTransform]]:
    """Views in four directions from each of four points of the room."""
    X_WCs = [
        RigidTransform(
            RotationMatrix(RollPitchYaw(0.0, 0.3 * (k % 3 - 1), k * np.pi / 4)).multiply(R_BC),
            np.array([1.0 + 2.0 * (k % 2), 0.8 + 1.4 * (k // 8), 1.2 + 0.2 * (k % 3)]),
        )
        for k in range(16)
    ]
    row, column = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    ray_C = np.stack([(column - 60.0) / 60.0, (row - 45.0) / 60.0, np.ones_like(row)], -1)
    length = np.linalg.norm(ray_C, axis=-1)
    depths = []
    for X_WC in X_WCs:
        ray_W = (ray_C / length[..., None]) @ X_WC.rotation().matrix().T
        traveled = np.zeros_like(length)
        for _ in range(40):  # sphere tracing
            traveled += ROOM.distance(X_WC.translation() + traveled[..., None] * ray_W)
        depths.append((traveled / length).astype(np.float32))
    return depths, X_WCs


def test_the_fused_field_is_that_of_the_room(capture):
    depths, X_WCs = capture
    lower_W, upper_W = bounds_of_depth_images(depths, K, X_WCs)
    voxel_size = 0.1
    field = esdf_from_depth_images(depths, K, X_WCs, lower_W, upper_W, voxel_size)
    p = np.stack(np.meshgrid(*field.voxel_centers(), indexing="ij"), -1)
    truth = ROOM.distance(p)
    free = field.states == FREE
    error = (field.distances - truth) / voxel_size
    near = free & (truth < 1.5 * voxel_size)
    assert abs(error[near].mean()) < 0.05
    assert np.sqrt(np.mean(error[near] ** 2)) < 0.2
    # Space hidden behind an edge may count as occupied, so distances far away err to the safe side.
    assert -0.2 < error[free].mean() < 0.05
    assert np.quantile(error[free], 0.99) < 0.5
    # Free voxels are free, and most of the room was seen.
    assert truth[free].min() > -0.5 * voxel_size
    assert np.mean(field.states[truth > 0.0] != UNKNOWN) > 0.9
    assert np.mean(truth[field.states == OCCUPIED] < 0.5 * voxel_size) > 0.988


def test_space_behind_surfaces_and_out_of_view_stays_unknown(capture):
    depths, X_WCs = capture
    box = np.full(3, -0.5), np.array([4.5, 3.5, 3.0])
    field = esdf_from_depth_images(depths[:1], K, X_WCs[:1], *box, 0.1, max_range=2.0)
    p_WC, R_WC = X_WCs[0].translation(), X_WCs[0].rotation().matrix()
    p = np.stack(np.meshgrid(*field.voxel_centers(), indexing="ij"), -1)
    p_C = (p - p_WC) @ R_WC
    slope = np.abs(p_C[..., :2]) / np.maximum(p_C[..., 2:], 1e-9)
    seen = (p_C[..., 2] > 0.0) & (slope[..., 0] <= 1.0) & (slope[..., 1] <= 0.75)
    seen &= np.linalg.norm(p_C, axis=-1) <= 2.0
    assert (field.states[~seen] == UNKNOWN).all()
    open_air = seen & (ROOM.distance(p) > 0.3) & (p[..., 0] < 2.0)
    assert (field.states[open_air] == FREE).mean() > 0.97
    assert (field.states[ROOM.distance(p) < -0.35] == UNKNOWN).all()


def test_skipping_unseen_blocks_changes_nothing(capture, monkeypatch):
    (depths, X_WCs), voxel_size = capture, 0.037
    box = np.array([0.3, 0.2, -0.1]), np.array([2.9, 2.6, 1.6])
    skipping = esdf_from_depth_images(depths[:5], K, X_WCs[:5], *box, voxel_size)
    everywhere = lambda self, depth, K, center_C, max_range: np.arange(len(center_C))  # noqa: E731
    monkeypatch.setattr(DepthFusion, "visible_blocks", everywhere)
    complete = esdf_from_depth_images(depths[:5], K, X_WCs[:5], *box, voxel_size)
    np.testing.assert_array_equal(skipping.states, complete.states)
    np.testing.assert_array_equal(skipping.distances, complete.distances)


def wall(distance: float, slope: float = 0.0) -> np.ndarray:
    """The depth of a plane z = distance + slope x of the camera frame."""
    u = (np.arange(WIDTH) + 0.5 - 60.0) / 60.0
    return np.tile((distance / (1.0 - slope * u)).astype(np.float32), (HEIGHT, 1))


@pytest.mark.parametrize("slope", [0.0, 1.0, 2.0])
def test_a_wall_is_measured_along_its_normal(slope):
    field = esdf_from_depth_images([wall(1.5, slope)], K, [RigidTransform()], *BOX, 0.05)
    p = np.stack(np.meshgrid(*field.voxel_centers(), indexing="ij"), -1)
    plane = (1.5 + slope * p[..., 0] - p[..., 2]) / np.sqrt(1.0 + slope**2)
    # Away from the sides of the box, beyond which the wall continues.
    near = (np.abs(plane) < 0.07) & (np.abs(p[..., 0]) < 0.4) & (field.states != UNKNOWN)
    assert np.count_nonzero(near) > 300
    # A pixel is 2.5 cm wide there, a voxel takes the depth of the pixel it falls in.
    np.testing.assert_allclose(field.distances[near], plane[near], atol=0.02)
    assert abs(np.mean(field.distances[near] - plane[near])) < 0.004


@pytest.mark.parametrize("unknown", [0.0, np.nan, -1.0])
def test_pixels_without_depth_are_ignored(unknown):
    depth = wall(1.5)
    depth[:, :60] = unknown
    field = esdf_from_depth_images([depth], K, [RigidTransform()], *BOX, 0.05)
    half = field.shape[0] // 2
    assert (field.states[:half] == UNKNOWN).all()
    assert (field.states[half:] == FREE).any() and (field.states[half:] == OCCUPIED).any()


def test_the_sky_clears_the_space_before_it():
    half_sky = wall(1.5)
    half_sky[:, :60] = np.inf
    field = esdf_from_depth_images([half_sky], K, [RigidTransform()], *BOX, 0.05, max_range=2.0)
    sample = field.query([[-0.2, 0.0, 0.5], [-0.2, 0.0, 1.7], [-0.2, 0.0, 2.2], [0.2, 0.0, 1.6]])
    np.testing.assert_array_equal(sample.state, [FREE, FREE, UNKNOWN, OCCUPIED])
    both = [half_sky, wall(1.5)], K, [RigidTransform()] * 2
    field = esdf_from_depth_images(*both, *BOX, 0.05)
    assert (field.query([[-0.2, 0.0, 1.56], [0.2, 0.0, 1.56]]).state == OCCUPIED).all()
    _, upper_W = bounds_of_depth_images([half_sky], K, [RigidTransform()])
    np.testing.assert_allclose(upper_W[2], 1.7, atol=1e-6)


def test_bounds_hold_all_seen_points_and_cameras(capture):
    depths, X_WCs = capture
    lower_W, upper_W = bounds_of_depth_images(depths, K, X_WCs)
    np.testing.assert_allclose(lower_W, [-0.2, -0.2, -0.2], atol=0.01)
    np.testing.assert_allclose(upper_W, [4.2, 3.2, 2.7], atol=0.01)
    X_WC = RigidTransform(np.array([1.0, 2.0, 3.0]))
    lower_W, upper_W = bounds_of_depth_images([wall(9.0)], K, [X_WC], max_range=2.0)
    assert (lower_W >= X_WC.translation() - 2.2).all()
    assert 5.1 < upper_W[2] <= 5.2 and lower_W[2] == 2.8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depths": [wall(1.0)] * 3}, "one per pose, 1, got 3"),
        ({"depths": [np.zeros((4, 4, 3))]}, r"depth image 0 must be .* got \(4, 4, 3\)"),
        ({"depths": [wall(1.0), np.ones((4, 4))]}, r"depth image 1 must be .* got \(4, 4\)"),
        ({"K": np.diag([0.0, 60.0, 1.0])}, "positive focal lengths"),
        ({"max_range": 0.0}, r"max_range must be .* got 0.0"),
        ({"upper_W": np.zeros(3)}, "upper_W must be finite and above"),
    ],
)
def test_bad_arguments_are_refused(change, message):
    good = {"depths": [wall(1.0)], "K": K, "X_WCs": [RigidTransform()], "voxel_size": 0.1}
    good |= {"lower_W": np.zeros(3), "upper_W": np.ones(3)}
    esdf_from_depth_images(**good)
    with pytest.raises(ValueError, match=message):
        esdf_from_depth_images(**good | change)


def test_unobserved_space_along_the_path_is_free():
    X_WCs = [RigidTransform(R_BC, [x, 1.5, 1.2]) for x in (0.5, 1.0, 3.0)]
    depths = np.zeros((3, HEIGHT, WIDTH))
    depths[0, :, : WIDTH // 2] = 0.05  # a surface right before the first camera
    options = {"lower_W": np.zeros(3), "upper_W": np.array([4, 3, 2.5]), "voxel_size": 0.1}
    without = esdf_from_depth_images(depths, K, X_WCs, **options)
    esdf = esdf_from_depth_images(depths, K, X_WCs, swept_radius=0.35, **options)
    x, y, z = [4, 7, 30, 20], [14, 14, 12, 15], [14, 12, 12, 12]  # voxels
    np.testing.assert_array_equal(esdf.states[x, y, z], [FREE, FREE, FREE, UNKNOWN])
    assert (without.states[x, y, z] == UNKNOWN).all()
    assert esdf.volume(OCCUPIED) == without.volume(OCCUPIED) > 0
