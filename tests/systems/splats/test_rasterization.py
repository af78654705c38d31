"""Tests of the CPU rasteriser against an independent reference and analytic oracles."""

import math
from typing import Any

import numpy as np
import pytest
import reference_rasterizer as reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from random_scenes import normal_tensor, random_scene

from splatpilot import _native
from splatpilot.systems.splats import rasterize
from splatpilot.systems.splats.baked_scene import create_renderer

single_gaussian = reference.single_gaussian

LEVELS = _native.simd_levels()


def call_reference(scene, width, height, camera=0, **options):
    s = {name: a for name, a in scene.items() if name not in ("viewmats", "Ks")}
    return reference.render(
        **s,
        viewmat=scene["viewmats"][camera],
        K=scene["Ks"][camera],
        width=width,
        height=height,
        **options,
    )


def assert_agrees(image, expected, clear, tolerance=2e-4):
    """Tight in the median everywhere, and bounded wherever no threshold is within rounding."""
    error = (image.double() - expected).abs()
    assert error.median() < 1e-6
    assert error[clear].max() < tolerance


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("seed", [0, 1])
def test_agrees_with_reference_in_every_mode(simd, seed):
    """Colour, depth and alpha equal the float64 reference, in every mode at every SIMD level."""
    scene = random_scene(seed=seed)
    width, height = 67, 45
    background = (0.1, 0.7, 0.3)
    expected = call_reference(scene, width, height, background=background)
    clear = expected.margin > 1e-4
    assert clear.float().mean() > 0.9
    images = {}
    for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED"):
        with_color = mode.startswith("RGB")
        image, alpha, _ = rasterize(
            **scene,
            width=width,
            height=height,
            backgrounds=torch.tensor([background]) if with_color else None,
            render_mode=mode,
            renderer=create_renderer(1, simd),
        )
        images[mode] = image[0]
        assert_agrees(alpha[0, ..., 0], expected.alpha, clear)
        if with_color:
            assert_agrees(image[0, ..., :3], expected.color, clear)
        if mode.endswith("D"):
            depth = expected.depth
            if "ED" in mode:
                depth = depth / expected.alpha.clamp(min=1e-10)
            assert_agrees(image[0, ..., -1], depth, clear, tolerance=2e-3)
    assert torch.equal(images["RGB"], images["RGB+D"][..., :3])
    assert torch.equal(images["ED"][..., 0], images["RGB+ED"][..., 3])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spherical_harmonics_agree_with_reference(degree):
    """Colours from spherical harmonics follow the viewing direction as the formula says."""
    scene = random_scene(seed=2, sh_degree=3)
    expected = call_reference(scene, 67, 45, sh_degree=degree)
    image, _, _ = rasterize(**scene, width=67, height=45, sh_degree=degree)
    assert_agrees(image[0], expected.color, expected.margin > 1e-4)


def test_batch_of_cameras_equals_single_calls():
    """C cameras in one call give the bits of C calls, with meta in camera order."""
    scene = random_scene(seed=3, cameras=3)
    colors = torch.rand(3, 300, 3, generator=torch.Generator().manual_seed(9))
    backgrounds = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0.2, 0.3, 0.4]])
    scene["colors"] = colors
    images, alphas, meta = rasterize(**scene, width=40, height=30, backgrounds=backgrounds)
    assert images.shape == (3, 30, 40, 3) and alphas.shape == (3, 30, 40, 1)
    ids = []
    for c in range(3):
        one = scene | {
            "viewmats": scene["viewmats"][c : c + 1],
            "Ks": scene["Ks"][c : c + 1],
            "colors": colors[c],
        }
        image, alpha, single = rasterize(
            **one, width=40, height=30, backgrounds=backgrounds[c : c + 1]
        )
        assert torch.equal(image[0], images[c]) and torch.equal(alpha[0], alphas[c])
        ids.append(single["gaussian_ids"])
        assert torch.equal(meta["gaussian_ids"][meta["camera_ids"] == c], single["gaussian_ids"])
    assert torch.equal(torch.cat(ids), meta["gaussian_ids"])


def test_meta_describes_the_projection():
    """Depths, means, conics and radii of the visible Gaussians equal the reference projection."""
    scene = random_scene(seed=4)
    _, _, meta = rasterize(**scene, width=67, height=45)
    s = {k: v.double() for k, v in scene.items()}
    p = reference.project(
        s["means"],
        s["quats"],
        s["scales"],
        s["opacities"],
        s["viewmats"][0],
        s["Ks"][0],
        67,
        45,
    )
    order = torch.argsort(p.ids)
    assert torch.equal(meta["gaussian_ids"], p.ids[order])
    torch.testing.assert_close(meta["depths"].double(), p.depth[order], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(meta["means2d"].double(), p.mean[order], rtol=1e-5, atol=1e-3)
    conic = torch.linalg.inv(p.covariance[order])
    packed = torch.stack([conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1]], 1)
    torch.testing.assert_close(meta["conics"].double(), packed, rtol=2e-4, atol=1e-6)
    assert torch.equal(meta["opacities"], scene["opacities"][meta["gaussian_ids"]])
    extent = torch.sqrt(2 * torch.log(255 * meta["opacities"].double()))
    radii = extent[:, None] * torch.sqrt(torch.diagonal(p.covariance[order], dim1=1, dim2=2))
    assert meta["radii"].dtype == torch.int32
    assert ((meta["radii"] - radii) > -1e-3).all() and ((meta["radii"] - radii) < 1.001).all()


@pytest.mark.parametrize("simd", LEVELS)
def test_thread_counts_give_equal_bits(simd):
    """One, two and three threads render the same bits, frame after frame."""
    scene = random_scene(count=6000, seed=5, size=(131, 77))
    first = None
    for threads in (1, 2, 3, 2, 1):
        image, alpha, _ = rasterize(
            **scene,
            width=131,
            height=77,
            render_mode="RGB+D",
            renderer=create_renderer(threads, simd),
        )
        first = first or (image, alpha)
        assert torch.equal(image, first[0]) and torch.equal(alpha, first[1])


def test_scratch_memory_does_not_leak_between_frames():
    """A frame is the same before and after frames of other scenes and sizes."""
    small, large = random_scene(seed=6), random_scene(count=9000, seed=7)
    before, _, _ = rasterize(**small, width=67, height=45)
    rasterize(**large, width=200, height=150)
    after, _, _ = rasterize(**small, width=67, height=45)
    assert torch.equal(before, after)


@pytest.mark.parametrize("simd", LEVELS)
def test_single_gaussian_is_the_analytic_bell(simd):
    """An isotropic Gaussian on the axis is o exp(-r^2 / 2 s^2), s^2 = (f scale / z)^2 + eps2d."""
    scene = single_gaussian()
    image, alpha, _ = rasterize(
        **scene, width=33, height=33, render_mode="RGB+ED", renderer=create_renderer(1, simd)
    )
    v, u = np.mgrid[0:33, 0:33]
    r2 = (u - 16.0) ** 2 + (v - 16.0) ** 2
    bell = 0.5 * np.exp(-0.5 * r2 / ((100 * 0.1 / 2) ** 2 + 0.3))
    bell[bell < 1 / 255] = 0
    np.testing.assert_allclose(alpha[0, ..., 0], bell, atol=1e-6)
    np.testing.assert_allclose(image[0, ..., 2], 0.8 * bell, atol=1e-6)
    np.testing.assert_allclose(image[0, ..., 3], np.where(bell > 0, 2.0, 0.0), atol=1e-6)


def test_two_gaussians_blend_front_to_back():
    """The nearer Gaussian hides the farther by its alpha, whatever their order in the input."""
    a, b = single_gaussian(0.6, color=(1.0, 0, 0)), single_gaussian(0.8, depth=3, color=(0, 1.0, 0))
    shared: dict[str, Any] = {"viewmats": a.pop("viewmats"), "Ks": a.pop("Ks")}
    for order in ((a, b), (b, a)):
        scene: dict[str, Any] = {name: torch.cat([s[name] for s in order]) for name in a}
        scene |= shared
        image, alpha, _ = rasterize(**scene, width=33, height=33, render_mode="RGB+D")
        centre = image[0, 16, 16]
        torch.testing.assert_close(centre, torch.tensor([0.6, 0.4 * 0.8, 0, 0.6 * 2 + 0.32 * 3]))
        torch.testing.assert_close(alpha[0, 16, 16, 0], torch.tensor(0.92))


def test_equal_depths_blend_in_input_order():
    """Thousands of Gaussians at one depth composite in the order they are given."""
    count = 3000
    scene = single_gaussian(0.3)
    shared = {"viewmats": scene.pop("viewmats"), "Ks": scene.pop("Ks")}
    scene = {name: a.repeat(count, *[1] * (a.ndim - 1)) for name, a in scene.items()} | shared
    scene["colors"] = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    image, _, _ = rasterize(**scene, width=33, height=33)
    T, expected = 1.0, torch.zeros(3, dtype=torch.float64)
    for color in scene["colors"].double():
        if T * 0.7 <= 1e-4:
            break
        expected += 0.3 * T * color
        T *= 0.7
    torch.testing.assert_close(image[0, 16, 16].double(), expected, rtol=0, atol=1e-6)


def test_alpha_is_capped_and_a_saturated_pixel_stops():
    """Alpha never exceeds 0.99 a Gaussian, and the one that would bring T to 1e-4 is left out."""
    scene = single_gaussian(1.0)
    shared = {"viewmats": scene.pop("viewmats"), "Ks": scene.pop("Ks")}
    scene = {name: a.repeat(3, *[1] * (a.ndim - 1)) for name, a in scene.items()} | shared
    _, alpha, _ = rasterize(**scene, width=33, height=33)
    # T: 1 -> 0.01; the second would give 1e-4, which rounding puts on either side of the limit.
    assert alpha[0, 16, 16, 0] == pytest.approx(0.99, abs=1e-6) or alpha[0, 16, 16, 0] < 0.99991
    scene["opacities"] = torch.tensor([0.99, 0.98, 0.98])
    _, alpha, _ = rasterize(**scene, width=33, height=33)
    assert alpha[0, 16, 16, 0] == pytest.approx(1 - 0.01 * 0.02, abs=1e-6)


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (16, 16), (17, 33), (97, 1)])
def test_odd_sizes_agree_with_reference(size):
    """Images that end inside tiles and blocks are complete and equal the reference."""
    width, height = size
    scene = random_scene(seed=8, size=size)
    expected = call_reference(scene, width, height)
    image, _, _ = rasterize(**scene, width=width, height=height)
    assert image.shape == (1, height, width, 3)
    clear = expected.margin > 1e-4
    assert (image[0].double() - expected.color).abs()[clear].max() < 2e-4


def test_empty_scene_is_background():
    """No Gaussians give the background, alpha 0 and depth 0."""
    scene = random_scene(count=0)
    background = torch.tensor([[0.1, 0.2, 0.3]])
    image, alpha, meta = rasterize(
        **scene, width=20, height=10, backgrounds=background, render_mode="RGB+ED"
    )
    assert torch.equal(image[0, ..., :3], background.expand(10, 20, 3))
    assert not image[0, ..., 3].any() and not alpha.any()
    assert len(meta["gaussian_ids"]) == 0


@pytest.mark.parametrize(
    ("depth", "visible"), [(-2.0, False), (0.0, False), (0.0099, False), (0.01, True), (5.0, True)]
)
def test_near_plane_is_the_limit(depth, visible):
    """A Gaussian is drawn if its centre is at or beyond the near plane, never if behind it."""
    scene = single_gaussian(depth=depth, scale=0.001)
    _, alpha, meta = rasterize(**scene, width=33, height=33)
    assert bool(alpha.any()) == visible and len(meta["depths"]) == visible


def test_far_plane_and_radius_clip_leave_gaussians_out():
    """Beyond far_plane, or no larger on the image than radius_clip, Gaussians vanish."""
    scene = single_gaussian(depth=5.0)
    radius = int(rasterize(**scene, width=33, height=33)[2]["radii"].max())
    cases: list[tuple[dict[str, Any], bool]] = [
        ({"far_plane": 4.9}, False),
        ({"far_plane": 5.0}, True),
        ({"radius_clip": float(radius)}, False),
        ({"radius_clip": radius - 1.0}, True),
    ]
    for options, visible in cases:
        _, alpha, _ = rasterize(**scene, width=33, height=33, **options)
        assert bool(alpha.any()) == visible, options


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e4, 1e12, 1e25])
def test_extreme_scales_stay_finite(scale, simd):
    """Specks still cover their pixel (eps2d), giants fill the image, and nothing is NaN."""
    scene = single_gaussian(scale=scale)
    image, alpha, _ = rasterize(
        **scene, width=33, height=33, render_mode="RGB+ED", renderer=create_renderer(1, simd)
    )
    assert torch.isfinite(image).all() and torch.isfinite(alpha).all()
    assert alpha[0, 16, 16, 0] == pytest.approx(0.5, abs=1e-4)
    if scale > 1:
        torch.testing.assert_close(alpha, torch.full_like(alpha, 0.5))


def test_zero_opacity_is_invisible():
    """Opacity 0, and any below 1/255, leaves no trace."""
    for opacity in (0.0, 1e-30, 0.99 / 255):
        _, alpha, meta = rasterize(**single_gaussian(opacity), width=33, height=33)
        assert not alpha.any() and len(meta["depths"]) == 0


def test_accuracy_does_not_depend_on_distance_from_the_origin():
    """A scene and a rotated camera 2 km from the origin agree with the reference as well as any."""
    scene = random_scene(seed=10)
    shift = torch.tensor([1024.0, -2048.0, 512.0])
    scene["means"] = scene["means"] + shift
    X_CW = scene["viewmats"][0].double()
    X_CW[:3, 3] -= X_CW[:3, :3] @ shift.double()
    scene["viewmats"] = X_CW.float()[None]
    expected = call_reference(scene, 67, 45)
    image, _, _ = rasterize(**scene, width=67, height=45)
    assert_agrees(image[0], expected.color, expected.margin > 1e-4)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(0, 60),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    spread=st.floats(-3, 3),
    log_scale=st.floats(-8, 4),
    mode=st.sampled_from(["RGB", "D", "ED", "RGB+D", "RGB+ED"]),
    simd=st.sampled_from(LEVELS),
    threads=st.integers(1, 2),
)
def test_fuzz_finite_and_bounded(
    seed, count, width, height, spread, log_scale, mode, simd, threads
):
    """Any valid scene renders finite values, alpha in [0, 1] and colours within their hull."""
    scene = random_scene(count=count, seed=seed, size=(width, height))
    scene["means"] *= 10.0**spread
    scene["scales"] = 10.0 ** (log_scale + normal_tensor(seed, count, 3))
    image, alpha, _ = rasterize(
        **scene,
        width=width,
        height=height,
        render_mode=mode,
        renderer=create_renderer(threads, simd),
    )
    assert torch.isfinite(image).all()
    assert (alpha >= 0).all() and (alpha <= 1 + 1e-6).all()
    if mode.startswith("RGB"):
        assert (image[..., :3] >= 0).all() and (image[..., :3] <= 1 + 1e-5).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), spread=st.floats(-1, 1), log_scale=st.floats(-3, 0))
def test_fuzz_agrees_with_reference(seed, spread, log_scale):
    """Random scenes agree with the reference wherever no decision is within rounding."""
    scene = random_scene(count=80, seed=seed, size=(29, 23))
    scene["means"] *= 10.0**spread
    scene["scales"] = scene["scales"] * 10.0**log_scale
    expected = call_reference(scene, 29, 23)
    image, _, _ = rasterize(**scene, width=29, height=23)
    error = (image[0].double() - expected.color).abs().amax(-1)
    clear = expected.margin > 1e-2
    assert not clear.any() or error[clear].max() < 2e-3


def test_simd_levels_agree_with_each_other():
    """Levels differ by rounding only."""
    scene = random_scene(count=2000, seed=11, size=(131, 77))
    images = [
        rasterize(**scene, width=131, height=77, renderer=create_renderer(1, level))[0]
        for level in LEVELS
    ]
    for image in images[1:]:
        error = (image - images[0]).abs()
        assert error.median() < 1e-6 and (error > 1e-3).float().mean() < 1e-3


def test_unavailable_simd_level_is_an_error():
    """A level that does not exist is refused, and the message lists those that do."""
    with pytest.raises(ValueError, match=f"'avx3' is not available.*{LEVELS[0]}"):
        create_renderer(simd="avx3")


def _with(name, value):
    def change(scene):
        return scene | {name: value(scene[name])}

    return change


def _set(index, value):
    def change(tensor):
        tensor = tensor.clone()
        tensor[index] = value
        return tensor

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_with("means", lambda t: t[:, :2]), r"means has shape \(300, 2\); it must be \(300, 3\)"),
        (_with("quats", lambda t: t[:-1]), r"quats has shape \(299, 4\)"),
        (_with("opacities", lambda t: t[:, None]), r"opacities has shape \(300, 1\)"),
        (_with("colors", lambda t: t[:, :1]), r"colors has shape \(300, 1\).*sh_degree=None"),
        (_with("viewmats", lambda t: t[0]), r"viewmats has shape \(4, 4\)"),
        (_with("viewmats", lambda t: t[:0]), r"(viewmats|Ks) has shape"),
        (_with("scales", lambda t: t.double()), r"scales is torch.float64.*\.float\(\)"),
        (_with("means", _set((7, 1), math.nan)), r"means\[7, 1\] is nan; it must be finite"),
        (_with("colors", _set((9, 2), math.inf)), r"colors\[9, 2\] is inf"),
        (_with("scales", _set((3, 0), 0.0)), r"scales\[3, 0\] is 0; it must be positive"),
        (_with("scales", _set((3, 2), -1.0)), r"scales\[3, 2\] is -1"),
        (_with("opacities", _set(4, 1.5)), r"opacities\[4\] is 1.5; it must lie in \[0, 1\]"),
        (_with("quats", _set(5, 0.0)), r"quats\[5\] is \[0.0, 0.0, 0.0, 0.0\]"),
        (_with("Ks", _set((0, 0, 0), 0.0)), r"focal lengths K\[0, 0\] = 0"),
        (_with("viewmats", lambda t: 2 * t), r"viewmats\[0\] is not a rigid transform"),
        (_with("Ks", lambda t: t.clone().requires_grad_()), r"Ks requires a gradient.*detach"),
        (lambda s: s | {"rasterize_mode": "smooth"}, r"rasterize_mode is 'smooth'; .* antialiased"),
        (lambda s: s | {"width": 0}, r"image size is 0 x 45"),
        (lambda s: s | {"height": -3}, r"image size is 67 x -3"),
        (lambda s: s | {"near_plane": 0.0}, r"0 < near < far"),
        (lambda s: s | {"far_plane": 0.001}, r"0 < near < far"),
        (lambda s: s | {"render_mode": "RGBD"}, r"render_mode is 'RGBD'; it must be one of RGB, D"),
        (lambda s: s | {"sh_degree": 4}, r"sh_degree is 4"),
        (lambda s: s | {"sh_degree": 1}, r"colors has shape \(300, 3\).*sh_degree=1"),
        (lambda s: s | {"eps2d": -0.1}, r"eps2d is -0.1"),
        (lambda s: s | {"backgrounds": torch.zeros(3)}, r"backgrounds has shape \(3,\)"),
    ],
)
def test_bad_input_is_named(change, message):
    """Each mistake raises ValueError that names the tensor, the place, the value and the limit."""
    scene = change(random_scene() | {"width": 67, "height": 45})
    with pytest.raises(ValueError, match=message):
        rasterize(**scene)


def test_too_few_coefficients_are_named():
    """A degree that the coefficients do not reach is an error."""
    scene = random_scene(sh_degree=1)
    with pytest.raises(ValueError, match=r"4 coefficients; sh_degree=2 needs 9"):
        rasterize(**scene, width=8, height=8, sh_degree=2)


def test_tensors_on_other_devices_are_refused():
    """A device without a backend, or a mixture of devices, is an error, never a silent copy."""
    scene = random_scene(count=3)
    with pytest.raises(ValueError, match="quats is on meta and means on cpu"):
        rasterize(**(scene | {"quats": scene["quats"].to("meta")}), width=8, height=8)
    with pytest.raises(ValueError, match="tensors are on meta"):
        rasterize(**{k: v.to("meta") for k, v in scene.items()}, width=8, height=8)
