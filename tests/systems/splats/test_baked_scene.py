from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from baked_scenes import HEIGHT, LEVELS, WIDTH, X_WC, K, random_scene
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.sensors import CameraInfo
from random_scenes import random_scene as random_gaussians
from reference_rasterizer import median_depth

from splatpilot.systems.collision.shapes import MovingSpheres
from splatpilot.systems.splats import rasterize
from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.baked_scene import (
    BakedScene,
    BatchRenderer,
    MovingGaussians,
    PlacedGaussians,
    create_renderer,
)
from splatpilot.systems.splats.lens import Distortion
from splatpilot.systems.splats.moving_bodies import Bodies, MovingObstacles
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import SplatCamera


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
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_agrees_with_rasterize(simd, degree):
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


@pytest.mark.parametrize("seed", range(2))
def test_culling_by_boxes_loses_nothing(seed):
    rng = np.random.default_rng(seed)
    scene = random_scene(count=4000, seed=seed, sh_degree=0)
    X = RigidTransform(RollPitchYaw(*rng.uniform(-3, 3, 3)), rng.uniform(-2.5, 2.5, 3))
    view = BakedScene(scene).render(K, WIDTH, HEIGHT, X)
    image, alpha = rasterized(scene, X=X)
    assert alpha.any()
    assert np.mean(np.abs(view.color - image[..., :3]) > 1e-3) < 1e-3
    assert np.mean(np.abs(view.alpha - alpha) > 1e-3) < 1e-3


@pytest.mark.parametrize("degree", [0, 3])
def test_other_colors_equal_a_new_scene(degree):
    scene = random_scene(count=3000, sh_degree=1)
    other = replace(scene, sh=random_scene(count=3000, seed=1, sh_degree=degree).sh)
    baked = BakedScene(scene)
    before = baked.render(K, WIDTH, HEIGHT, X_WC)
    view = baked.recolored(other.sh).render(K, WIDTH, HEIGHT, X_WC)
    for one, same in zip(view, BakedScene(other).render(K, WIDTH, HEIGHT, X_WC), strict=True):
        np.testing.assert_array_equal(one, same)
    assert np.abs(view.color - before.color).mean() > 0.01
    np.testing.assert_array_equal(baked.render(K, WIDTH, HEIGHT, X_WC).color, before.color)


@pytest.mark.parametrize("shape", [(300, 3), (299, 1, 3), (300, 2, 3)])
def test_colors_of_other_gaussians_are_refused(shape):
    with pytest.raises(ValueError, match="must be"):
        BakedScene(random_scene(count=300)).recolored(np.zeros(shape, np.float32))


@pytest.mark.parametrize("simd", LEVELS)
def test_threads_and_repeats_give_identical_views(simd):
    scene = random_scene(count=5000)
    first = BakedScene(scene, simd=simd).render(K, WIDTH, HEIGHT, X_WC)
    shared = BakedScene(scene, threads=3, simd=simd)

    def render(repeat):
        shared.render(K, 20, 90 + repeat, RigidTransform(np.array([0, 0, -5.0])))
        return shared.render(K, WIDTH, HEIGHT, X_WC)

    with ThreadPoolExecutor(3) as pool:
        for view in pool.map(render, range(6)):
            for got, want in zip(view, first, strict=True):
                np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize("count", [0, 17])
def test_counts_that_do_not_fill_groups(count):
    scene = random_scene(count=count, sh_degree=1)
    view = BakedScene(scene).render(K, WIDTH, HEIGHT, X_WC)
    image, alpha = rasterized(scene)
    np.testing.assert_allclose(view.alpha, alpha, atol=1e-4)
    np.testing.assert_allclose(view.color, image[..., :3], atol=1e-4)


def test_near_and_far_cut_by_depth_of_center():
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
        ({"K": np.eye(4)}, r"K must be of shape \(3, 3\), got \(4, 4\)"),
        ({"height": -1}, "image size must be .* got 83 x -1"),
        ({"near": 0.0}, "0 < near < far"),
        ({"max_depth": -1.0}, "max_depth must be > 0 m, got -1"),
        ({"background": (1.0, 2.0)}, r"background must be 3 finite numbers, got \[1.0, 2.0\]"),
    ],
)
def test_bad_cameras_are_named(change, message):
    baked = BakedScene(random_scene(count=5))
    arguments = {"K": K, "width": WIDTH, "height": HEIGHT, "X_WC": X_WC} | change
    with pytest.raises(ValueError, match=message):
        baked.render(**arguments)
    if "background" not in change:
        with pytest.raises(ValueError, match=message):
            baked.render_depth(**arguments)


def test_environment_selects_the_simd_level(monkeypatch):
    for level in LEVELS:
        monkeypatch.setenv("SPLATPILOT_SIMD", level)
        assert create_renderer().simd == level
    with pytest.raises(ValueError, match="'v9' is not available"):
        create_renderer(simd="v9")


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("lens", [None, Distortion(model="fisheye", radial=[0.05, 0.0, 0.0, 0.0])])
@pytest.mark.parametrize("size", [0.02, 1.0, 6.0])
def test_depth_alone_is_identical(simd, lens, size):
    bodies = random_scene(count=200, seed=1, sh_degree=0)
    moving = PlacedGaussians(
        *(getattr(bodies, name) for name in ("means", "quats", "scales", "opacities", "sh"))
    )
    scene = random_scene(count=3000)
    scene = BakedScene(replace(scene, scales=np.float32(size) * scene.scales), simd=simd)
    camera = {"K": K, "width": WIDTH, "height": HEIGHT, "moving": moving, "distortion": lens}
    for X in (X_WC, RigidTransform([0.1, 0.2, -0.5])):
        assert (scene.render(X_WC=X, **camera).depth > 0).mean() > 0.1
        for max_depth in (0.2, 2.0, np.inf):
            whole = scene.render(X_WC=X, max_depth=max_depth, **camera).depth
            alone = scene.render_depth(X_WC=X, max_depth=max_depth, **camera)
            np.testing.assert_array_equal(alone, whole)


@pytest.mark.parametrize("simd", LEVELS)
def test_gaussians_beyond_max_depth_hide_nothing(simd):
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


SIZE = {"width": 67, "height": 45}
K_WALL = np.array([[40.0, 0, 32.0], [0, 40.0, 18.0], [0, 0, 1]])


def wall(X_CP, half_width, half_height, step=0.05):
    x, y = np.meshgrid(
        np.arange(-half_width + step / 2, half_width, step),
        np.arange(-half_height + step / 2, half_height, step),
    )
    p_P = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    N = x.size
    return {
        "means": X_CP.multiply(p_P).T,
        "quats": np.tile(X_CP.rotation().ToQuaternion().wxyz(), (N, 1)),
        "scales": np.tile([0.7 * step, 0.7 * step, 1e-4], (N, 1)),
        "opacities": np.full(N, 0.99),
    }


def wall_scene(*walls):
    joined = {name: np.concatenate([w[name] for w in walls]) for name in walls[0]}
    return GaussianScene.from_colors(**joined, colors=np.full((len(joined["means"]), 3), 0.5))


def plane_depth(X_CP, width, height):
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack(
        [(u - K_WALL[0, 2]) / K_WALL[0, 0], (v - K_WALL[1, 2]) / K_WALL[1, 1], np.ones_like(u)], -1
    )
    n = X_CP.rotation().matrix()[:, 2]
    return n @ X_CP.translation() / (rays @ n)


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("seed", [0, 1])
def test_agrees_with_reference(simd, seed):
    scene = random_gaussians(seed=seed, count=900)
    names = ("means", "quats", "scales", "opacities")
    geometry = {name: scene[name] for name in names}
    camera = {"viewmat": scene["viewmats"][0], "K": scene["Ks"][0]}
    expected, margin = median_depth(**geometry, **camera, **SIZE)
    clear = margin > 1e-3
    assert clear.float().mean() > 0.5 and (expected[clear] > 0).float().mean() > 0.5
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
def test_a_slanted_plane_has_the_depth_of_the_plane(simd):
    X_CP = RigidTransform(RollPitchYaw(0.9, -0.5, 0.2), [0.1, 0.2, 4.0])
    scene = wall_scene(wall(X_CP, 8.0, 8.0, step=0.1))
    view = BakedScene(scene, simd=simd).render(K_WALL, **SIZE, X_WC=RigidTransform())
    truth = plane_depth(X_CP, **SIZE)
    inside = (truth > 1.0) & (truth < 6.0)
    assert inside.mean() > 0.5
    np.testing.assert_allclose(view.depth[inside], truth[inside], rtol=2e-4)


@pytest.mark.parametrize("simd", LEVELS)
def test_large_gaussians_close_to_the_camera_are_no_haze(simd):
    X_CP = RigidTransform(RotationMatrix.MakeXRotation(np.pi / 2), [0.0, 0.5, 0.0])
    truth = plane_depth(X_CP, **SIZE)
    above = np.arange(SIZE["height"]) + 0.5 < K_WALL[1, 2]
    near = ~above[:, None] & (truth < 8.0)
    assert near.mean() > 0.4
    for deviation, limit in ((0.3, 0.05), (0.15, 1e-5)):
        floor = wall_scene(wall(X_CP, 12.0, 12.0, step=deviation / 0.7))
        depth = BakedScene(floor, simd=simd).render(K_WALL, **SIZE, X_WC=RigidTransform()).depth
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


def disc(color: tuple[float, float, float]) -> GaussianScene:
    size = np.array([[0.5, 0.5, 0.001]])
    return GaussianScene.from_colors(
        np.zeros((1, 3)), [[1.0, 0, 0, 0]], size, [0.99], np.array([color])
    )


def test_a_moving_body_is_drawn_like_a_static_one():
    scene, body = random_scene(2048, seed=1, sh_degree=1), random_scene(300, seed=2, sh_degree=0)
    center = np.array([0.3, 0.2, 0.5])
    moving = MovingGaussians([body], lambda time: time * center[None])
    whole = scene.merged_with(body.transformed_by(RigidTransform(center)))
    expected = BakedScene(whole).render(K, WIDTH, HEIGHT, X_WC, background=(0.1, 0.2, 0.3))
    view = BakedScene(scene).render(
        K, WIDTH, HEIGHT, X_WC, background=(0.1, 0.2, 0.3), moving=moving.at(1.0)
    )
    for name in ("color", "alpha"):
        difference = np.abs(getattr(view, name) - getattr(expected, name))
        assert difference.max() < 2e-3, name
    far_off = np.abs(view.depth - expected.depth) > 1e-3
    assert far_off.mean() < 2e-3


def test_an_absent_body_is_not_drawn():
    scene, body = BakedScene(random_scene(500, seed=1)), random_scene(300, seed=2, sh_degree=0)
    absent = MovingGaussians([body], lambda time: np.full((1, 3), np.inf)).at(0.0)
    alone = scene.render(K, WIDTH, HEIGHT, X_WC)
    for a, b in zip(alone, scene.render(K, WIDTH, HEIGHT, X_WC, moving=absent), strict=True):
        np.testing.assert_array_equal(a, b)


def moving_disc(*depths: float) -> MovingObstacles:
    path = np.array([[0.0, 0.0, depth] for depth in depths])
    spheres = MovingSpheres([0.5], [path], 1.0)
    return MovingObstacles(spheres, MovingGaussians([disc((1.0, 0.0, 0.0))], spheres.centers))


def test_a_body_hides_and_is_hidden():
    camera = SplatCamera(disc((0.0, 1.0, 0.0)), CameraInfo(64, 48, 40.0, 40.0, 32.0, 24.0))
    context = camera.CreateDefaultContext()
    X_WB = RigidTransform(RotationMatrix(), np.array([0.0, 0.0, -3.0]))
    camera.GetInputPort("body_pose").FixValue(context, X_WB)
    obstacles = moving_disc(-1.0, 1.0)
    for time, seen, depth in ((0.0, 0, 2.0), (1.0, 1, 3.0), (0.5, 0, 2.0)):
        camera.GetInputPort("moving").FixValue(context, AbstractValue.Make(Bodies(time, obstacles)))
        color = camera.color_image_output_port().Eval(context).data[24, 32, :3]
        assert color.argmax() == seen and color.max() > 240
        assert camera.depth_image_32f_output_port().Eval(context).data[24, 32, 0] == (
            pytest.approx(depth, abs=0.01)
        )


def test_late_images_show_bodies_where_they_were():
    info, obstacles = CameraInfo(64, 48, 40.0, 40.0, 32.0, 24.0), moving_disc(1.0, 2.0, 3.0)
    camera = SplatCamera(disc((0.0, 1.0, 0.0)), info, latency=1.0)
    prompt = SplatCamera(disc((0.0, 1.0, 0.0)), info)
    X_WB = RigidTransform(np.array([1.2, 0.0, -3.0]))
    for time, then in ((0.5, 0.0), (1.5, 0.5), (2.5, 1.5)):
        late = camera.render(X_WB, Bodies(time, obstacles))
        np.testing.assert_array_equal(
            late.color, prompt.render(X_WB, Bodies(then, obstacles)).color
        )
    first, later = (prompt.render(X_WB, Bodies(time, obstacles)).color for time in (0.0, 1.0))
    assert not np.array_equal(first, later)


def test_antialiased_scenes_are_rendered_as_they_were_trained():
    scene = replace(random_scene(400), scales=np.full((400, 3), 2e-3, np.float32))
    plain = BakedScene(scene).render(K, WIDTH, HEIGHT, X_WC)
    marked = replace(scene, antialiased=True).scaled_by(1)
    found = BakedScene(marked).recolored(scene.sh).render(K, WIDTH, HEIGHT, X_WC)
    alpha = rasterized(scene, rasterize_mode="antialiased", render_mode="RGB")[1]
    np.testing.assert_allclose(found.alpha, np.asarray(alpha).reshape(HEIGHT, WIDTH), atol=2e-5)
    assert found.alpha.mean() < 0.5 * plain.alpha.mean()


@pytest.mark.parametrize("lens", [None, Distortion("opencv", [-0.1, 0.01])])
def test_images_of_a_batch_are_those_of_each_view(lens):
    scenes = [BakedScene(random_scene(sh_degree=1, count=500 + k)) for k in range(3)]
    scenes = [scenes[k % 3] for k in range(7)]
    X_WCs = [RigidTransform([0.1 * k, 0.0, -0.05 * k]) @ X_WC for k in range(7)]
    sky = EnvironmentMap(np.random.default_rng(0).uniform(size=(4, 8, 3)).astype(np.float32))
    backgrounds = [sky, *((0.1 * k, 0.2, 0.3) for k in range(6))]
    camera = K, WIDTH, HEIGHT
    batch = BatchRenderer(3)
    options = {"distortion": lens, "max_depth": 9.0}
    views = batch.render(scenes, *camera, X_WCs, 0.1, 50.0, backgrounds=backgrounds, **options)
    depths = batch.render_depth(scenes, *camera, X_WCs, 0.1, 50.0, **options)
    for k, (scene, X) in enumerate(zip(scenes, X_WCs, strict=True)):
        view = scene.render(*camera, X, 0.1, 50.0, backgrounds[k], **options)
        for name in view._fields:
            np.testing.assert_array_equal(getattr(views, name)[k], getattr(view, name))
        alone = scene.render_depth(*camera, X, 0.1, 50.0, **options)
        np.testing.assert_array_equal(depths[k], alone)


def test_refuses_batches_of_different_lengths():
    scene, batch = BakedScene(random_scene(count=10)), BatchRenderer(2)
    with pytest.raises(ValueError, match="number of poses must be that of scenes, 2, got 1"):
        batch.render_depth([scene] * 2, K, WIDTH, HEIGHT, [X_WC])
    with pytest.raises(ValueError, match="number of backgrounds must be that of scenes, 2, got 1"):
        batch.render([scene] * 2, K, WIDTH, HEIGHT, [X_WC] * 2, backgrounds=[(0.0, 0.0, 0.0)])


def textured_wall(sh_degree=0):
    """Returns a wall at z = 3 m of Gaussians 3 cm apart, with waves of color."""
    y, x = (grid.ravel() for grid in np.mgrid[-4.5:4.5:0.03, -4.5:4.5:0.03])
    scene = GaussianScene.from_colors(
        means=np.column_stack([x, y, np.full_like(x, 3.0)]),
        quats=np.tile([1.0, 0, 0, 0], (x.size, 1)),
        scales=np.tile([0.021, 0.021, 1e-3], (x.size, 1)),
        opacities=np.full(x.size, 0.9),
        colors=0.5 + 0.4 * np.stack([np.sin(4 * x), np.sin(4 * y), np.sin(3 * x + 2 * y)], -1),
    )
    pads = ((0, 0), (0, (sh_degree + 1) ** 2 - 1), (0, 0))
    return replace(scene, sh=np.pad(scene.sh, pads))


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("degree", [0, 2])
def test_merged_neighbors_show_the_same_picture(simd, degree):
    scene = BakedScene(textured_wall(degree), simd=simd)
    small = np.array([[24.0, 0, 24.0], [0, 24.0, 18.0], [0, 0, 1]])
    fine = np.array([[192.0, 0, 192.0], [0, 192.0, 144.0], [0, 0, 1]])
    X = RigidTransform(RollPitchYaw(0.1, 0.1, 0.2), np.zeros(3))
    truth = scene.render(fine, 384, 288, X).color.reshape(36, 8, 48, 8, 3).mean((1, 3))
    views = [scene.render(small, 48, 36, X, merged_spread=spread) for spread in (0.0, 1.0)]
    errors = [np.abs(view.color - truth).mean() for view in views]
    assert errors[1] < 0.8 * errors[0]
    assert np.any(views[0].color != views[1].color)
    assert np.isclose(views[1].depth, views[0].depth, rtol=1e-3).mean() > 0.995
    assert views[1].alpha.mean() > 0.99


def test_recolored_scenes_keep_their_merged_neighbors():
    wall = textured_wall()
    scene = BakedScene(wall)
    camera = K, WIDTH, HEIGHT, RigidTransform()
    view = scene.render(*camera, merged_spread=2.0)
    inverted = replace(wall, sh=-wall.sh)
    for baked in (scene.recolored(inverted.sh), BakedScene(inverted)):
        image = baked.render_color(*camera, merged_spread=2.0)
        np.testing.assert_allclose(image + view.color, view.alpha[..., None] * [1, 1, 1], atol=1e-4)


def test_few_gaussians_far_apart_do_not_merge():
    scene = BakedScene(random_scene(count=130))
    views = [scene.render(K, WIDTH, HEIGHT, X_WC, merged_spread=s) for s in (0.0, 1e-3)]
    for name in ("color", "depth", "alpha"):
        np.testing.assert_array_equal(*(getattr(view, name) for view in views))


@pytest.mark.parametrize("lens", [None, Distortion("opencv", [-0.1, 0.01])])
def test_color_alone_is_bitwise_that_of_the_view(lens):
    scene = BakedScene(random_scene())
    for spread in (0.0, 2.0):
        options = {"background": (0.1, 0.2, 0.3), "distortion": lens, "merged_spread": spread}
        view = scene.render(K, WIDTH, HEIGHT, X_WC, **options)
        alone = scene.render_color(K, WIDTH, HEIGHT, X_WC, **options)
        np.testing.assert_array_equal(alone, view.color)
