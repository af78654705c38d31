import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.reconstruction.photometry import (
    STRIDE,
    Photometry,
    ThinnedFrame,
    estimate_photometry,
    find_new_pixels,
    radius_squared,
    seen_pixels,
    vignette,
)


def test_recovers_gains_and_vignetting(tmp_path, write_room):
    truth = Photometry(np.exp(0.1 * np.sin(np.arange(12))), -0.25)
    truth = Photometry(truth.gains / np.exp(np.log(truth.gains).mean()), truth.vignetting)
    room = write_room(
        tmp_path / "room",
        width=160,
        height=120,
        brightness=lambda i, rho: truth.gains[i] * np.exp(truth.vignetting * rho),
    )
    views = [ThinnedFrame.of(frame) for frame in read_capture(room).frames()]
    found = estimate_photometry(views, seed=0)
    np.testing.assert_allclose(found.gains, truth.gains, rtol=0.02)
    assert found.vignetting == pytest.approx(truth.vignetting, abs=0.03)
    again = estimate_photometry(views, seed=0)
    np.testing.assert_array_equal(found.gains, again.gains)


def test_views_that_share_nothing_have_gain_one(tmp_path, write_room):
    views = [
        ThinnedFrame.of(frame) for frame in read_capture(write_room(tmp_path / "room")).frames()
    ][:1]
    found = estimate_photometry(views, seed=0)
    assert (found.gains.tolist(), found.vignetting) == ([1.0], 0.0)


def test_factor_is_gain_in_the_center_and_darker_in_the_corners():
    factor = Photometry(np.array([1.0, 2.0]), -0.5).factor(1, 481, 641)
    assert factor.shape == (481, 641)
    assert factor[240, 320] == pytest.approx(2)
    assert factor[0, 0] == pytest.approx(2 * np.exp(-0.5), rel=5e-3)


@pytest.fixture
def views(tmp_path, write_room) -> list[ThinnedFrame]:
    return [
        ThinnedFrame.of(frame) for frame in read_capture(write_room(tmp_path / "room")).frames()
    ]


def test_points_lie_on_the_walls(views, room_in_W):
    lower, upper = room_in_W
    for view in views:
        p_WQ, index = view.points()
        assert len(index) == view.depth.size == (64 // STRIDE) * (48 // STRIDE)
        p_WQ = p_WQ.T
        to_wall = np.minimum(np.abs(p_WQ - lower), np.abs(p_WQ - upper)).min(axis=-1)
        assert to_wall.max() < 1e-5


def test_a_view_finds_its_own_points(views):
    p_WQ, index = views[1].points()
    number, shown = views[1].find(p_WQ)
    np.testing.assert_array_equal(number, np.arange(len(index)))
    np.testing.assert_array_equal(shown, index)


def test_found_pixels_show_the_same_place(views):
    p_WQ, _ = views[0].points()
    number, shown = views[1].find(p_WQ)
    assert len(number) > 100
    other_WQ, index = views[1].points()
    np.testing.assert_array_equal(index, np.arange(views[1].depth.size))
    distance = np.linalg.norm(p_WQ[:, number] - other_WQ[:, shown], axis=0)
    assert (distance < 4 * STRIDE * views[1].pixel_size.flat[shown]).all()


def test_hidden_and_outside_points_are_not_found(views):
    X_WC = views[0].X_WC
    seen = X_WC.multiply(np.array([[0.0], [0.0], [views[0].depth[12, 16]]]))
    assert len(views[0].find(seen)[0]) == 1
    for p_CQ in ([0, 0, 20.0], [0, 0, 0.5], [0, 0, -2.0], [50.0, 0, 1.0]):
        assert len(views[0].find(X_WC.multiply(np.array(p_CQ)[:, None]))[0]) == 0


def wall(x: float, depth: float = 2.0) -> CaptureFrame:
    """A wall parallel to the image of a camera at `x` [m], 2 m wide there; sky above it."""
    image = np.full((48, 64, 3), 128, np.uint8)
    distances = np.full((48, 64), depth, np.float32)
    distances[:8] = np.inf
    K = np.array([[64.0, 0, 32], [0, 64.0, 24], [0, 0, 1]])
    return CaptureFrame(image, distances, RigidTransform([x, 0.0, 0.0]), K)


def test_seen_is_what_another_camera_saw():
    frame, beside = wall(0.0), ThinnedFrame.of(wall(-0.5))
    seen = seen_pixels(frame, [beside])
    assert seen[:8].all()
    assert seen[8:, :47].all() and not seen[8:, 49:].any()
    other = ThinnedFrame.of(wall(0.0, depth=1.5))
    assert not seen_pixels(frame, [other])[8:].any()
    assert seen_pixels(frame, [other, beside, ThinnedFrame.of(wall(0.5))])[8:].all()


def test_pixel_size_of_a_slanted_plane():
    X_WC = RigidTransform()
    K = np.array([[200.0, 0, 32], [0, 200.0, 24], [0, 0, 1]])
    u = (np.arange(64) + 0.5 - 32) / 200
    flat = np.full((48, 64), 2, np.float32)
    slanted = np.tile(np.float32(2 / (1 - np.tan(np.pi / 3) * u)), (48, 1))
    image = np.zeros((48, 64, 3), np.uint8)
    sizes = [
        ThinnedFrame.of(CaptureFrame(image, depth, X_WC, K)).pixel_size[12, 16]
        for depth in (flat, slanted)
    ]
    assert sizes[0] == pytest.approx(2 / 200, rel=1e-3)
    assert sizes[1] == pytest.approx(2 * 2 / 200, rel=0.05)


def test_every_point_is_kept_once_or_nearly_so(views):
    new = find_new_pixels(views)
    shown_by = np.concatenate([sum_of_kept(views, new, view.points()[0]) for view in views])
    assert np.mean(shown_by == 0) < 0.06
    assert np.mean(shown_by > 2) < 0.1


def test_slow_walk_keeps_little_more_than_one_view(tmp_path, write_room):
    poses = [((2 + 0.05 * i, 0.0, -1.2), 1.2, -0.3) for i in range(10)]
    views = [
        ThinnedFrame.of(frame)
        for frame in read_capture(write_room(tmp_path / "walk", poses=poses)).frames()
    ]
    new = find_new_pixels(views)
    assert 1 <= sum(mask.mean() for mask in new) < 2


def sum_of_kept(views, new, p_WQ) -> np.ndarray:
    """For each point, how many views keep a pixel there (or right beside it)."""
    count = np.zeros(p_WQ.shape[1], dtype=int)
    for view, mask in zip(views, new, strict=True):
        number, shown = view.find(p_WQ)
        count[number] += mask.flat[shown]
    return count


def test_views_named_last_yield_to_others(views):
    twice = [views[0], views[0], views[3]]
    first = find_new_pixels(twice)
    last = find_new_pixels(twice, last=[0])
    assert first[0].any() and not first[1].any()
    assert last[1].any() and not last[0].any()


def test_corners_have_the_radius_one():
    found = radius_squared(41, 31)
    assert found.shape == (31, 41)
    assert found[15, 20] == 0
    assert found[0, 0] == pytest.approx((20**2 + 15**2) / (20.5**2 + 15.5**2))
    np.testing.assert_allclose(vignette(-0.5, 41, 31), np.exp(-0.5 * found))
