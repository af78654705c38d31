"""Tests of the baked renderer."""

import subprocess
import sys
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot import _native
from splatpilot.systems.splats import rasterize
from splatpilot.systems.splats.baked_scene import BakedScene, create_renderer
from splatpilot.systems.splats.distortion import Distortion
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.splats.moving_gaussians import PlacedGaussians

LEVELS = _native.simd_levels()
WIDTH, HEIGHT = 83, 61
K = np.array([[70.0, 0, 41.0], [0, 75.0, 30.0], [0, 0, 1]])
X_WC = RigidTransform(RollPitchYaw(0.1, -0.2, 0.3), np.array([0.4, -0.3, -3.0]))


def random_scene(count=1000, seed=0, sh_degree=3):
    rng = np.random.default_rng(seed)
    arrays = (
        1.5 * rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.normal(size=(count, 3)) - 2.5),
        rng.uniform(0.01, 1.0, count),
        0.3 * rng.normal(size=(count, (sh_degree + 1) ** 2, 3)),
    )
    return GaussianScene(*(a.astype(np.float32) for a in arrays))


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


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("lens", [None, Distortion(model="fisheye", radial=[0.05, 0.0, 0.0, 0.0])])
@pytest.mark.parametrize("size", [0.02, 0.3, 1.0, 6.0])
def test_depth_alone_has_the_same_bits(simd, lens, size):
    """For Gaussians of all sizes and tilts, those that fall between the pixels too, among moving
    ones, and through a lens, depth rendered alone is that of the whole view, however far it is
    asked for."""
    bodies = random_scene(count=200, seed=1, sh_degree=0)
    moving = PlacedGaussians(
        *(getattr(bodies, name) for name in ("means", "quats", "scales", "opacities", "sh"))
    )
    scene = random_scene(count=3000)
    scene = BakedScene(replace(scene, scales=np.float32(size) * scene.scales), simd=simd)
    camera = {"K": K, "width": WIDTH, "height": HEIGHT, "moving": moving, "distortion": lens}
    for X in (X_WC, RigidTransform([0.1, 0.2, -0.5])):
        assert (scene.render(X_WC=X, **camera).depth > 0).mean() > 0.1
        for max_depth in (0.2, 1.0, 2.0, 3.0, 5.0, np.inf):
            whole = scene.render(X_WC=X, max_depth=max_depth, **camera).depth
            alone = scene.render_depth(X_WC=X, max_depth=max_depth, **camera)
            np.testing.assert_array_equal(alone, whole)


@pytest.mark.parametrize("simd", LEVELS)
def test_needles_seen_edge_on_have_the_same_depth_alone(simd):
    """Discs without thickness, seen within a thousandth of edge-on, hold few pixels' centres and
    ask much of float32: of depth alone none is missed."""
    rng = np.random.default_rng(4)
    scene = random_scene(count=2000, sh_degree=0)
    towards = scene.means - np.array([0.0, 0.0, -3.0])
    normals = np.cross(towards, rng.normal(size=towards.shape))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals += 1e-3 * rng.normal(size=normals.shape)
    x, y, z = normals.T / np.linalg.norm(normals, axis=1)
    quats = np.stack([1.0 + z, -y, x, np.zeros_like(z)], axis=1)  # turns the z axis to the normal
    scales = np.tile([0.5, 0.5, 1e-5], (len(quats), 1))
    sheets = replace(scene, quats=quats.astype(np.float32), scales=scales.astype(np.float32))
    baked = BakedScene(replace(sheets, opacities=np.ones_like(scene.opacities)), simd=simd)
    X = RigidTransform([0.0, 0.0, -3.0])
    whole = baked.render(K, WIDTH, HEIGHT, X).depth
    assert (whole > 0).mean() > 0.1
    np.testing.assert_array_equal(baked.render_depth(K, WIDTH, HEIGHT, X), whole)


@pytest.mark.parametrize("simd", LEVELS)
def test_a_disc_seen_exactly_edge_on_has_depth_alone(simd):
    """Without any blur it has no area; the pixels along it show it where its centre is."""
    disc = GaussianScene(
        means=np.array([[0.0, 0.0, 2.0]], np.float32),
        quats=np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
        scales=np.array([[1e-30, 0.3, 0.3]], np.float32),
        opacities=np.ones(1, np.float32),
        sh=np.zeros((1, 1, 3), np.float32),
    )
    through_centres = np.array([[70.0, 0, 41.5], [0, 75.0, 30.5], [0, 0, 1]])
    camera = (through_centres, WIDTH, HEIGHT, RigidTransform())
    depth = BakedScene(disc, simd=simd).render_depth(*camera)
    assert depth[30, 41] == pytest.approx(2.0)
    np.testing.assert_array_equal(np.unique(np.nonzero(depth)[1]), [41])


@pytest.mark.parametrize("simd", LEVELS)
def test_what_is_too_far_hides_nothing(simd):
    """A wall at 6 m comes before the floor whose centre is at 6.5 m, though here the floor is seen
    at 5.45 m. In an image of up to 5.6 m the floor is alone."""
    half = 0.5**0.5
    scene = GaussianScene(
        means=np.array([[0.0, 0.0, 6.0], [0.0, 2.0, 6.5]], np.float32),
        quats=np.array([[1.0, 0.0, 0.0, 0.0], [half, half, 0.0, 0.0]], np.float32),
        scales=np.array([[4.0, 4.0, 0.001], [1.75, 1.75, 0.001]], np.float32),
        opacities=np.ones(2, np.float32),
        sh=np.zeros((2, 1, 3), np.float32),
    )
    baked = BakedScene(scene, simd=simd)
    floor = 2.0 / ((57.5 - 30.0) / 75.0)  # 2 m below, at the slope of row 57
    for max_depth, expected in ((5.6, floor), (7.0, 6.0)):
        depth = baked.render_depth(K, WIDTH, HEIGHT, RigidTransform(), max_depth=max_depth)
        assert depth[57, 41] == pytest.approx(expected, abs=0.001)


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
