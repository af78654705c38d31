from dataclasses import replace

import numpy as np
import pytest

from splatpilot.training.captures.tartanair import read_tartanair_v1
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.initialize import (
    Detail,
    gaussians_from_depth,
    gaussians_from_points,
    held_out_frames,
    random_points,
    resolve_config,
)
from splatpilot.training.reconstruction.photometry import ThinnedFrame, estimate_photometry

COARSE = {"contrast": 1.0, "max_cell": 16, "max_extent": 0.2}


class Frames:
    """A capture of so many frames, as far as settings depend on it."""

    points = None

    def __init__(self, count, has_depth, held_out=None):
        self.count, self.has_depth, self.held_out = count, has_depth, held_out

    def __len__(self):
        return self.count


@pytest.mark.parametrize(
    ("count", "has_depth", "asked", "expected"),
    [
        (71, True, -1, 2000),  # 62 of them are fitted: 1984 would be too few
        (160, True, -1, 140 * 32),
        (700, True, -1, 7000),
        (71, False, -1, 7000),
        (700, True, 123, 123),
        (71, True, 0, 0),
    ],
)
def test_steps_follow_the_images_that_are_fitted(count, has_depth, asked, expected):
    """32 for each from 2000 to 7000 where Gaussians start from depth, unless a number is given."""
    config = ReconstructConfig(iterations=asked)
    resolved = resolve_config(config, Frames(count, has_depth))  # pyright: ignore[reportArgumentType]
    assert resolved.iterations == expected
    assert resolved.initialization == ("depth" if has_depth else "random")


def test_no_gaussian_stands_infinitely_far(write_room, tmp_path):
    """Where frames show what is beyond 150 m they put no Gaussian: all stand in the room."""
    capture = read_tartanair_v1(write_room(tmp_path / "room"))

    def with_sky(frame):
        depth = frame.depth.copy()
        depth[:10], depth[10:14] = np.inf, 1e4
        return replace(frame, depth=depth)

    detail = Detail(max_gaussians=100_000, optimized=True, **COARSE)
    scenes = []
    for frames in (list(capture.frames()), [with_sky(frame) for frame in capture.frames()]):
        photometry = estimate_photometry([ThinnedFrame.of(frame) for frame in frames], 0)
        scenes.append(gaussians_from_depth(frames, photometry, detail))
    whole, below = scenes
    assert 0 < len(below) < len(whole)
    assert np.abs(below.means).max() <= np.abs(whole.means).max() + 0.1


def test_too_many_surfaces_to_optimise_are_thinned_out(write_room, tmp_path, capsys):
    """Where even the coarsest cells are too many, exactly as many as allowed are drawn, mostly
    large ones, each of them one of all, and what stays open is said; without optimisation it is an
    error."""
    capture = read_tartanair_v1(write_room(tmp_path / "room"))
    frames = list(capture.frames())
    photometry = estimate_photometry([ThinnedFrame.of(frame) for frame in frames], 0)
    detail = Detail(max_gaussians=100_000, optimized=True, **COARSE)
    every = gaussians_from_depth(frames, photometry, detail)
    assert "would cover" not in capsys.readouterr().err
    some = gaussians_from_depth(frames, photometry, replace(detail, max_gaussians=20))
    assert len(some) == 20 < len(every)
    message = capsys.readouterr().err
    assert "20 Gaussians cover " in message and f"; {len(every)} would cover" in message
    assert set(map(tuple, some.means)) <= set(map(tuple, every.means))
    assert np.linalg.norm(some.scales, axis=1).mean() > np.linalg.norm(every.scales, axis=1).mean()
    with pytest.raises(ValueError, match="20 Gaussians are too few"):
        gaussians_from_depth(frames, photometry, replace(detail, max_gaussians=20, optimized=False))


def test_masked_blob_has_no_part_in_gaussians(write_room, tmp_path):
    capture = read_tartanair_v1(write_room(tmp_path / "room"))
    valid = np.ones((capture.height, capture.width), bool)
    valid[15:33, 20:44] = False
    masked = replace(
        capture,
        load_image=lambda i: np.where(
            valid[..., None], capture.load_image(i), np.uint8([255, 0, 255])
        ),
        load_valid=lambda i: valid,
    )
    frames = list(masked.frames())
    photometry = estimate_photometry([ThinnedFrame.of(frame) for frame in frames], 0)
    detail = Detail(max_gaussians=100_000, optimized=True, **COARSE)
    scene = gaussians_from_depth(frames, photometry, detail)
    _, colors = random_points(frames, 5000, 0.5, 8.0, seed=0)
    for found in (scene.base_colors, colors):
        magenta = (found[:, 0] > 0.95) & (found[:, 1] < 0.05) & (found[:, 2] > 0.95)
        assert len(found) > 500 and not magenta.any()


@pytest.mark.parametrize(
    ("asked", "own", "expected"),
    [
        (-1, None, [0, 8]),
        (-1, [3, 4], [3, 4]),
        (5, [3, 4], [0, 5]),
        (0, [3, 4], []),
    ],
)
def test_frames_held_out_are_those_of_the_files_unless_told_otherwise(asked, own, expected):
    config = ReconstructConfig(hold_out=asked)
    assert held_out_frames(Frames(10, True, own), config) == expected  # pyright: ignore[reportArgumentType]


def test_points_become_gaussians_of_their_spacing():
    """On a grid of points, Gaussians have half its spacing, the points' places and colours."""
    p_WQ = np.stack(np.meshgrid(*[0.2 * np.arange(5)] * 3), axis=-1).reshape(-1, 3)
    colors = np.random.default_rng(0).uniform(size=p_WQ.shape)
    scene = gaussians_from_points(p_WQ, colors)
    np.testing.assert_allclose(scene.scales, 0.1, rtol=1e-5)
    np.testing.assert_allclose(scene.means, p_WQ, rtol=1e-6)
    np.testing.assert_allclose(scene.base_colors, colors, atol=1e-5)
    with pytest.raises(ValueError, match="3 points are too few"):
        gaussians_from_points(p_WQ[:3], colors[:3])


def test_random_points_lie_in_view(write_room, tmp_path):
    """Each random point is seen by the camera that it was drawn for, within the given depths, and
    has the colour of its pixel."""
    frame = read_tartanair_v1(write_room(tmp_path / "room")).frame(2)
    p_WQ, colors = random_points([frame], 500, 0.5, 8.0, seed=1)
    assert p_WQ.shape == (500, 3)
    x, y, z = frame.X_WC.inverse().multiply(p_WQ.T)
    u, v = frame.K[0, 0] * x / z + frame.K[0, 2], frame.K[1, 1] * y / z + frame.K[1, 2]
    assert (0.5 <= z.min()) and (z.max() <= 8) and z.max() > 4
    np.testing.assert_array_equal(frame.image[v.astype(int), u.astype(int)], colors * 255)
