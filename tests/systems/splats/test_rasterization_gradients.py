"""Tests of the CPU rasteriser's gradients against the float64 reference's autograd."""

import gc
import weakref
from typing import Any

import pytest
import reference_rasterizer as reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from random_scenes import normal_tensor, random_scene
from torch import Tensor

from splatpilot import _native
from splatpilot.systems.splats import rasterize
from splatpilot.systems.splats.baked_scene import create_renderer

single_gaussian = reference.single_gaussian

LEVELS = _native.simd_levels()
SCENE = ("means", "quats", "scales", "opacities", "colors")
INPUTS = (*SCENE, "viewmats", "backgrounds")
SIZE = (67, 45)


def leaves(scene: dict[str, Any], dtype=torch.float32) -> dict[str, Any]:
    """Copies of a scene's tensors, which require gradients where they can."""
    return {
        name: tensor.detach().to(dtype, copy=True).requires_grad_(name != "Ks")
        for name, tensor in scene.items()
    }


def reference_views(scene, size, mode, sh_degree=None, **options) -> tuple[Tensor, Tensor, Tensor]:
    """Image (C, H, W, X), alpha (C, H, W, 1) and margin (C, H, W) of every camera."""
    images, alphas, margins = [], [], []
    for c in range(len(scene["viewmats"])):
        per_camera = scene["colors"].ndim == (3 if sh_degree is None else 4)
        one = {name: scene[name] for name in SCENE}
        one["colors"] = scene["colors"][c] if per_camera else scene["colors"]
        view = reference.render(
            **one,
            viewmat=scene["viewmats"][c],
            K=scene["Ks"][c],
            width=size[0],
            height=size[1],
            sh_degree=sh_degree,
            background=scene["backgrounds"][c] if "backgrounds" in scene else (0.0, 0.0, 0.0),
            **options,
        )
        depth = view.depth / view.alpha.clamp(min=1e-10) if "ED" in mode else view.depth
        channels = [view.color] if mode.startswith("RGB") else []
        channels += [depth[..., None]] if mode.endswith("D") else []
        images.append(torch.cat(channels, -1))
        alphas.append(view.alpha[..., None])
        margins.append(view.margin.detach())
    return torch.stack(images), torch.stack(alphas), torch.stack(margins)


def compare(
    scene, size=SIZE, mode="RGB+ED", sh_degree=None, antialiased=False, least_clear=0.97, **options
) -> dict[str, tuple[Tensor, Tensor]]:
    """(gradient, reference gradient) of a random linear function of all that is rendered.

    Pixels within 1e-3 of a threshold, where a decision may differ by rounding, are left out and
    must be fewer than 1 - `least_clear`.
    """
    wide = leaves(scene, torch.float64)
    image, alpha, margin = reference_views(wide, size, mode, sh_degree, antialiased=antialiased)
    clear = (margin > 1e-3)[..., None]
    assert clear.double().mean() > least_clear
    v_image = normal_tensor(0, *image.shape) * clear
    v_alpha = normal_tensor(1, *alpha.shape) * clear
    torch.autograd.backward([image, alpha], [v_image.double(), v_alpha.double()])

    narrow = leaves(scene)
    image, alpha, _ = rasterize(
        **narrow,
        width=size[0],
        height=size[1],
        render_mode=mode,
        sh_degree=sh_degree,
        rasterize_mode="antialiased" if antialiased else "classic",
        **options,
    )
    torch.autograd.backward([image, alpha], [v_image, v_alpha])
    pairs = {}
    for name in INPUTS:
        if name in scene and wide[name].grad is not None:
            gradient, expected = narrow[name].grad, wide[name].grad
            assert gradient is not None and expected is not None
            pairs[name] = (gradient.double(), expected)
    return pairs


def assert_agree(pairs: dict[str, tuple[Tensor, Tensor]], p99=2e-4) -> None:
    """gsplat's tolerances for its own kernels but for one in 500, 1e-4 relative in all.

    The entries for poses are sums that cancel: their errors are relative to the largest entry.
    """
    for name, (gradient, expected) in pairs.items():
        error, size = (gradient - expected).abs(), expected.abs()
        size = size.max() if name == "viewmats" else size
        beyond = error > 1e-3 + 1e-5 * size
        assert beyond.sum() <= max(1, beyond.numel() // 500), (name, error.max())
        assert not (error > 1e-3 + 1e-4 * size).any(), (name, error.max())
        relative = error / (size + 1e-2)
        assert relative.median() < 5e-6, name
        if len(expected) > 100:
            assert torch.quantile(relative.flatten(), 0.99) < p99, name


def with_backgrounds(scene) -> dict[str, Any]:
    g = torch.Generator().manual_seed(77)
    return scene | {"backgrounds": torch.rand(len(scene["viewmats"]), 3, generator=g)}


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_agree_with_reference_in_every_mode(mode, simd):
    """Gradients by scene, pose and background equal autograd's through the float64 reference."""
    scene = random_scene(seed=0)
    scene = with_backgrounds(scene) if mode.startswith("RGB") else scene
    pairs = compare(scene, mode=mode, renderer=create_renderer(1, simd))
    assert_agree(pairs)
    assert all(expected.any() for name, (_, expected) in pairs.items() if name != "colors")


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("seed", [1, 2])
def test_antialiased_agrees_with_reference(seed, simd):
    """The compensation of opacities is differentiated too, for needles and specks as well."""
    scene = random_scene(seed=seed)
    scene["scales"] *= 0.4
    pairs = compare(scene, antialiased=True, renderer=create_renderer(1, simd))
    assert_agree(pairs)


def test_antialiased_image_agrees_with_reference():
    """Opacities fall by sqrt(det S / det(S + eps2d)), also in meta."""
    scene = random_scene(seed=3)
    scene["scales"] *= 0.3
    image, alpha, meta = rasterize(
        **scene, width=67, height=45, render_mode="RGB+D", rasterize_mode="antialiased"
    )
    expected, expected_alpha, margin = reference_views(scene, SIZE, "RGB+D", antialiased=True)
    clear = margin > 1e-4
    assert (image.double() - expected).abs()[clear].max() < 2e-3
    assert (alpha.double() - expected_alpha).abs()[clear].max() < 2e-4
    classic = rasterize(**scene, width=67, height=45)[1]
    assert classic.mean() > 1.1 * alpha.mean()
    wide = {name: tensor.double() for name, tensor in scene.items()}
    p = reference.project(
        *(wide[n] for n in SCENE[:4]), wide["viewmats"][0], wide["Ks"][0], *SIZE, antialiased=True
    )
    order = torch.argsort(p.ids)
    assert torch.equal(meta["gaussian_ids"], p.ids[order])
    torch.testing.assert_close(meta["opacities"].double(), p.opacity[order], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spherical_harmonics_agree_with_reference(degree):
    """Gradients reach coefficients, and means and pose by way of the viewing direction."""
    pairs = compare(random_scene(seed=4, sh_degree=3), sh_degree=degree, mode="RGB")
    assert_agree(pairs)
    unused = pairs["colors"][0][:, (degree + 1) ** 2 :]
    assert not unused.any()


@pytest.mark.parametrize("sh_degree", [None, 1])
@pytest.mark.parametrize("per_camera", [False, True])
def test_batch_of_cameras_agrees_with_reference(per_camera, sh_degree):
    """Cameras add up in shared tensors and keep to their own rows in those of each camera."""
    scene = with_backgrounds(random_scene(seed=5, cameras=3, sh_degree=sh_degree))
    if per_camera:
        scene["colors"] = torch.stack([(1 - 0.2 * c) * scene["colors"] for c in range(3)])
    assert_agree(compare(scene, sh_degree=sh_degree))


@pytest.mark.parametrize("simd", LEVELS)
def test_long_tile_lists_agree_with_reference(simd):
    """Tiles of many times 256 Gaussians, which are staged in parts, lose nothing between parts."""
    scene = random_scene(count=2000, seed=6, size=(21, 18))
    scene["opacities"] = 0.02 + 0.03 * scene["opacities"]
    scene["means"] *= 0.3
    assert_agree(
        compare(scene, size=(21, 18), least_clear=0.9, renderer=create_renderer(1, simd)), p99=1e-3
    )


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (16, 16), (17, 33), (97, 1)])
def test_odd_sizes_agree_with_reference(size):
    """Images that end inside tiles and blocks have the reference's gradients."""
    for seed in range(7, 12):
        scene = random_scene(seed=seed, size=size)
        _, _, margin = reference_views(scene, size, "RGB")
        if (margin > 1e-3).double().mean() > 0.97:
            assert_agree(compare(scene, size=size))
            return
    raise AssertionError("too many pixels at thresholds in every scene")


def test_colors_are_not_cut_off():
    """Black and negative colours are as free to move as any; only harmonics are cut off at 0."""
    scene = random_scene(seed=30)
    scene["colors"] = torch.round(3 * scene["colors"] - 1)
    assert (scene["colors"] == 0).any() and (scene["colors"] < 0).any()
    assert_agree(compare(scene))


def test_directional_derivatives_agree_with_finite_differences():
    """The gradient along random directions equals the float64 reference's central difference."""
    scene = random_scene(count=12, seed=13, size=(19, 14))
    scene["opacities"] = 0.2 + 0.5 * scene["opacities"]
    v = normal_tensor(1, 1, 14, 19, 4)

    def loss(moved):
        image, _, margin = reference_views(moved, (19, 14), "RGB+D")
        return (image * v.double() * clear).sum(), margin

    _, _, margin = reference_views(scene, (19, 14), "RGB+D")
    clear = (margin > 1e-2)[..., None]
    narrow = leaves(scene)
    image, _, _ = rasterize(**narrow, width=19, height=14, render_mode="RGB+D")
    (image * v * clear).sum().backward()
    for seed, name in enumerate((*SCENE, "viewmats")):
        direction = normal_tensor(seed, *scene[name].shape).double()
        if name == "viewmats":
            direction[:, 3] = 0
        step = 1e-6
        ends = [
            loss(scene | {name: scene[name].double() + sign * step * direction})[0]
            for sign in (1, -1)
        ]
        expected = (ends[0] - ends[1]) / (2 * step)
        gradient = narrow[name].grad
        assert gradient is not None
        got = (gradient.double() * direction).sum()
        assert got == pytest.approx(expected.item(), rel=2e-5, abs=2e-5), name


@pytest.mark.parametrize("simd", LEVELS)
def test_thread_counts_give_equal_bits(simd):
    """One, two, three and four threads give the same gradients, bit by bit."""
    scene = with_backgrounds(random_scene(count=6000, seed=14, size=(131, 77), sh_degree=1))
    first = None
    for threads in (1, 2, 4, 3, 1):
        narrow = leaves(scene)
        image, alpha, meta = rasterize(
            **narrow,
            width=131,
            height=77,
            sh_degree=1,
            render_mode="RGB+ED",
            absgrad=True,
            renderer=create_renderer(threads, simd),
        )
        meta["means2d"].retain_grad()
        (image.square().sum() + alpha.sin().sum()).backward()
        got = [narrow[name].grad for name in INPUTS]
        got += [meta["means2d"].grad, meta["means2d"].absgrad]
        first = first or got
        assert all(a is not None and torch.equal(a, b) for a, b in zip(got, first, strict=True))


def test_screen_space_gradients_agree_with_reference():
    """means2d.grad and .absgrad are the sums over pixels of its derivative and of its size."""
    scene = random_scene(count=60, seed=15, size=(13, 11))
    narrow = leaves(scene)
    image, alpha, meta = rasterize(**narrow, width=13, height=11, render_mode="RGB+D", absgrad=True)
    meta["means2d"].retain_grad()
    v = normal_tensor(2, 11, 13, 5)

    wide = {name: tensor.double() for name, tensor in scene.items()}
    p = reference.project(*(wide[n] for n in SCENE[:4]), wide["viewmats"][0], wide["Ks"][0], 13, 11)
    mean = p.mean.requires_grad_()
    view = reference.composite(p, wide["colors"][p.ids], 13, 11)
    v = v * (view.margin > 1e-3)[..., None]
    shown = torch.cat([view.color, view.depth[..., None], view.alpha[..., None]], -1)
    terms = torch.stack(
        [
            torch.autograd.grad(value, mean, retain_graph=True)[0]
            for value in (shown * v).sum(-1).flatten()
        ]
    )
    order = torch.argsort(p.ids)
    torch.autograd.backward([image, alpha], [v[None, ..., :4], v[None, ..., 4:]])
    for got, expected in (
        (meta["means2d"].grad, terms.sum(0)),
        (meta["means2d"].absgrad, terms.abs().sum(0)),
    ):
        torch.testing.assert_close(got.double(), expected[order], rtol=1e-4, atol=1e-5)


def test_loss_on_means2d_alone_reaches_the_scene():
    """The projection differentiates without an image, like any other function of the scene."""
    scene = random_scene(seed=16)
    narrow, wide = leaves(scene), leaves(scene, torch.float64)
    _, _, meta = rasterize(**narrow, width=67, height=45)
    meta["means2d"].sum().backward()
    p = reference.project(*(wide[n] for n in SCENE[:4]), wide["viewmats"][0], wide["Ks"][0], *SIZE)
    p.mean.sum().backward()
    for name in ("means", "viewmats"):
        torch.testing.assert_close(
            narrow[name].grad.double(), wide[name].grad, rtol=1e-5, atol=1e-3
        )


def test_graphs_may_overlap_and_be_used_again():
    """Frames rendered later, and an earlier pass over the same graph, change no gradient."""
    scenes = [random_scene(count=n, seed=17 + n) for n in (200, 3000, 400)]
    alone = []
    for scene in scenes:
        narrow = leaves(scene)
        rasterize(**narrow, width=67, height=45)[0].square().sum().backward()
        alone.append([narrow[name].grad for name in SCENE])
    together = [leaves(scene) for scene in scenes]
    losses = [rasterize(**s, width=67, height=45)[0].square().sum() for s in together]
    for i in (1, 0, 2):
        for _ in range(2):
            gradients = torch.autograd.grad(
                losses[i], [together[i][name] for name in SCENE], retain_graph=True
            )
            pairs = zip(gradients, alone[i], strict=True)
            assert all(b is not None and torch.equal(a, b) for a, b in pairs)


def test_rendered_tensors_are_freed():
    """Dropping the outputs frees them at once: no cycle keeps an image and its graph alive."""
    gc.disable()
    try:
        image, alpha, meta = rasterize(**leaves(random_scene()), width=67, height=45)
        watched = [weakref.ref(t) for t in (image, alpha, meta["means2d"])]
        image.sum().backward()
        del image, alpha, meta
        assert not any(ref() is not None for ref in watched)
    finally:
        gc.enable()


def test_zero_upstream_gives_zeros():
    """No gradient from above is no gradient below, exactly, and unseen Gaussians have none ever."""
    scene = random_scene(seed=20)
    narrow = leaves(scene)
    image, alpha, _ = rasterize(**narrow, width=67, height=45, render_mode="RGB+ED")
    (0 * image.sum() + 0 * alpha.sum()).backward()
    assert all(not narrow[name].grad.any() for name in (*SCENE, "viewmats"))
    narrow = leaves(scene)
    image, _, meta = rasterize(**narrow, width=67, height=45)
    image.sum().backward()
    unseen = torch.ones(300, dtype=torch.bool)
    unseen[meta["gaussian_ids"]] = False
    assert unseen.any() and all(not narrow[name].grad[unseen].any() for name in SCENE)


@pytest.mark.parametrize("count", [0, 5])
def test_nothing_visible_gives_zeros(count):
    """An empty scene, or one behind the camera, has zero gradients; the background has its own."""
    scene = with_backgrounds(random_scene(count=count))
    scene["means"][:, 2] = -50.0
    narrow = leaves(scene)
    image, _, meta = rasterize(**narrow, width=20, height=10, absgrad=True)
    image.sum().backward()
    assert len(meta["means2d"]) == 0
    assert all(narrow[n].grad is not None and not narrow[n].grad.any() for n in SCENE)
    torch.testing.assert_close(narrow["backgrounds"].grad, torch.full((1, 3), 200.0))


def test_only_what_requires_gradients_gets_them():
    """A pose or a background alone can be optimised, with the same gradient as among others."""
    scene = with_backgrounds(random_scene(seed=21))
    everything = leaves(scene)
    rasterize(**everything, width=67, height=45)[0].square().sum().backward()
    for name in INPUTS:
        one = scene | {name: scene[name].clone().requires_grad_()}
        rasterize(**one, width=67, height=45)[0].square().sum().backward()
        assert torch.equal(one[name].grad, everything[name].grad)
        assert all(t.grad is None for other, t in one.items() if other != name)


def test_equal_depths_differentiate_in_input_order():
    """Coincident Gaussians get the gradients that blending in the order of the input implies."""
    scene = single_gaussian(0.3)
    shared = {"viewmats": scene.pop("viewmats"), "Ks": scene.pop("Ks")}
    scene = {name: a.repeat(700, *[1] * (a.ndim - 1)) for name, a in scene.items()} | shared
    scene["colors"] = torch.rand(700, 3, generator=torch.Generator().manual_seed(0))
    narrow = leaves(scene)
    image, _, _ = rasterize(**narrow, width=33, height=33)
    image[0, 16, 16, 0].backward()
    weights = 0.3 * 0.7 ** torch.arange(26, dtype=torch.float64)
    weights[0.7 ** torch.arange(1, 27) <= 1e-4] = 0
    got = narrow["colors"].grad
    torch.testing.assert_close(got[:26, 0].double(), weights, rtol=1e-5, atol=1e-7)
    assert not got[26:].any() and not got[:, 1:].any()


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e4, 1e12, 1e25])
def test_extreme_scales_stay_finite(scale, antialiased, simd):
    """Specks and giants differentiate without overflow."""
    for thin in (1.0, 1e-6):
        scene = single_gaussian(scale=scale)
        scene["scales"][0, 0] *= thin if scale > 1e-20 else 1.0
        narrow = leaves(scene)
        image, alpha, _ = rasterize(
            **narrow,
            width=33,
            height=33,
            render_mode="RGB+ED",
            renderer=create_renderer(1, simd),
            rasterize_mode="antialiased" if antialiased else "classic",
        )
        (image.sum() + alpha.sum()).backward()
        assert all(torch.isfinite(narrow[n].grad).all() for n in (*SCENE, "viewmats"))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(0, 60),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    spread=st.floats(-3, 3),
    log_scale=st.floats(-8, 4),
    mode=st.sampled_from(["RGB", "D", "ED", "RGB+D", "RGB+ED"]),
    sh_degree=st.sampled_from([None, 0, 2]),
    antialiased=st.booleans(),
    eps2d=st.sampled_from([0.0, 0.3]),
    simd=st.sampled_from(LEVELS),
    threads=st.integers(1, 2),
)
def test_fuzz_finite(
    seed,
    count,
    width,
    height,
    spread,
    log_scale,
    mode,
    sh_degree,
    antialiased,
    eps2d,
    simd,
    threads,
):
    """Any valid scene differentiates to finite values."""
    scene = random_scene(count=count, seed=seed, size=(width, height), sh_degree=sh_degree)
    scene["means"] *= 10.0**spread
    scene["scales"] = 10.0 ** (log_scale + normal_tensor(seed, count, 3))
    narrow = leaves(scene)
    image, alpha, meta = rasterize(
        **narrow,
        width=width,
        height=height,
        render_mode=mode,
        sh_degree=sh_degree,
        rasterize_mode="antialiased" if antialiased else "classic",
        eps2d=eps2d,
        absgrad=True,
        renderer=create_renderer(threads, simd),
    )
    upstream = [normal_tensor(seed, *image.shape), normal_tensor(seed, *alpha.shape)]
    torch.autograd.backward([image, alpha], upstream)
    assert all(torch.isfinite(narrow[n].grad).all() for n in (*SCENE, "viewmats"))
    assert torch.isfinite(meta["means2d"].absgrad).all() and (meta["means2d"].absgrad >= 0).all()


def test_fitting_recovers_an_image():
    """A few Gaussians, moved off and recoloured, find their way back to the image they made."""
    truth = random_scene(count=8, seed=22, size=(40, 30))
    truth["means"] *= 0.4
    truth["scales"] = truth["scales"].clamp(0.1, 0.4)
    truth["opacities"] = 0.5 + 0.4 * truth["opacities"]
    size: dict[str, Any] = {"width": 40, "height": 30}
    target = rasterize(**truth, **size)[0]
    means = (truth["means"] + 0.05 * normal_tensor(3, 8, 3)).requires_grad_()
    log_scales = (truth["scales"].log() + 0.2 * normal_tensor(4, 8, 3)).requires_grad_()
    quats = (truth["quats"] + 0.3 * normal_tensor(5, 8, 4)).requires_grad_()
    colors = (0.5 * torch.ones(8, 3)).requires_grad_()
    optimizer = torch.optim.Adam([means, log_scales, quats, colors], lr=0.01)
    losses = []
    for _ in range(250):
        optimizer.zero_grad()
        fitted = truth | {
            "means": means,
            "scales": log_scales.exp(),
            "quats": quats,
            "colors": colors,
        }
        loss = (rasterize(**fitted, **size)[0] - target).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[0] > 2e-3 and losses[-1] < 0.01 * losses[0], losses[-1]


def test_gradients_of_one_walk_do_not_enter_the_next():
    """Where Gaussians appear does not depend on their scales, also after another walk through the
    graph that stopped at means2d."""
    scene = leaves(random_scene(count=50, seed=3))
    image, _, meta = rasterize(**scene, width=SIZE[0], height=SIZE[1])
    torch.autograd.grad(image.sum(), meta["means2d"], retain_graph=True)
    v_means, v_scales = torch.autograd.grad(
        meta["means2d"].sum(), [scene["means"], scene["scales"]]
    )
    assert v_means.any() and not v_scales.any()


def test_frames_of_one_renderer_do_not_mix():
    """Images rendered with one renderer, all before any backward pass, have the gradients that each
    has alone."""
    renderer = create_renderer(2)

    def loss(scene, **options):
        return rasterize(**scene, width=SIZE[0], height=SIZE[1], **options)[0].square().sum()

    scenes = [leaves(random_scene(count=count, seed=count)) for count in (40, 300, 80)]
    for total in [loss(scene, renderer=renderer) for scene in scenes]:
        total.backward()
    for scene in scenes:
        alone = leaves({name: tensor.detach() for name, tensor in scene.items()})
        loss(alone).backward()
        assert all(torch.equal(scene[name].grad, alone[name].grad) for name in ("means", "colors"))
