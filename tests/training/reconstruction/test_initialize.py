import re
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from room import write_room_capture

from splatpilot.systems.splats.background import FAR
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.training.captures.capture import (
    Capture,
    CaptureFrame,
    SfmPoints,
    no_depth,
    pixel_rays,
    project_points,
)
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.reconstruction import initialize
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.photometry import (
    Photometry,
    ThinnedFrame,
    estimate_photometry,
)


@pytest.mark.parametrize(
    ("count", "has_depth", "iterations", "expected"),
    [
        (71, True, -1, 2000),  # 62 of them are fitted: 1984 would be too few
        (160, True, -1, 140 * 32),
        (700, True, -1, 7000),
        (71, False, -1, 7000),
        (700, True, 123, 123),
        (71, True, 0, 0),
    ],
)
def test_steps_follow_the_fitted_images(count, has_depth, iterations, expected):
    depth = {} if has_depth else {"load_depth": no_depth}
    capture = Capture("", "", K, WIDTH, HEIGHT, [X_WC] * count, None, **{"load_depth": ""} | depth)
    resolved = initialize.resolve_config(ReconstructConfig(iterations=iterations), capture)
    assert resolved.iterations == expected
    assert resolved.initialization == ("depth" if has_depth else "points")


@pytest.mark.parametrize(
    ("hold_out", "in_files", "expected"),
    [(-1, None, [0, 8]), (-1, [3, 4], [3, 4]), (5, [3, 4], [0, 5]), (0, [3, 4], [])],
)
def test_held_out_frames(hold_out, in_files, expected):
    config = ReconstructConfig(hold_out=hold_out)
    capture = Capture("", "", K, WIDTH, HEIGHT, [X_WC] * 10, None, held_out=in_files)
    assert initialize.held_out_frames(capture, config) == expected


def from_depth(frames, **changes):
    photometry = estimate_photometry([ThinnedFrame.of(frame) for frame in frames], 0)
    options = {"max_gaussians": 100_000, "contrast": 1.0, "optimized": True, "max_extent": 0.2}
    return initialize.gaussians_from_depth(frames, photometry, **options | changes)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return read_capture(write_room_capture(tmp_path_factory.mktemp("room") / "room"))


def test_the_sky_has_no_gaussians(capture):
    frames, below = list(capture.frames()), []
    for frame in frames:
        depth = frame.depth.copy()
        depth[:10], depth[10:14] = np.inf, 1e4
        below.append(replace(frame, depth=depth))
    whole, below = from_depth(frames), from_depth(below)
    assert 0 < len(below) < len(whole)
    assert np.abs(below.means).max() <= np.abs(whole.means).max() + 0.1


def test_the_maximum_number_of_gaussians_is_kept(capture):
    for most, expected in ((0, 1_000_000), (500, 500)):
        config = initialize.resolve_config(ReconstructConfig(max_gaussians=most), capture)
        assert config.max_gaussians == expected
    frames = list(capture.frames())
    photometry = estimate_photometry([ThinnedFrame.of(frame) for frame in frames], 0)
    made = initialize.make_initial_gaussians(capture, frames, photometry, 1.0, config)
    assert len(made) <= 500


@pytest.mark.parametrize("initialization", ["points", "random"])
@pytest.mark.parametrize(
    ("initial", "most", "expected"), [(0, 0, 300), (0, 200, 200), (100, 200, 100), (250, 200, 200)]
)
def test_points_keep_the_maximum_number(
    capture, monkeypatch, initialization, initial, most, expected
):
    monkeypatch.setattr(initialize, "_RANDOM", 300)
    p_WQ = np.random.default_rng(0).uniform(0, 5, (300, 3))
    points = replace(capture, points=SfmPoints(p_WQ, p_WQ / 5))
    config = ReconstructConfig(
        initialization=initialization, initial_gaussians=initial, max_gaussians=most
    )
    config = initialize.resolve_config(config, points)
    photometry, frames = Photometry(np.ones(len(capture)), 0.0), list(capture.frames())
    made = initialize.make_initial_gaussians(points, frames, photometry, 1.0, config)
    assert len(made) == expected
    if initialization == "points":
        np.testing.assert_allclose(made.base_colors, made.means / 5, atol=1e-5)


def test_too_many_gaussians_to_optimize_are_sampled(capture, capsys):
    frames = list(capture.frames())
    every = from_depth(frames)
    assert "would cover" not in capsys.readouterr().err
    some = from_depth(frames, max_gaussians=20)
    assert len(some) == 20 < len(every)
    message = capsys.readouterr().err
    assert "20 Gaussians cover " in message
    number = re.search(r"; (\d+) would cover", message)
    assert number and 20 < int(number[1]) <= len(every)
    assert set(map(tuple, some.means)) <= set(map(tuple, every.means))
    assert np.linalg.norm(some.scales, axis=1).mean() > np.linalg.norm(every.scales, axis=1).mean()
    with pytest.raises(ValueError, match="20 Gaussians are too few"):
        from_depth(frames, max_gaussians=20, optimized=False)


def test_invalid_pixels_give_no_gaussians(capture):
    magenta, valid = np.uint8([255, 0, 255]), np.ones((capture.height, capture.width), bool)
    valid[15:33, 20:44] = False
    masked = replace(
        capture,
        load_image=lambda i: np.where(valid[..., None], capture.load_image(i), magenta),
        load_valid=lambda i: valid,
    )
    frames = list(masked.frames())
    _, colors = initialize.random_points(frames, 5000, 0.5, 8.0, seed=0)
    for found in (from_depth(frames).base_colors, colors):
        assert len(found) > 500
        assert not ((np.abs(found - magenta / 255) < 0.05).all(axis=1)).any()


def test_random_points_lie_in_view_and_become_gaussians_of_their_spacing(capture):
    frame = capture.frame(2)
    p_WQ, colors = initialize.random_points([frame], 500, 0.5, 8.0, seed=1)
    assert p_WQ.shape == (500, 3)
    p_CQ = frame.X_WC.inverse().multiply(p_WQ.T).T
    assert p_CQ[:, 2].min() >= 0.5 and 4 < p_CQ[:, 2].max() <= 8
    inside, v, u = project_points(frame.K, p_CQ, capture.width, capture.height)
    assert inside.all()
    np.testing.assert_array_equal(frame.image[v, u], colors * 255)
    p_WQ = np.stack(np.meshgrid(*[0.2 * np.arange(5)] * 3), axis=-1).reshape(-1, 3)
    scene = initialize.gaussians_from_points(p_WQ, colors[:125])
    np.testing.assert_allclose(scene.scales, 0.1, rtol=1e-5)
    np.testing.assert_allclose(scene.means, p_WQ, rtol=1e-6)
    np.testing.assert_allclose(scene.base_colors, colors[:125], atol=1e-5)
    with pytest.raises(ValueError, match="3 points are too few"):
        initialize.gaussians_from_points(p_WQ[:3], colors[:3])


HEIGHT, WIDTH, F = 48, 64, 50.0
K = np.array([[F, 0, WIDTH / 2], [0, F, HEIGHT / 2], [0, 0, 1]])
X_WC = RigidTransform(RollPitchYaw(0.3, -0.2, 1.0), np.array([1.0, 2.0, 3.0]))
GRAY = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
ALL = np.ones((HEIGHT, WIDTH), bool)


def plane_frame(normal_C, distance: float) -> CaptureFrame:
    """Depth of the plane normal . p = distance, seen by a camera at X_WC."""
    depth = distance / (pixel_rays(K, WIDTH, HEIGHT) @ np.asarray(normal_C))
    return CaptureFrame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth.astype(np.float32), X_WC, K)


def covered(cells) -> np.ndarray:
    """Counts the cells of each pixel."""
    count = np.zeros((HEIGHT, WIDTH), int)
    for u, v, size in zip(cells.u, cells.v, cells.size, strict=True):
        rows = slice(int(v - size / 2), int(v + size / 2))
        count[rows, int(u - size / 2) : int(u + size / 2)] += 1
    return count


@pytest.mark.parametrize(("rows", "columns"), [(48, 64), (45, 59)])
def test_plain_plane_takes_the_largest_cells(rows, columns):
    whole, part = plane_frame([0.5, 0.2, 0.8], 1.6), (slice(rows), slice(columns))
    frame = CaptureFrame(whole.image[part], whole.depth[part], X_WC, K)
    means = initialize.BlockMeans(frame, GRAY[part], ALL[part], 8)
    cells = means.split(0.05, 8, 0.75, 9)
    assert (set(cells.size) == {8}) == (rows == 48)
    assert (covered(cells)[:rows, :columns] == 1).all()


def test_texture_and_edges_take_small_cells_and_pixels_without_depth_or_mask_none():
    frame, mask = plane_frame([0, 0, 1], 2.0), ALL.copy()
    depth = frame.depth.copy()
    depth[:, 41:] = 3.0
    image = GRAY.copy()
    image[20] = 0.1
    means = initialize.BlockMeans(replace(frame, depth=depth), image, mask, 8)
    cells = means.split(0.05, 8, 0.75, 9)
    assert (covered(cells) == 1).all()
    on_step = np.abs(cells.u - 41) < 1
    assert set(cells.size[on_step]) == {1}
    on_line = (np.abs(cells.v - 20.5) < cells.size / 2 + 0.1) & (np.abs(cells.u - 20) < 10)
    assert set(cells.size[on_line]) == {2}
    assert set(cells.size[(cells.v > 32) & (cells.u < 32)]) == {8}
    depth[:4], depth[4:8] = 0, np.inf
    mask[:, 32:] = False
    means = initialize.BlockMeans(replace(frame, depth=depth), GRAY, mask, 8)
    expected = mask & (np.arange(HEIGHT) >= 8)[:, None]
    np.testing.assert_array_equal(covered(means.split(1, 8, 0.75, 9)), expected)


def test_gaussians_are_flat_and_cover_their_cell_in_the_image():
    normal_C = np.array([0.3, -0.4, 0.85])
    normal_C /= np.linalg.norm(normal_C)
    frame = plane_frame(normal_C, 2.0)
    cells = initialize.BlockMeans(frame, GRAY, ALL, 4).split(0.05, 4, 0.75, 9)
    p_WQ, covariances = initialize.cell_gaussians(frame, cells, spread=0.5)
    R_CW = X_WC.rotation().matrix().T
    p_CQ, covariances = X_WC.inverse().multiply(p_WQ.T).T, R_CW @ covariances @ R_CW.T
    np.testing.assert_allclose(p_CQ @ normal_C, 2.0, atol=1e-5)
    for (x, y, z), covariance in zip(p_CQ, covariances, strict=True):
        across, narrow, _ = np.linalg.eigvalsh(covariance) ** 0.5
        assert (normal_C @ covariance @ normal_C) ** 0.5 == pytest.approx(across, rel=1e-3)
        assert across < 0.25 * narrow
        J = F / z * np.array([[1, 0, -x / z], [0, 1, -y / z]])
        image = J @ covariance @ J.T
        np.testing.assert_allclose(image, np.diag([(0.5 * 4) ** 2] * 2), rtol=0.02, atol=0.08)


def test_cells_do_not_extend_too_far():
    frame = plane_frame([0.6, 0, 0.8], 1.0)
    cells = initialize.BlockMeans(frame, GRAY, ALL, 16).split(1, 16, 0.75, 0.1)
    assert (covered(cells) == 1).all()
    _, covariances = initialize.cell_gaussians(frame, cells, spread=1)
    longest = np.sqrt(np.linalg.eigvalsh(covariances)[:, 2])
    large = cells.size > 1
    assert large.any()
    # The edges of a cell are not at right angles on the surface: its longest axis may be more.
    assert (longest[large] < np.sqrt(2) * 0.1 / cells.w[large]).all()


def test_underlay_lies_behind_and_closes_gaps():
    wide = K * np.array([[10, 1, 1], [1, 10, 1], [1, 1, 1]])
    depth = np.full((HEIGHT, WIDTH), 2, np.float32)
    frame = CaptureFrame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth, X_WC, wide)
    p_WQ, covariances, colors = initialize.frame_gaussians(frame, GRAY, ALL, 0.05, 4, 1.0)
    z = X_WC.inverse().multiply(p_WQ.T)[2]
    surface, under = np.abs(z - 2) < 1e-5, np.abs(z - 2.06) < 1e-5
    assert (surface.sum(), under.sum(), len(z)) == (12 * 16, 6 * 8, 12 * 16 + 6 * 8)
    widths = np.sqrt(np.linalg.eigvalsh(covariances)[:, 1:])
    np.testing.assert_allclose(widths[surface].mean(), 0.4 * 4 * 2 / (10 * F), rtol=0.01)
    np.testing.assert_allclose(widths[under].mean(), 0.6 * 8 * 2.06 / (10 * F), rtol=0.01)
    np.testing.assert_allclose(colors, 0.5)


def test_gaussians_to_optimize_cover_all_that_the_frames_show(capture):
    frames = [frame for frame in capture.frames() if frame is not None]
    scene = BakedScene(from_depth(frames, contrast=0.03))
    for frame in frames:
        height, width = frame.depth.shape
        shown = scene.render_depth(frame.K, width, height, frame.X_WC)
        assert np.all(shown[(frame.depth > 0) & (frame.depth < FAR)] > 0)


@pytest.mark.parametrize("tilt", [0.0, 20.0])
def test_gaussians_of_pixels_lie_on_the_surface(tilt):
    F, rows = 400.0, np.arange(16) + 0.5
    depth = np.repeat(1 / (1 + tilt / F * (rows - 8))[:, None], 16, axis=1).astype(np.float32)
    K = np.array([[F, 0, 8], [0, F, 8], [0, 0, 1]])
    frame = CaptureFrame(np.zeros((16, 16, 3), np.uint8), depth, RigidTransform(), K)
    everything = np.ones((16, 16), bool), 0.03, 1, 0.06
    _, covariances, _ = initialize.frame_gaussians(
        frame, np.zeros((16, 16, 3)), *everything, underlay=False
    )
    length = np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    inner = (slice(1, -1), slice(None))
    expected = 0.65 / F * np.hypot(1, tilt * depth[inner]) * depth[inner]
    np.testing.assert_allclose(length.reshape(16, 16)[inner], expected, rtol=0.02)


def test_third_principal_axis_is_the_normal():
    R, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(20, 3, 3)))
    covariances = R @ np.diag([0.04, 1e-6, 0.01]) @ R.transpose(0, 2, 1)
    quats, scales = initialize.principal_axes(covariances)
    np.testing.assert_allclose(scales, [[0.2, 0.1, 1e-3]] * 20, rtol=1e-3)
    found = np.array([RotationMatrix(Quaternion(quat)).matrix() for quat in quats])
    axes = found * scales[:, None]
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), covariances, atol=1e-10)
    _, flat = initialize.principal_axes(np.diag([0.0, 1.0, 4.0])[None])
    assert (flat > 0).all() and flat.max() == pytest.approx(2)
