"""Bodies of Gaussians that move, seen among what stands."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from splatpilot import _native
from splatpilot.systems.splats.baked_scene import BakedScene, MovingGaussians
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import SplatCamera

K = np.array([[40.0, 0, 32.0], [0, 40.0, 24.0], [0, 0, 1]])
WIDTH, HEIGHT = 64, 48
X_WC = RigidTransform(np.array([0.2, -0.1, -4.0]))


def random_scene(count: int, seed: int, sh_degree: int = 0) -> GaussianScene:
    rng = np.random.default_rng(seed)
    return GaussianScene(
        rng.normal(size=(count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        np.exp(rng.normal(size=(count, 3)) - 2.5).astype(np.float32),
        rng.uniform(0.1, 1.0, count).astype(np.float32),
        0.3 * rng.normal(size=(count, (sh_degree + 1) ** 2, 3)).astype(np.float32),
    )


def disc(color: tuple[float, float, float]) -> GaussianScene:
    """A flat, opaque patch that faces along z, about the origin."""
    size = np.array([[0.5, 0.5, 0.001]])
    return GaussianScene.from_colors(
        np.zeros((1, 3)), [[1.0, 0, 0, 0]], size, [0.99], np.array([color])
    )


def along(*places: float):
    """From a time to a centre at that place on the z axis."""
    return lambda time: np.array([[0.0, 0.0, places[int(time)]]])


@pytest.mark.parametrize("count", [40, 2047, 2048, 5000])
def test_a_body_is_drawn_like_what_stands(count):
    """Placed among a scene, a body gives the picture of a scene that holds it, colour, median depth
    and alpha, for any number of Gaussians and of degrees of harmonics of the scene."""
    scene, body = random_scene(count, seed=1, sh_degree=1), random_scene(300, seed=2)
    center = np.array([0.3, 0.2, 0.5])
    moving = MovingGaussians([body], lambda time: time * center[None])
    whole = scene.merged_with(body, RigidTransform(center))
    expected = BakedScene(whole).render(K, WIDTH, HEIGHT, X_WC, background=(0.1, 0.2, 0.3))
    view = BakedScene(scene).render(
        K, WIDTH, HEIGHT, X_WC, background=(0.1, 0.2, 0.3), moving=moving.at(1.0)
    )
    for name in ("color", "alpha"):
        difference = np.abs(getattr(view, name) - getattr(expected, name))
        assert difference.max() < 2e-3, name
    far_off = np.abs(view.depth - expected.depth) > 1e-3
    assert far_off.mean() < 2e-3


@pytest.mark.parametrize("simd", _native.simd_levels())
def test_threads_change_no_bit(simd):
    """One thread and three give the same bits, with a body and without; and what stands alone is
    not changed by a body that is nowhere."""
    scene, body = random_scene(5000, seed=1), random_scene(3000, seed=2)
    moving = MovingGaussians([body], lambda time: np.array([[0.0, 0.0, 0.5]]))
    nowhere = MovingGaussians([body], lambda time: np.full((1, 3), np.inf))
    baked = [BakedScene(scene, threads, simd) for threads in (1, 3)]
    one, three = (b.render(K, WIDTH, HEIGHT, X_WC, moving=moving.at(0.0)) for b in baked)
    alone = baked[0].render(K, WIDTH, HEIGHT, X_WC)
    without = baked[0].render(K, WIDTH, HEIGHT, X_WC, moving=nowhere.at(0.0))
    for first, second in ((one, three), (alone, without)):
        for a, b in zip(first, second, strict=True):
            np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one.color, alone.color)


def test_a_body_hides_and_is_hidden():
    """A red body in front of a green patch is what the camera sees, colour and depth; behind it,
    the patch is: whichever is nearer at the time."""
    camera = SplatCamera(
        disc((0.0, 1.0, 0.0)),
        CameraInfo(WIDTH, HEIGHT, 40.0, 40.0, 32.0, 24.0),
        moving=MovingGaussians([disc((1.0, 0.0, 0.0))], along(-1.0, 1.0)),
    )
    context = camera.CreateDefaultContext()
    X_WB = RigidTransform(RotationMatrix(), np.array([0.0, 0.0, -3.0]))
    camera.GetInputPort("body_pose").FixValue(context, X_WB)
    for time, seen, depth in ((0.0, 0, 2.0), (1.0, 1, 3.0), (0.5, 0, 2.0)):
        context.SetTime(time)
        color = camera.color_image_output_port().Eval(context).data[24, 32, :3]
        assert color.argmax() == seen and color.max() > 240
        assert camera.depth_image_32f_output_port().Eval(context).data[24, 32, 0] == (
            pytest.approx(depth, abs=0.01)
        )


def test_late_images_show_bodies_where_they_were():
    """With a latency of 1 s the body is seen where it was then, and at first where it began."""
    info = CameraInfo(WIDTH, HEIGHT, 40.0, 40.0, 32.0, 24.0)
    moving = MovingGaussians([disc((1.0, 0.0, 0.0))], along(1.0, 2.0, 3.0))
    camera = SplatCamera(disc((0.0, 1.0, 0.0)), info, moving=moving, latency=1.0)
    prompt = SplatCamera(disc((0.0, 1.0, 0.0)), info, moving=moving)
    X_WB = RigidTransform(np.array([1.2, 0.0, -3.0]))
    for time, then in ((0.5, 0.0), (1.5, 0.5), (2.5, 1.5)):
        np.testing.assert_array_equal(
            camera.render(X_WB, time).color, prompt.render(X_WB, then).color
        )
    assert not np.array_equal(prompt.render(X_WB, 0.0).color, prompt.render(X_WB, 1.0).color)


def test_no_bodies_are_no_gaussians():
    """A world may have none that move after all."""
    assert len(MovingGaussians([], lambda time: np.zeros((0, 3))).at(0.0).means) == 0
