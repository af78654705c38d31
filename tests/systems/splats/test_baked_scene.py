"""Tests of the baked renderer."""

import subprocess
import sys
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from baked_scenes import HEIGHT, LEVELS, WIDTH, X_WC, K, random_scene
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.systems.splats import rasterize
from splatpilot.systems.splats.baked_scene import BakedScene, create_renderer
from splatpilot.systems.splats.scene import GaussianScene


def rasterized(scene, background=(0.0, 0.0, 0.0), X=X_WC, **options):
    image, alpha, _ = rasterize(
        means=torch.from_numpy(scene.means),
        quats=torch.from_numpy(scene.quats),
        scales=torch.from_numpy(scene.scales),
        opacities=torch.from_numpy(scene.opacities),
        colors=torch.from_numpy(scene.sh),
        viewmats=torch.from_numpy(X.inverse().GetAsMatrix4().astype(np.float32))[None],
        Ks=torch.from_numpy(K.astype(np.float32))[None],
        width=WIDTH,
        height=HEIGHT,
        sh_degree=scene.sh_degree,
        backgrounds=torch.tensor([background]),
        render_mode="RGB+MD",
        **options,
    )
    return image[0].numpy(), alpha[0, ..., 0].numpy()


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_agrees_with_rasterize(simd, degree):
    """Baking changes the order of work, not the picture: colour, median depth and alpha agree."""
    scene = random_scene(sh_degree=degree, count=1003)
    background = (0.2, 0.5, 0.9)
    view = BakedScene(scene, simd=simd).render(K, WIDTH, HEIGHT, X_WC, background=background)
    image, alpha = rasterized(scene, background, renderer=create_renderer(1, simd))
    assert view.color.shape == (HEIGHT, WIDTH, 3) and view.color.dtype == np.float32
    assert view.depth.shape == view.alpha.shape == (HEIGHT, WIDTH)
    for got, want in (
        (view.color, image[..., :3]),
        (view.depth, image[..., 3]),
        (view.alpha, alpha),
    ):
        error = np.abs(got - want)
        assert np.median(error) < 2e-6 and np.quantile(error, 0.999) < 2e-2


@pytest.mark.parametrize("seed", range(8))
def test_culling_by_boxes_loses_nothing(seed):
    """From cameras inside, at the edge of and outside the scene, no visible Gaussian is dropped."""
    rng = np.random.default_rng(seed)
    scene = random_scene(count=4000, seed=seed, sh_degree=0)
    X = RigidTransform(RollPitchYaw(*rng.uniform(-3, 3, 3)), rng.uniform(-2.5, 2.5, 3))
    view = BakedScene(scene).render(K, WIDTH, HEIGHT, X)
    image, alpha = rasterized(scene, X=X)
    assert alpha.any()
    assert np.mean(np.abs(view.color - image[..., :3]) > 1e-3) < 1e-3
    assert np.mean(np.abs(view.alpha - alpha) > 1e-3) < 1e-3


@pytest.mark.parametrize("degree", [0, 3])
def test_other_colours_are_as_if_baked_anew(degree):
    """Bit for bit, whatever the degree that the scene was baked with; its own colours stay."""
    scene = random_scene(count=3000, sh_degree=1)
    other = replace(scene, sh=random_scene(count=3000, seed=1, sh_degree=degree).sh)
    baked = BakedScene(scene)
    before = baked.render(K, WIDTH, HEIGHT, X_WC)
    view = baked.recolored(other.sh).render(K, WIDTH, HEIGHT, X_WC)
    for one, same in zip(view, BakedScene(other).render(K, WIDTH, HEIGHT, X_WC), strict=True):
        np.testing.assert_array_equal(one, same)
    assert np.abs(view.color - before.color).mean() > 0.01
    np.testing.assert_array_equal(baked.render(K, WIDTH, HEIGHT, X_WC).color, before.color)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((300, 3), r"\(300, 3\); it must be \(300, K, 3\)"),
        ((299, 1, 3), r"\(299, 1, 3\); it must be \(300, K, 3\)"),
        ((300, 2, 3), "1, 4, 9 or 16"),
    ],
)
def test_colours_of_other_gaussians_are_refused(shape, message):
    baked = BakedScene(random_scene(count=300))
    with pytest.raises(ValueError, match=message):
        baked.recolored(np.zeros(shape, np.float32))


@pytest.mark.parametrize("simd", LEVELS)
def test_threads_and_repeats_give_equal_bits(simd):
    """The same view has the same bits for any thread count, in any frame, from any thread."""
    scene = random_scene(count=5000)
    first = BakedScene(scene, simd=simd).render(K, WIDTH, HEIGHT, X_WC)
    shared = BakedScene(scene, threads=3, simd=simd)
    views = []

    def fly():
        views.append(shared.render(K, WIDTH, HEIGHT, X_WC))
        shared.render(K, 20, 90, RigidTransform(np.array([0, 0, -5.0])))
        views.append(shared.render(K, WIDTH, HEIGHT, X_WC))

    workers = [threading.Thread(target=fly) for _ in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(views) == 6
    for view in views:
        for got, want in zip(view, first, strict=True):
            np.testing.assert_array_equal(got, want)


def test_views_do_not_share_memory():
    """A view stays as it was when the next one is rendered."""
    baked = BakedScene(random_scene())
    view = baked.render(K, WIDTH, HEIGHT, X_WC)
    copy = view.color.copy()
    baked.render(K, WIDTH, HEIGHT, RigidTransform(np.array([0, 0, -9.0])))
    np.testing.assert_array_equal(view.color, copy)


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 64, 65])
def test_counts_that_do_not_fill_groups(count):
    """Scenes that end inside a pack or a box render as `rasterize` does."""
    scene = random_scene(count=count, sh_degree=1)
    view = BakedScene(scene).render(K, WIDTH, HEIGHT, X_WC)
    image, alpha = rasterized(scene)
    np.testing.assert_allclose(view.alpha, alpha, atol=1e-4)
    np.testing.assert_allclose(view.color, image[..., :3], atol=1e-4)


def test_flat_and_needle_gaussians_keep_their_shape():
    """Covariances of rank one and two, to working precision, survive the baked factorisation."""
    rng = np.random.default_rng(1)
    scene = random_scene(count=200, sh_degree=0)
    scales = scene.scales.copy()
    scales[:100, rng.integers(0, 3)] = 1e-9
    scales[50:150, :2] = 1e-12
    scene = GaussianScene(scene.means, scene.quats, scales, scene.opacities, scene.sh)
    view = BakedScene(scene).render(K, WIDTH, HEIGHT, X_WC)
    image, _ = rasterized(scene)
    assert np.quantile(np.abs(view.color - image[..., :3]), 0.99) < 1e-4


def test_near_and_far_cut_by_depth_of_centre():
    """The Gaussians whose centre is between near and far are drawn, as if there were no others."""
    scene = random_scene()
    baked = BakedScene(scene)
    view = baked.render(K, WIDTH, HEIGHT, X_WC, near=2.5, far=3.0)
    z = (X_WC.inverse() @ scene.means.T)[2]
    between = (z > 2.5) & (z < 3.0)
    assert 0 < between.sum() < len(scene)
    arrays = (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh)
    alone = BakedScene(GaussianScene(*(a[between] for a in arrays))).render(K, WIDTH, HEIGHT, X_WC)
    np.testing.assert_array_equal(view.color, alone.color)
    np.testing.assert_array_equal(view.depth, alone.depth)
    assert not baked.render(K, WIDTH, HEIGHT, X_WC, near=50.0).alpha.any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": np.eye(4)}, r"K has shape \(4, 4\)"),
        ({"K": np.diag([0.0, 1.0, 1.0])}, r"K\[0, 0\] = 0, K\[1, 1\] = 1 must be positive"),
        ({"K": np.diag([1.0, np.nan, 1.0])}, "K has a NaN"),
        ({"width": 0}, "image size is 0 x 61"),
        ({"height": -1}, "image size is 83 x -1"),
        ({"near": 0.0}, "0 < near < far"),
        ({"near": 5.0, "far": 4.0}, "depth range is 5 to 4 m"),
        ({"background": (1.0, 2.0)}, r"background is \[1.0, 2.0\]"),
    ],
)
def test_bad_cameras_are_named(change, message):
    """A camera that makes no sense raises ValueError with the value and the limit."""
    baked = BakedScene(random_scene(count=5))
    arguments = {"K": K, "width": WIDTH, "height": HEIGHT, "X_WC": X_WC} | change
    with pytest.raises(ValueError, match=message):
        baked.render(**arguments)
    if "background" not in change:
        with pytest.raises(ValueError, match=message):
            baked.render_depth(**arguments)


def test_a_greatest_depth_that_is_none_is_named():
    """Depth is rendered up to a positive number of metres."""
    baked = BakedScene(random_scene(count=5))
    for render in (baked.render, baked.render_depth):
        with pytest.raises(ValueError, match="max_depth is -1 m; it must be positive"):
            render(K, WIDTH, HEIGHT, X_WC, max_depth=-1.0)


def test_bad_thread_counts_are_named():
    """Thread counts below one are refused."""
    with pytest.raises(ValueError, match="threads is 0"):
        BakedScene(random_scene(count=5), threads=0)


def test_environment_selects_the_simd_level():
    """SPLATPILOT_SIMD forces a level and is refused when the machine lacks it; torch stays out."""
    code = (
        "import sys; from splatpilot.systems.splats.baked_scene import create_renderer;"
        "print(create_renderer(1).simd, 'torch' in sys.modules)"
    )
    for level in LEVELS:
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={"SPLATPILOT_SIMD": level},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.split() == [level, "False"]
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={"SPLATPILOT_SIMD": "v9"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0 and "'v9' is not available" in done.stderr


def test_only_attributes_of_the_scene_are_needed():
    """Any object with the arrays of a GaussianScene can be baked."""
    scene = random_scene(count=50)
    bare = SimpleNamespace(**{n: getattr(scene, n) for n in scene.__dataclass_fields__})
    np.testing.assert_array_equal(
        BakedScene(bare).render(K, 20, 20, X_WC).color,  # pyright: ignore[reportArgumentType]
        BakedScene(scene).render(K, 20, 20, X_WC).color,
    )
