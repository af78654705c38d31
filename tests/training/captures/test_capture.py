import dataclasses
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.training.captures import capture
from splatpilot.training.captures.capture_config import (
    CaptureConfig,
    cache_folder,
    cache_key,
    prepare_cache,
)

K = capture.pinhole(46.0, 46.0, 32.0, 24.0)
RAYS = np.random.default_rng(0).uniform(-0.7, 0.7, (50, 2))


def test_fourth_radial_term_is_of_the_eighth_power():
    lens = capture.opencv_lens(K, 64, 48, [0.02, -0.01, 0, 0, 0.005], k4=0.12)
    r2 = (RAYS**2).sum(axis=1, keepdims=True)
    stretch = 1 + 0.02 * r2 - 0.01 * r2**2 + 0.005 * r2**3 + 0.12 * r2**4
    np.testing.assert_allclose(lens.pixels(RAYS), 46 * stretch * RAYS + [32, 24], atol=1e-9)


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


@pytest.mark.parametrize("center", [(64.8, 24.0), (32.0, -1.0)])
def test_principal_point_outside_the_image_is_refused(center):
    with pytest.raises(ValueError, match=r"principal point must be in the image of 64x48 px, got"):
        capture.Lens(capture.pinhole(46, 46, *center), 64, 48)


@pytest.mark.parametrize(("cx", "eccentric"), [(32, False), (47, False), (49, True), (15, True)])
def test_eccentric_lenses_are_recognized(cx, eccentric):
    assert capture.Lens(capture.pinhole(46, 46, cx, 24), 64, 48).is_eccentric == eccentric


K_D = np.array([[58.5, 0, 32], [0, 58.5, 24], [0, 0, 1.0]])
K_C = np.array([[52.0, 0, 32], [0, 52.0, 24], [0, 0, 1.0]])


def plane_depth(n, d, K, width, height):
    v, u = np.mgrid[0:height, 0:width] + 0.5
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    return d / (rays @ n)


@pytest.mark.parametrize("finer", [1, 3])
def test_plane(finer):
    X_CD = RigidTransform(RotationMatrix.MakeYRotation(0.05), [0.024, 0.005, -0.01])
    K = np.diag([finer, finer, 1]) @ K_C
    n, d = np.array([0.2, -0.1, 1.0]), 2.0
    n_C = X_CD.rotation().multiply(n)
    d_C = d + n_C @ X_CD.translation()
    depth = plane_depth(n, d, K_D, 64, 48).astype(np.float32)
    got = capture.register_depth(
        depth, capture.DepthCamera(K_D, 64, 48, X_CD), K, 64 * finer, 48 * finer
    )
    want = plane_depth(n_C, d_C, K, 64 * finer, 48 * finer)
    inner = np.s_[8 * finer : -8 * finer, 8 * finer : -8 * finer]
    # Half a pixel of the coarser camera on this slope.
    np.testing.assert_allclose(got[inner], want[inner], rtol=0.004)


def test_nearer_surface_hides_the_farther():
    depth = np.full((48, 64), 4.0, np.float32)
    depth[:, 20:30] = 1.0
    got = capture.register_depth(
        depth, capture.DepthCamera(K_D, 64, 48, RigidTransform([0.3, 0, 0])), K_D, 64, 48
    )
    shift = 0.3 * 58.5
    covered = got[:, int(np.ceil(20 + shift)) : int(30 + shift)]
    np.testing.assert_array_equal(covered, 1.0)


def make_frame(depth: np.ndarray) -> capture.CaptureFrame:
    height, width = depth.shape
    K = np.array([[30.0, 0, width / 2], [0, 30.0, height / 2], [0, 0, 1]])
    image = np.arange(height * width * 3, dtype=np.uint8).reshape(height, width, 3)
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


def test_edges_holes_and_sky():
    inf = np.inf
    depth = np.array(
        [
            [1, 5, 0, 0, inf, inf, 0, 4],
            [1, 5, 0, 3, inf, inf, 4, 4],
            [1, 1, 2, inf, 0, 0, 1, 1.02],
            [5, 5, 2, inf, 0, 0, 1, 1.02],
        ]
    )
    expected = [[1, 0, inf, 4], [1, 2, 0, 2 / (1 + 1 / 1.02)]]
    np.testing.assert_allclose(capture.shrink(make_frame(depth), 2).depth, expected, rtol=1e-6)


def test_shrunken_pixels_are_valid_if_all_replaced_ones_are():
    frame = make_frame(np.ones((5, 8)))
    valid = np.ones((5, 8), bool)
    valid[1, 2] = valid[3, 6:] = valid[4] = False
    small = capture.shrink(dataclasses.replace(frame, valid=valid), 2)
    expected = [[True, False, True, True], [True, True, True, False]]
    np.testing.assert_array_equal(small.valid, expected)
    np.testing.assert_array_equal(small.depth > 0, expected)


def test_colors_are_averaged():
    frame = make_frame(np.ones((4, 6)))
    mean = frame.image.reshape(2, 2, 3, 2, 3).mean(axis=(1, 3))
    assert np.abs(capture.shrink(frame, 2).image - mean).max() <= 0.5


def test_cache_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder(CaptureConfig(cache="here"), "bags", "a") == Path("here")
    assert cache_folder(CaptureConfig(), "bags", "a") == tmp_path / "splatpilot/bags/a"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder(CaptureConfig(), "bags") == Path.home() / ".cache/splatpilot/bags"


def test_cache_keys(tmp_path):
    one, other = tmp_path / "a", tmp_path / "b"
    one.write_text("1")
    other.write_text("1")
    names = [cache_key([one], 2), cache_key([other], 2), cache_key([one], 3)]
    assert cache_key([one], 2) == names[0]
    one.write_text("12")
    names.append(cache_key([one], 2))
    assert len(set(names)) == 4


def test_cache_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"file/deep: cannot be written .*; set capture\.cache to"):
        prepare_cache(tmp_path / "file/deep")
    prepare_cache(tmp_path / "made/deep")
    assert (tmp_path / "made/deep").is_dir()
