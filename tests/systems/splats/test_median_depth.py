"""Tests of the median depth: surfaces are where they are, also where they end."""

import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from random_scenes import random_scene
from reference_median_depth import median_depth
from reference_rasterizer import single_gaussian

from splatpilot import _native
from splatpilot.systems.splats import rasterize, rasterize_surfels
from splatpilot.systems.splats.baked_scene import BakedScene, create_renderer
from splatpilot.systems.splats.scene import GaussianScene

LEVELS = _native.simd_levels()
SIZE = {"width": 67, "height": 45}
K = np.array([[40.0, 0, 32.0], [0, 40.0, 18.0], [0, 0, 1]])


def wall(X_CP, half_width, half_height, step=0.05):
    """Flat opaque Gaussians (N) on the plane z = 0 of P, in a frame C."""
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


def scene_of(*walls):
    joined = {name: np.concatenate([w[name] for w in walls]) for name in walls[0]}
    return GaussianScene.from_colors(**joined, colors=np.full((len(joined["means"]), 3), 0.5))


def plane_depth(X_CP, width, height):
    """(H, W) [m] where the pixels' rays meet the plane z = 0 of P."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    n = X_CP.rotation().matrix()[:, 2]
    return n @ X_CP.translation() / (rays @ n)


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("seed", [0, 1])
def test_agrees_with_reference(simd, seed):
    """Median depth equals the float64 reference at every SIMD level, wherever no threshold is
    within rounding, and colour and alpha are, bit for bit, those without it."""
    scene = random_scene(seed=seed, count=900)
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
    """Flat Gaussians on a plane seen at a slant have its depth at every pixel, to float32."""
    X_CP = RigidTransform(RollPitchYaw(0.9, -0.5, 0.2), [0.1, 0.2, 4.0])
    scene = scene_of(wall(X_CP, 8.0, 8.0, step=0.1))
    view = BakedScene(scene, simd=simd).render(K, **SIZE, X_WC=RigidTransform())
    truth = plane_depth(X_CP, **SIZE)
    inside = (truth > 1.0) & (truth < 6.0)
    assert inside.mean() > 0.5
    np.testing.assert_allclose(view.depth[inside], truth[inside], rtol=2e-4)


@pytest.mark.parametrize("simd", LEVELS)
def test_large_gaussians_close_to_the_camera_are_no_haze(simd):
    """Flat Gaussians of 0.3 m on a floor 0.5 m below a level camera show nothing above the horizon
    and about the floor below; those of 0.15 m the floor, to float32."""
    X_CP = RigidTransform(RotationMatrix.MakeXRotation(np.pi / 2), [0.0, 0.5, 0.0])
    truth = plane_depth(X_CP, **SIZE)
    above = np.arange(SIZE["height"]) + 0.5 < K[1, 2]
    near = ~above[:, None] & (truth < 8.0)
    assert near.mean() > 0.4
    for deviation, limit in ((0.3, 0.05), (0.15, 1e-5)):
        floor = scene_of(wall(X_CP, 12.0, 12.0, step=deviation / 0.7))
        depth = BakedScene(floor, simd=simd).render(K, **SIZE, X_WC=RigidTransform()).depth
        assert (depth[above] == 0).all()
        assert np.median(np.abs(depth / truth - 1)[near]) < limit


def test_a_pixel_beside_an_edge_shows_what_is_behind():
    """Where a near wall ends before a far one every pixel reads one of the two, and the change is
    within a Gaussian's width of the edge; expected depth has values between them."""
    near, far = RigidTransform([-2.0, 0, 1.0]), RigidTransform([0, 0, 6.0])
    scene = scene_of(wall(near, 2.0, 2.0), wall(far, 8.0, 8.0, step=0.1))  # near ends at x = 0
    depth = BakedScene(scene).render(K, **SIZE, X_WC=RigidTransform()).depth
    error = np.minimum(np.abs(depth - 1.0), np.abs(depth - 6.0))
    assert error.max() < 1e-3
    x = (np.arange(SIZE["width"]) + 0.5 - K[0, 2]) / K[0, 0]  # [m] on the near wall
    assert (depth[:, x < 0.0] < 2.0).all() and (depth[:, x > 0.07] > 5.0).all()
    tensors = {n: torch.from_numpy(getattr(scene, n)) for n in ("means", "quats", "scales")}
    expected = rasterize(
        **tensors,
        opacities=torch.from_numpy(scene.opacities),
        colors=torch.from_numpy(scene.base_colors),
        viewmats=torch.eye(4)[None],
        Ks=torch.from_numpy(K).float()[None],
        **SIZE,
        render_mode="ED",
    )[0][0, ..., 0]
    assert ((expected > 1.2) & (expected < 5.5)).any()


def test_half_of_the_light_decides():
    """One Gaussian that stops 0.4 is no surface: depth 0; behind a second there is one, at the
    second; where nothing is, there is none."""
    one = single_gaussian(opacity=0.4)
    size = {"width": 33, "height": 33}
    assert (rasterize(**one, **size, render_mode="MD")[0] == 0).all()
    two = one | {
        name: torch.cat([one[name], one[name]])
        for name in ("means", "quats", "scales", "opacities", "colors")
    }
    two["means"][1, 2] = 3.0
    depth = rasterize(**two, **size, render_mode="MD")[0][0, ..., 0]
    assert abs(depth[16, 16].item() - 3.0) < 1e-5 and depth[0, 0] == 0


@pytest.mark.parametrize("simd", LEVELS)
def test_baked_scenes_have_the_same(simd):
    """A baked scene's median depth is that of `rasterize`, up to rounding at thresholds."""
    scene = random_scene(count=1500, seed=3, sh_degree=1)
    names = ("means", "quats", "scales", "opacities")
    arrays = [scene[name].numpy() for name in names]
    baked = BakedScene(GaussianScene(*arrays, sh=scene["colors"].numpy()), simd=simd)
    X_CW = scene["viewmats"][0].double().numpy()
    R_CW = RotationMatrix.ProjectToRotationMatrix(X_CW[:3, :3])
    X_WC = RigidTransform(R_CW, X_CW[:3, 3]).inverse()
    view = baked.render(scene["Ks"][0].double().numpy(), **SIZE, X_WC=X_WC)
    image, _, _ = rasterize(
        **scene, **SIZE, sh_degree=1, render_mode="RGB+MD", renderer=create_renderer(1, simd)
    )
    difference = np.abs(view.depth - image[0, ..., 3].numpy())
    assert np.median(difference) < 1e-5 and np.quantile(difference, 0.99) < 2e-3


def test_it_is_constant_in_gradients():
    """A loss of the depth has no gradient; that of the colour beside it is as without depth."""
    scene = random_scene(count=200)
    gradients = []
    for mode in ("RGB", "RGB+MD"):
        means = scene["means"].clone().requires_grad_()
        image, _, _ = rasterize(**scene | {"means": means}, **SIZE, render_mode=mode)
        (image[..., :3].square().sum() + image[..., 3:].sum()).backward()
        gradients.append(means.grad)
    assert torch.equal(*gradients)


def test_antialiased_images_and_surfels_have_no_median_depth():
    scene = random_scene(count=10)
    with pytest.raises(ValueError, match=r"'RGB\+MD' needs rasterize_mode 'classic'"):
        rasterize(**scene, **SIZE, render_mode="RGB+MD", rasterize_mode="antialiased")
    with pytest.raises(ValueError, match="'MD'; it must be one of RGB, D, ED"):
        rasterize_surfels(**scene, **SIZE, render_mode="MD")
