import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.captures.tartanair import read_tartanair_v1
from splatpilot.training.reconstruction.photometry import (
    STRIDE,
    ThinnedFrame,
    find_new_pixels,
    seen_pixels,
)


@pytest.fixture
def views(tmp_path, write_room) -> list[ThinnedFrame]:
    return [
        ThinnedFrame.of(frame)
        for frame in read_tartanair_v1(write_room(tmp_path / "room")).frames()
    ]


def test_points_lie_on_the_walls(views, room_in_W):
    """The points of a view are on the surfaces that it shows."""
    lower, upper = room_in_W
    for view in views:
        p_WQ, index = view.points()
        assert len(index) == view.depth.size == (64 // STRIDE) * (48 // STRIDE)
        p_WQ = p_WQ.T
        to_wall = np.minimum(np.abs(p_WQ - lower), np.abs(p_WQ - upper)).min(axis=-1)
        assert to_wall.max() < 1e-5


def test_a_view_finds_its_own_points(views):
    """Every point of a view is found in that view, in its own pixel."""
    p_WQ, index = views[1].points()
    number, shown = views[1].find(p_WQ)
    np.testing.assert_array_equal(number, np.arange(len(index)))
    np.testing.assert_array_equal(shown, index)


def test_found_pixels_show_the_same_place(views):
    """Pixels found for the points of another view show points no farther off than a few pixels."""
    p_WQ, _ = views[0].points()
    number, shown = views[1].find(p_WQ)
    assert len(number) > 100
    other_WQ, index = views[1].points()
    np.testing.assert_array_equal(index, np.arange(views[1].depth.size))
    distance = np.linalg.norm(p_WQ[:, number] - other_WQ[:, shown], axis=0)
    assert (distance < 4 * STRIDE * views[1].pixel_size.flat[shown]).all()


def test_hidden_and_outside_points_are_not_found(views):
    """Points behind a wall, behind the camera or beside the image are not found."""
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
    """Of a wall, a camera to the left saw what lies in its image and nothing to the right of that;
    one that saw another wall before it saw none of it. The sky counts as seen."""
    frame, beside = wall(0.0), ThinnedFrame.of(wall(-0.5))
    seen = seen_pixels(frame, [beside])
    assert seen[:8].all()
    assert seen[8:, :47].all() and not seen[8:, 49:].any()
    other = ThinnedFrame.of(wall(0.0, depth=1.5))
    assert not seen_pixels(frame, [other])[8:].any()
    assert seen_pixels(frame, [other, beside, ThinnedFrame.of(wall(0.5))])[8:].all()


def test_pixel_size_of_a_slanted_plane():
    """On a plane at 60 degrees to the image, pixels are twice as long as on a parallel one."""
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
    """Each point of each view is shown by a kept pixel somewhere, and few are kept twice."""
    new = find_new_pixels(views)
    shown_by = np.concatenate([sum_of_kept(views, new, view.points()[0]) for view in views])
    assert np.mean(shown_by == 0) < 0.06
    assert np.mean(shown_by > 2) < 0.1


def test_slow_walk_keeps_little_more_than_one_view(tmp_path, write_room):
    """Of ten views a hand's breadth apart, little more is kept than one of them shows."""
    poses = [((2 + 0.05 * i, 0.0, -1.2), 1.2, -0.3) for i in range(10)]
    views = [
        ThinnedFrame.of(frame)
        for frame in read_tartanair_v1(write_room(tmp_path / "walk", poses=poses)).frames()
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
    """A view visited last keeps little of what others show as finely."""
    twice = [views[0], views[0], views[3]]
    first = find_new_pixels(twice)
    last = find_new_pixels(twice, last=[0])
    assert first[0].any() and not first[1].any()
    assert last[1].any() and not last[0].any()
