import numpy as np
import pytest
from pydrake.math import RigidTransform
from room import write_room_capture

from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.reconstruction import photometry


def thin(folder) -> list[photometry.ThinnedFrame]:
    return [photometry.ThinnedFrame.of(frame) for frame in read_capture(folder).frames()]


@pytest.fixture(scope="module")
def views(tmp_path_factory) -> list[photometry.ThinnedFrame]:
    return thin(write_room_capture(tmp_path_factory.mktemp("room") / "room"))


def test_recovers_gains_and_vignetting(tmp_path):
    gains = np.exp(0.1 * np.sin(np.arange(12)))
    truth = photometry.Photometry(gains / np.exp(np.log(gains).mean()), -0.25)
    room = write_room_capture(
        tmp_path / "room",
        width=160,
        height=120,
        brightness=lambda i, rho: truth.gains[i] * np.exp(truth.vignetting * rho),
    )
    views = thin(room)
    found, again = (photometry.estimate_photometry(views, seed=0) for _ in "ab")
    np.testing.assert_allclose(found.gains, truth.gains, rtol=0.02)
    assert found.vignetting == pytest.approx(truth.vignetting, abs=0.03)
    np.testing.assert_array_equal(found.gains, again.gains)
    alone = photometry.estimate_photometry(views[:1], seed=0)
    assert (alone.gains.tolist(), alone.vignetting) == ([1.0], 0.0)


def test_factor_is_gain_in_the_center_and_darker_in_the_corners():
    rho_squared = photometry.radius_squared(41, 31)
    assert rho_squared.shape == (31, 41) and rho_squared[15, 20] == 0
    assert rho_squared[0, 0] == pytest.approx((20**2 + 15**2) / (20.5**2 + 15.5**2))
    np.testing.assert_allclose(photometry.vignette(-0.5, 41, 31), np.exp(-0.5 * rho_squared))
    factor = photometry.Photometry(np.array([1.0, 2.0]), -0.5).factor(1, 31, 41)
    np.testing.assert_allclose(factor, 2 * np.exp(-0.5 * rho_squared), rtol=1e-6)


def wall(x: float, depth: float = 2.0) -> CaptureFrame:
    """A wall parallel to the image of a camera at `x` [m], 2 m wide there; sky above it."""
    image = np.full((48, 64, 3), 128, np.uint8)
    distances = np.full((48, 64), depth, np.float32)
    distances[:8] = np.inf
    K = np.array([[64.0, 0, 32], [0, 64.0, 24], [0, 0, 1]])
    return CaptureFrame(image, distances, RigidTransform([x, 0.0, 0.0]), K)


def test_seen_pixels_are_those_that_another_camera_saw():
    frame, beside = wall(0.0), photometry.ThinnedFrame.of(wall(-0.5))
    seen = photometry.seen_pixels(frame, [beside])
    assert seen[:8].all()
    assert seen[8:, :47].all() and not seen[8:, 49:].any()
    other = photometry.ThinnedFrame.of(wall(0.0, depth=1.5))
    assert not photometry.seen_pixels(frame, [other])[8:].any()
    every = [other, beside, photometry.ThinnedFrame.of(wall(0.5))]
    assert photometry.seen_pixels(frame, every)[8:].all()


@pytest.mark.parametrize(("slope", "size", "tolerance"), [(0, 1, 1e-3), (np.pi / 3, 2, 0.05)])
def test_pixel_size_of_a_plane(slope, size, tolerance):
    K = np.array([[200.0, 0, 32], [0, 200.0, 24], [0, 0, 1]])
    u = (np.arange(64) + 0.5 - 32) / 200
    depth = np.tile(np.float32(2 / (1 - np.tan(slope) * u)), (48, 1))
    frame = CaptureFrame(np.zeros((48, 64, 3), np.uint8), depth, RigidTransform(), K)
    found = photometry.ThinnedFrame.of(frame).pixel_size[12, 16]
    assert found == pytest.approx(size * 2 / 200, rel=tolerance)


def test_every_point_is_kept_about_once_and_of_views_named_last_if_no_other_has_it(views):
    new, counts = photometry.find_new_pixels(views), []
    for view in views:
        p_WQ, _ = view.points()
        count = np.zeros(p_WQ.shape[1], dtype=int)
        for other, mask in zip(views, new, strict=True):
            number, shown = other.find(p_WQ)
            count[number] += mask.flat[shown]
        counts.append(count)
    assert np.mean(np.concatenate(counts) == 0) < 0.06
    assert np.mean(np.concatenate(counts) > 2) < 0.1
    twice = [views[0], views[0], views[3]]
    for last, kept, dropped in (([], 0, 1), ([0], 1, 0)):
        new = photometry.find_new_pixels(twice, last=last)
        assert new[kept].any() and not new[dropped].any()


def test_gains_of_a_video_are_interpolated_and_those_of_photographs_are_not():
    numbers = np.arange(40)
    smooth = np.exp(0.2 * np.sin(numbers / 6))
    fitted, others = numbers[numbers % 4 != 0], numbers[numbers % 4 == 0]
    found = photometry.predict_gains(fitted.tolist(), smooth[fitted], others.tolist())
    np.testing.assert_allclose(found[1:], smooth[others][1:], rtol=0.01)
    jumping = np.exp(0.2 * (-1.0) ** np.arange(len(fitted)))
    found = photometry.predict_gains(fitted.tolist(), jumping, others.tolist())
    np.testing.assert_array_equal(found, 1.0)
    np.testing.assert_array_equal(photometry.predict_gains([3], np.ones(1), [0, 9]), 1.0)


def test_found_pixels_show_the_same_points(views):
    p_WQ, index = views[1].points()
    number, shown = views[1].find(p_WQ)
    np.testing.assert_array_equal(number, index)
    np.testing.assert_array_equal(shown, index)
    other_WQ, _ = views[0].points()
    number, shown = views[1].find(other_WQ)
    assert len(number) > 100
    distance = np.linalg.norm(other_WQ[:, number] - p_WQ[:, shown], axis=0)
    assert (distance < 4 * views[1].stride * views[1].pixel_size.flat[shown]).all()
    X_WC = views[0].X_WC
    depth = views[0].depth[12, 16]
    for p_CQ, found in (
        ([0, 0, depth], 1),
        ([0, 0, 20.0], 0),  # hidden
        ([0, 0, 0.5], 0),
        ([0, 0, -2.0], 0),
        ([50.0, 0, 1.0], 0),
    ):
        assert len(views[0].find(X_WC.multiply(np.array(p_CQ)[:, None]))[0]) == found
