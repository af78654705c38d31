from dataclasses import replace

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.training.captures.capture import Capture, CaptureFrame
from splatpilot.training.reconstruction.photometry import Photometry
from splatpilot.training.reconstruction.views import ShrunkFrames, learn_background

HEIGHT, WIDTH = 48, 64
K = np.array([[32.0, 0, 32], [0, 32.0, 24], [0, 0, 1]])
# Camera axes in W, looking along x.
R_LEVEL = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))


def sky(v_W: np.ndarray) -> np.ndarray:
    """Colors of a smooth sky in the directions v_W (..., 3) of length 1."""
    return 0.5 + 0.3 * v_W[..., [2, 0, 1]]


def frame(yaw: float, gain: float = 1.0, ground: bool = True) -> CaptureFrame:
    """The sky above black ground 2 m below, rotated to the left by `yaw` [rad]."""
    X_WC = RigidTransform(RotationMatrix.MakeZRotation(yaw) @ R_LEVEL, np.zeros(3))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(columns + 0.5 - 32) / 32, (rows + 0.5 - 24) / 32, np.ones((HEIGHT, WIDTH))])
    v_W = np.einsum("ij,jkl->kli", X_WC.rotation().matrix(), rays)
    v_W /= np.linalg.norm(v_W, axis=-1, keepdims=True)
    below = (rows >= 24) & ground
    color = np.where(below[..., None], 0, gain * sky(v_W))
    depth = np.where(below, 2 * 32 / np.maximum(rows + 0.5 - 24, 0.5), np.inf)
    image = np.round(255 * color).astype(np.uint8)
    return CaptureFrame(image, depth.astype(np.float32), X_WC, K)


def test_the_sky_is_learned_and_the_ground_is_not():
    gains = np.array([1.0, 0.8, 1.2, 1.0])
    frames = [frame(yaw, gain) for yaw, gain in zip(np.pi / 2 * np.arange(4), gains, strict=True)]
    background = learn_background(frames, Photometry(gains, 0.0))
    assert isinstance(background, EnvironmentMap)
    rng = np.random.default_rng(0)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, 500), rng.uniform(0.1, 0.4, 500)
    level = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)[:, None]
    v_W = np.column_stack([level, np.sin(elevation)])
    np.testing.assert_allclose(background.color(v_W), sky(v_W), atol=0.02)
    assert np.abs(np.diff(background.texels, axis=0)).max() < 0.1
    assert background.texels.min() > 0.15


def test_depth_beyond_the_far_limit_is_sky():
    distant = frame(0.0, ground=False)
    depth = np.where(np.isinf(distant.depth), np.float32(151), distant.depth)
    one = Photometry(np.ones(1), 0.0)
    a, b = (learn_background([f], one) for f in (distant, replace(distant, depth=depth)))
    assert isinstance(a, EnvironmentMap) and isinstance(b, EnvironmentMap)
    np.testing.assert_array_equal(a.texels, b.texels)


def test_without_sky_the_background_is_the_mean_color():
    inside = replace(frame(0.0, ground=False), depth=np.full((HEIGHT, WIDTH), 3, np.float32))
    dimmer = replace(inside, image=(0.5 * inside.image).astype(np.uint8))
    background = learn_background([inside, dimmer], Photometry(np.array([1, 0.5]), 0.0))
    np.testing.assert_allclose(background, inside.image.mean((0, 1)) / 255, atol=0.01)


def test_cached_frames_keep_images_and_masks_and_round_depth():
    rng = np.random.default_rng(0)
    depth = np.exp(rng.uniform(np.log(0.01), np.log(140), (HEIGHT, WIDTH))).astype(np.float32)
    depth[:8], depth[8:16] = 0, np.inf
    masked = replace(frame(0.5), depth=depth, valid=rng.random((HEIGHT, WIDTH)) > 0.2)
    frames = [masked, replace(frame(1.0), depth=depth)]
    capture = Capture(
        *("room", "a room", K, WIDTH, HEIGHT, [each.X_WC for each in frames]),
        load_image=lambda i: frames[i].image,
        load_depth=lambda i: frames[i].depth,
        load_valid=lambda i: frames[i].valid,
    )
    kept = ShrunkFrames(capture, [1, 0], 1)
    for _ in range(2):  # loaded, then cached
        for found, given in zip(kept, frames[::-1], strict=True):
            expected = np.where(given.valid, given.depth, 0)
            np.testing.assert_allclose(found.depth, expected, rtol=1e-4)
            np.testing.assert_array_equal(found.image, given.image)
            np.testing.assert_array_equal(found.valid, given.valid)
