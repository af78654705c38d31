import dataclasses
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from room import pinhole_rays

from splatpilot.training.captures import capture, capture_config

K = capture.pinhole(46.0, 46.0, 32.0, 24.0)
RAYS = np.random.default_rng(0).uniform(-0.7, 0.7, (50, 2))


def test_fisheye_is_that_of_kannala_and_brandt():
    lens = capture.fisheye_lens(K, 64, 48, [0.1, -0.02, 0.003, 0.001])
    r = np.linalg.norm(RAYS, axis=1, keepdims=True)
    theta = np.arctan(r)
    k = 1 + 0.1 * theta**2 - 0.02 * theta**4 + 0.003 * theta**6 + 0.001 * theta**8
    np.testing.assert_allclose(lens.pixels(RAYS), 46 * theta * k / r * RAYS + [32, 24], atol=1e-9)


def test_pinhole_sees_no_farther_than_the_radius_of_a_lens():
    lens = capture.Lens(K, 64, 48, radius=20.0)
    camera = capture.common_pinhole([lens])
    corner = (np.array([0, 0]) - camera.K[:2, 2]) / np.diag(camera.K)[:2]
    assert np.linalg.norm(lens.pixels(corner[None]) - [32, 24]) == pytest.approx(20, rel=2e-3)


K_D = capture.pinhole(58.5, 58.5, 32, 24)
K_C = capture.pinhole(52, 52, 32, 24)


def plane_depth(n, d, K, width, height):
    return d / (pinhole_rays(K, width, height) @ n[:2] + n[2])


@pytest.mark.parametrize("finer", [1, 3])
def test_depth_of_a_plane_is_registered_to_the_color_camera(finer):
    X_CD = RigidTransform(RotationMatrix.MakeYRotation(0.05), [0.024, 0.005, -0.01])
    K, size = np.diag([finer, finer, 1]) @ K_C, (64 * finer, 48 * finer)
    n, d = np.array([0.2, -0.1, 1.0]), 2.0
    n_C = X_CD.rotation().multiply(n)
    depth = plane_depth(n, d, K_D, 64, 48).astype(np.float32)
    found = capture.register_depth(depth, capture.DepthCamera(K_D, 64, 48, X_CD), K, *size)
    expected = plane_depth(n_C, d + n_C @ X_CD.translation(), K, *size)
    inner = np.s_[8 * finer : -8 * finer, 8 * finer : -8 * finer]
    # Half a pixel of the coarser camera on this slope.
    np.testing.assert_allclose(found[inner], expected[inner], rtol=0.004)


def test_nearer_surface_hides_the_farther():
    depth = np.full((48, 64), 4.0, np.float32)
    depth[:, 20:30] = 1.0
    camera = capture.DepthCamera(K_D, 64, 48, RigidTransform([0.3, 0, 0]))
    shift = 0.3 * 58.5
    covered = np.s_[:, int(np.ceil(20 + shift)) : int(30 + shift)]
    assert (capture.register_depth(depth, camera, K_D, 64, 48)[covered] == 1.0).all()


def make_frame(depth: np.ndarray) -> capture.CaptureFrame:
    height, width = depth.shape
    image = np.arange(height * width * 3, dtype=np.uint8).reshape(height, width, 3)
    K = capture.pinhole(30, 30, width / 2, height / 2)
    return capture.CaptureFrame(image, depth.astype(np.float32), RigidTransform(), K)


@pytest.mark.parametrize(
    ("width", "desired", "factor"), [(640, 320, 2), (640, 0, 1), (100, 320, 1), (2832, 320, 9)]
)
def test_factors_are_whole_and_never_enlarge(width, desired, factor):
    assert capture.shrink_factor(width, desired) == factor


@pytest.mark.parametrize("factor", [2, 3])
def test_a_slanted_plane_keeps_its_depth(factor):
    def plane(K, width, height):
        return plane_depth(np.array([0.3, -0.2, 1.0]), 2, K, width, height)

    frame = make_frame(np.ones((25, 32)))
    small = capture.shrink(make_frame(plane(frame.K, 32, 25)), factor)
    assert small.depth.shape == small.image.shape[:2] == (25 // factor, 32 // factor)
    np.testing.assert_allclose(small.depth, plane(small.K, 32 // factor, 25 // factor), rtol=1e-6)


def test_shrunken_depth_keeps_edges_holes_and_sky_and_colors_are_averaged():
    inf = np.inf
    depth = [
        [1, 5, 0, 0, inf, inf, 0, 4],
        [1, 5, 0, 3, inf, inf, 4, 4],
        [1, 1, 2, inf, 0, 0, 1, 1.02],
        [5, 5, 2, inf, 0, 0, 1, 1.02],
    ]
    valid = np.ones((4, 8), bool)
    valid[1, 4] = False
    frame = dataclasses.replace(make_frame(np.array(depth)), valid=valid)
    small = capture.shrink(frame, 2)
    expected = [[1, 0, 0, 4], [1, 2, 0, 2 / (1 + 1 / 1.02)]]
    np.testing.assert_allclose(small.depth, expected, rtol=1e-6)
    np.testing.assert_array_equal(small.valid, [[True, True, False, True], [True] * 4])
    mean = frame.image.reshape(2, 2, 4, 2, 3).mean(axis=(1, 3))
    assert np.abs(small.image - mean).max() <= 0.5
    sky = capture.shrink(make_frame(np.array(depth)), 2)
    assert sky.depth[0, 2] == inf and sky.valid.all()


def test_cache_keys_are_those_of_files_and_settings(tmp_path):
    one, other = tmp_path / "a", tmp_path / "b"
    one.write_text("1")
    other.write_text("1")
    key = capture_config.cache_key
    names = [key([one], 2), key([other], 2), key([one], 3)]
    assert key([one], 2) == names[0]
    one.write_text("12")
    assert len({*names, key([one], 2)}) == 4


def test_cache_folder_is_made_where_it_can_be_written(tmp_path, monkeypatch):
    here, default = capture_config.CaptureConfig(cache="here"), capture_config.CaptureConfig()
    folder = capture_config.cache_folder
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert folder(here, "bags", "a") == Path("here/bags/a")
    assert folder(default, "bags", "a") == tmp_path / "splatpilot/bags/a"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert folder(default, "bags") == Path.home() / ".cache/splatpilot/bags"
    made = capture_config.cached_folder(tmp_path / "made/deep", lambda written: None)
    assert made.is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"file/deep: cannot be written .*; set capture\.cache to"):
        capture_config.cached_folder(tmp_path / "file/deep/a", lambda written: None)
