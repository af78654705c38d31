from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from baked_scenes import (
    HEIGHT,
    LEVELS,
    WIDTH,
    X_WC,
    K,
    plane,
    plane_depth,
    random_scene,
    uniform_scene,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from random_scenes import random_scene as random_gaussians
from reference_rasterizer import median_depth

from splatpilot.systems.collision.shapes import MovingSpheres
from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.baked_scene import (
    BakedScene,
    BatchRenderer,
    create_renderer,
    placed_together,
)
from splatpilot.systems.splats.lens import Distortion, pixel_slopes
from splatpilot.systems.splats.moving_bodies import MovingObstacles
from splatpilot.systems.splats.rasterization import rasterize
from splatpilot.systems.splats.scene import ARRAYS, GaussianScene

CAMERA = K, WIDTH, HEIGHT
LENSES = [None, Distortion("fisheye", [0.05, 0.0, 0.0, 0.0])]


def assert_equal_views(got, expected) -> None:
    for one, other in zip(got, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def rasterized(scene, background=(0.0, 0.0, 0.0), X=X_WC, render_mode="RGB+MD", **options):
    names = ("means", "quats", "scales", "opacities")
    image, alpha, _ = rasterize(
        **{name: torch.from_numpy(getattr(scene, name)) for name in names},
        colors=torch.from_numpy(scene.sh),
        viewmats=torch.from_numpy(X.inverse().GetAsMatrix4().astype(np.float32))[None],
        Ks=torch.from_numpy(K.astype(np.float32))[None],
        width=WIDTH,
        height=HEIGHT,
        sh_degree=scene.sh_degree,
        backgrounds=torch.tensor([background]),
        render_mode=render_mode,
        **options,
    )
    return image[0].numpy(), alpha[0, ..., 0].numpy()


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize(
    ("degree", "count", "inside"),
    [(0, 4000, True), (1, 0, False), (1, 17, False), (2, 1003, False), (3, 1003, False)],
)
def test_agrees_with_rasterize(simd, degree, count, inside):
    scene = random_scene(sh_degree=degree, count=count)
    background = (0.2, 0.5, 0.9)
    X = RigidTransform(RollPitchYaw(0.8, -1.4, -2.8), [-2.4, 1.6, 2.1]) if inside else X_WC
    view = BakedScene(scene, simd=simd).render(*CAMERA, X, background=background)
    image, alpha = rasterized(scene, background, X, renderer=create_renderer(1, simd))
    assert bool(alpha.any()) == bool(count)
    for got, expected in zip(view, (image[..., :3], image[..., 3], alpha), strict=True):
        assert got.shape == expected.shape and got.dtype == np.float32
        error = np.abs(got - expected)
        assert np.median(error) < 2e-6 and np.quantile(error, 0.999) < 2e-2
        assert count > 100 or error.max() < 1e-4


@pytest.mark.parametrize("degree", [0, 3])
def test_other_colors_equal_a_new_scene(degree):
    scene = random_scene(count=3000, sh_degree=1)
    other = replace(scene, sh=random_scene(count=3000, seed=1, sh_degree=degree).sh)
    baked = BakedScene(scene)
    before = baked.render(*CAMERA, X_WC)
    view = baked.recolored(other.sh).render(*CAMERA, X_WC)
    assert_equal_views(view, BakedScene(other).render(*CAMERA, X_WC))
    assert np.abs(view.color - before.color).mean() > 0.01
    assert_equal_views(baked.render(*CAMERA, X_WC), before)


@pytest.mark.parametrize("simd", LEVELS)
def test_threads_and_repeats_give_identical_views(simd):
    scene = random_scene(count=5000)
    first = BakedScene(scene, simd=simd).render(*CAMERA, X_WC)
    shared = BakedScene(scene, threads=3, simd=simd)

    def render(repeat):
        shared.render(K, 20, 90 + repeat, RigidTransform([0, 0, -5.0]))
        return shared.render(*CAMERA, X_WC)

    with ThreadPoolExecutor(3) as pool:
        for view in pool.map(render, range(6)):
            assert_equal_views(view, first)


def test_near_and_far_cut_by_depth_of_center():
    scene = random_scene()
    baked = BakedScene(scene)
    view = baked.render(*CAMERA, X_WC, near=2.5, far=3.0)
    z = (X_WC.inverse() @ scene.means.T)[2]
    between = (z > 2.5) & (z < 3.0)
    assert 0 < between.sum() < len(scene)
    alone = GaussianScene(*(getattr(scene, name)[between] for name in ARRAYS))
    assert_equal_views(view, BakedScene(alone).render(*CAMERA, X_WC))
    assert not baked.render(*CAMERA, X_WC, near=50.0).alpha.any()


def camera(**change):
    arguments = {"K": K, "width": WIDTH, "height": HEIGHT, "X_WC": X_WC} | change
    return lambda scene: scene.render_depth(**arguments)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (camera(K=np.eye(4)), r"K must be of shape \(3, 3\), got \(4, 4\)"),
        (camera(height=-1), "image size must be .* got 83 x -1"),
        (camera(near=0.0), "0 < near < far"),
        (camera(max_depth=-1.0), "max_depth must be > 0 m, got -1"),
        (camera(background=(1.0, 2.0)), r"background must be 3 finite numbers, got \[1.0, 2.0\]"),
        (lambda scene: scene.recolored(np.zeros((5, 3))), r"of shape \(5, K, 3\), got \(5, 3\)"),
        (lambda scene: scene.recolored(np.zeros((4, 1, 3))), r"\(5, K, 3\), got \(4, 1, 3\)"),
        (lambda scene: scene.recolored(np.zeros((5, 2, 3))), "1, 4, 9 or 16, got 2"),
        (
            lambda scene: BatchRenderer(2).render_depth([scene] * 2, *CAMERA, [X_WC]),
            "number of poses must be that of scenes, 2, got 1",
        ),
        (
            lambda scene: BatchRenderer().render([scene], *CAMERA, [X_WC], backgrounds=[]),
            "number of backgrounds must be that of scenes, 1, got 0",
        ),
        (lambda _: create_renderer(simd="v9"), "'v9' is not available"),
    ],
)
def test_invalid_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(BakedScene(random_scene(count=5)))


def test_environment_selects_the_simd_level(monkeypatch):
    for level in LEVELS:
        monkeypatch.setenv("SPLATPILOT_SIMD", level)
        assert create_renderer().simd == level


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("size", [0.02, 1.0, 6.0])
@pytest.mark.parametrize("antialiased", [False, True])
def test_depth_or_color_rendered_alone_is_identical(simd, lens, size, antialiased):
    moving = placed_together([random_scene(count=200, seed=1, sh_degree=0)])
    scene = replace(random_scene(count=3000), antialiased=antialiased)
    scene = BakedScene(replace(scene, scales=np.float32(size) * scene.scales), simd=simd)
    options = {"background": (0.1, 0.2, 0.3), "moving": moving, "distortion": lens}
    for X, max_depth, spread in (
        (X_WC, 2.0, 0.0),
        (X_WC, np.inf, 2.0),
        (RigidTransform([0.1, 0.2, -0.5]), 0.2, 0.0),
        (RigidTransform([0.1, 0.2, -0.5]), np.inf, 0.0),
    ):
        options |= {"max_depth": max_depth, "merged_spread": spread}
        view = scene.render(*CAMERA, X, **options)
        np.testing.assert_array_equal(scene.render_depth(*CAMERA, X, **options), view.depth)
        np.testing.assert_array_equal(scene.render_color(*CAMERA, X, **options), view.color)
        assert max_depth < np.inf or (view.depth > 0).mean() > 0.1


@pytest.mark.parametrize("lens", [*LENSES, Distortion("opencv", [-1e-6])])
@pytest.mark.parametrize("sky", [False, True])
def test_rows_are_those_of_the_whole_image(lens, sky):
    texels = np.random.default_rng(0).uniform(size=(8, 16, 3)).astype(np.float32)
    behind = EnvironmentMap(texels) if sky else (0.1, 0.2, 0.3)
    scene = BakedScene(random_scene(count=3000))
    options = {"background": behind, "distortion": lens}
    whole = scene.render(*CAMERA, X_WC, **options)
    for rows in ((0, 1), (7, 8), (HEIGHT - 5, HEIGHT)):
        part = scene.render(*CAMERA, X_WC, rows=rows, **options)
        for one, other in zip(part, whole, strict=True):
            np.testing.assert_allclose(one, other[slice(*rows)], atol=1e-5)
        batch = BatchRenderer().render(
            [scene], *CAMERA, [X_WC], backgrounds=[behind], distortion=lens, rows=rows
        )
        assert_equal_views([image[0] for image in batch], part)
    for rows in ((3, HEIGHT + 1), (5, 5)):
        with pytest.raises(ValueError, match=r"rows must be in \[0, .*\], ascending, got"):
            scene.render(*CAMERA, X_WC, rows=rows)


@pytest.mark.parametrize("simd", LEVELS)
def test_gaussians_beyond_max_depth_hide_nothing(simd):
    scales = np.array([[4.0, 4.0, 0.001], [1.75, 1.75, 0.001]])
    quats = np.array([[1.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]])
    scene = uniform_scene([[0.0, 0.0, 6.0], [0.0, 2.0, 6.5]], scales, 1.0, quat=quats)
    baked = BakedScene(scene, simd=simd)
    floor = 2.0 / ((57.5 - 30.0) / 75.0)  # 2 m below, at the slope of row 57
    for max_depth, expected in ((5.6, floor), (7.0, 6.0)):
        depth = baked.render_depth(*CAMERA, RigidTransform(), max_depth=max_depth)
        assert depth[57, 41] == pytest.approx(expected, abs=0.001)


SIZE = {"width": 67, "height": 45}
K_WALL = np.array([[40.0, 0, 32.0], [0, 40.0, 18.0], [0, 0, 1]])


def test_median_depth_agrees_with_reference():
    scene = random_gaussians(count=900)
    expected, margin = median_depth(scene, **SIZE)
    clear = margin > 1e-3
    assert clear.float().mean() > 0.5 and (expected[clear] > 0).float().mean() > 0.5
    for simd in LEVELS:
        renderer = create_renderer(2, simd)
        plain, alpha, _ = rasterize(**scene, **SIZE, renderer=renderer)
        for mode in ("MD", "RGB+MD"):
            image, also_alpha, _ = rasterize(**scene, **SIZE, render_mode=mode, renderer=renderer)
            error = (image[0, ..., -1].double() - expected).abs() / expected.clamp(min=1)
            assert error[clear].median() < 1e-6 and error[clear].max() < 2e-3
            assert (error > 2e-3).float().mean() < 0.01
            assert torch.equal(alpha, also_alpha)
        assert torch.equal(image[..., :3], plain)


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize(("deviation", "limit"), [(0.3, 0.05), (0.15, 1e-5)])
def test_large_gaussians_close_to_the_camera_are_no_haze(simd, deviation, limit):
    X_CP = RigidTransform(RotationMatrix.MakeXRotation(np.pi / 2), [0.0, 0.5, 0.0])
    truth = plane_depth(X_CP, pixel_slopes(None, K_WALL, **SIZE))
    above = np.arange(SIZE["height"]) + 0.5 < K_WALL[1, 2]
    near = ~above[:, None] & (truth < 8.0)
    assert near.mean() > 0.4
    floor = BakedScene(plane(X_CP, 12.0, step=deviation / 0.7), simd=simd)
    depth = floor.render_depth(K_WALL, **SIZE, X_WC=RigidTransform())
    assert (depth[above] == 0).all()
    assert np.median(np.abs(depth / truth - 1)[near]) < limit


def test_median_depth_has_no_gradient():
    scene = random_gaussians(count=200)
    gradients = []
    for mode in ("RGB", "RGB+MD"):
        means = scene["means"].clone().requires_grad_()
        image, _, _ = rasterize(**scene | {"means": means}, **SIZE, render_mode=mode)
        (image[..., :3].square().sum() + image[..., 3:].sum()).backward()
        gradients.append(means.grad)
    assert torch.equal(*gradients)


def test_a_moving_body_is_drawn_like_a_static_one_and_an_absent_one_not():
    scene, body = random_scene(2048, seed=1, sh_degree=1), random_scene(300, seed=2, sh_degree=0)
    center = np.array([0.3, 0.2, 0.5])
    paths = [np.stack([0.0 * center, center]), np.full((1, 3), np.inf)]
    moving = MovingObstacles(MovingSpheres([1.0, 1.0], paths, 1.0), [body] * 2)
    merged = BakedScene(scene.merged_with(body.transformed_by(RigidTransform(center))))
    expected = merged.render(*CAMERA, X_WC, background=(0.1, 0.2, 0.3))
    options = {"background": (0.1, 0.2, 0.3), "moving": moving.gaussians(1.0)}
    view = BakedScene(scene).render(*CAMERA, X_WC, **options)
    np.testing.assert_allclose(view.color, expected.color, rtol=0, atol=2e-3)
    np.testing.assert_allclose(view.alpha, expected.alpha, rtol=0, atol=2e-3)
    assert np.mean(np.abs(view.depth - expected.depth) > 1e-3) < 2e-3


def test_antialiased_scenes_are_rendered_as_they_were_trained():
    scene = replace(random_scene(400), scales=np.full((400, 3), 2e-3, np.float32))
    plain = BakedScene(scene).render(*CAMERA, X_WC)
    marked = replace(scene, antialiased=True).scaled_by(1)
    found = BakedScene(marked).recolored(scene.sh).render(*CAMERA, X_WC)
    alpha = rasterized(scene, rasterize_mode="antialiased", render_mode="RGB")[1]
    np.testing.assert_allclose(found.alpha, np.asarray(alpha).reshape(HEIGHT, WIDTH), atol=2e-5)
    assert found.alpha.mean() < 0.5 * plain.alpha.mean()


@pytest.mark.parametrize("lens", LENSES)
def test_images_of_a_batch_are_those_of_each_view(lens):
    scenes = [BakedScene(random_scene(sh_degree=1, count=500 + k)) for k in (0, 1)] * 2
    X_WCs = [RigidTransform([0.1 * k, 0.0, -0.05 * k]) @ X_WC for k in range(4)]
    sky = EnvironmentMap(np.random.default_rng(0).uniform(size=(4, 8, 3)).astype(np.float32))
    backgrounds = [sky, *((0.1 * k, 0.2, 0.3) for k in range(3))]
    batch, clip, options = BatchRenderer(3), (0.1, 50.0), {"distortion": lens, "max_depth": 9.0}
    views = batch.render(scenes, *CAMERA, X_WCs, *clip, backgrounds=backgrounds, **options)
    depths = batch.render_depth(scenes, *CAMERA, X_WCs, *clip, **options)
    np.testing.assert_array_equal(depths, views.depth)
    for k, (scene, X) in enumerate(zip(scenes, X_WCs, strict=True)):
        view = scene.render(*CAMERA, X, *clip, backgrounds[k], **options)
        assert_equal_views([image[k] for image in views], view)


def textured_wall(reach=4.5, sh_degree=0):
    """Returns a wall at z = 3 m of Gaussians 3 cm apart, with waves of color."""
    y, x = (grid.ravel() for grid in np.mgrid[-reach:reach:0.03, -reach:reach:0.03])
    colors = 0.5 + 0.4 * np.stack([np.sin(4 * x), np.sin(4 * y), np.sin(3 * x + 2 * y)], -1)
    means = np.column_stack([x, y, np.full_like(x, 3.0)])
    scene = uniform_scene(means, [0.021, 0.021, 1e-3], 0.9, colors)
    pads = ((0, 0), (0, (sh_degree + 1) ** 2 - 1), (0, 0))
    return replace(scene, sh=np.pad(scene.sh, pads))


def test_merged_neighbors_show_the_same_picture():
    wall = textured_wall(sh_degree=2)
    small = np.array([[24.0, 0, 24.0], [0, 24.0, 18.0], [0, 0, 1]])
    fine = np.array([[192.0, 0, 192.0], [0, 192.0, 144.0], [0, 0, 1]])
    X = RigidTransform(RollPitchYaw(0.1, 0.1, 0.2), np.zeros(3))
    truth = BakedScene(wall).render_color(fine, 384, 288, X).reshape(36, 8, 48, 8, 3).mean((1, 3))
    for simd in LEVELS:
        scene = BakedScene(wall, simd=simd)
        plain, merged = (scene.render(small, 48, 36, X, merged_spread=s) for s in (0.0, 1.0))
        errors = [np.abs(view.color - truth).mean() for view in (plain, merged)]
        assert errors[1] < 0.8 * errors[0]
        np.testing.assert_array_equal(merged.depth, plain.depth)
        assert merged.alpha.mean() > 0.99


def test_recolored_scenes_keep_their_merged_neighbors():
    wall = textured_wall(reach=2.0)
    scene = BakedScene(wall)
    view = scene.render(*CAMERA, RigidTransform(), merged_spread=2.0)
    inverted = replace(wall, sh=-wall.sh)
    for baked in (scene.recolored(inverted.sh), BakedScene(inverted)):
        image = baked.render_color(*CAMERA, RigidTransform(), merged_spread=2.0)
        np.testing.assert_allclose(image + view.color, view.alpha[..., None] * [1, 1, 1], atol=1e-4)


@pytest.mark.parametrize("count", [0, 130])
def test_few_gaussians_far_apart_do_not_merge(count):
    scene = BakedScene(random_scene(count))
    assert_equal_views(*(scene.render(*CAMERA, X_WC, merged_spread=s) for s in (0.0, 1e-3)))
