import math
import types
from functools import partial
from typing import Any

import numpy as np
import pytest
import reference_surfels as reference
import torch
from random_scenes import normal, normal_tensor
from random_scenes import random_scene as random_gaussians
from reference_rasterizer import SCENE, leaves, repeated, rotation_matrices, single_gaussian

from splatpilot import _native
from splatpilot.systems.splats import surfel_rasterization
from splatpilot.systems.splats.baked_scene import create_renderer
from splatpilot.systems.splats.rasterization import rasterize
from splatpilot.systems.splats.surfel_rasterization import depth_to_normals, rasterize_surfels

LEVELS = _native.simd_levels()
WIDTH, HEIGHT = 45, 33
LEARNED = (*SCENE, "viewmats")
OUTPUTS = ("color", "alpha", "normal", "depth", "median", "distort")


def random_scene(**options) -> dict[str, Any]:
    return random_gaussians(log2_scale=(-3.3, 1.0), size=(WIDTH, HEIGHT), **options)


def edge_on_scene(sine: float, count: int = 60) -> dict[str, Any]:
    """Surfels whose planes meet the rays through their centers at `sine`, all on the image."""
    scene, generator = random_scene(count=count), np.random.default_rng(0)
    X_CW = scene["viewmats"][0].double().numpy()
    ray_W = X_CW[2, :3] + 0.1 * normal(generator, count, 3)
    across_W = np.cross(ray_W, normal(generator, count, 3))
    ray_W, across_W = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (ray_W, across_W))
    x, y, z = (sine * ray_W + (1.0 - sine * sine) ** 0.5 * across_W).T  # of the normal
    means = (1.5 + 2.0 * generator.random((count, 1))) * ray_W - X_CW[:3, 3] @ X_CW[:3, :3]
    quats = np.column_stack([1.0 + z, -y, x, 0.0 * z])
    return scene | {"means": torch.tensor(means).float(), "quats": torch.tensor(quats).float()}


def render(scene, width=WIDTH, height=HEIGHT, **options) -> dict[str, torch.Tensor]:
    options = {"render_mode": "RGB+D", "distloss": True} | options
    image, alpha, normal, surface, distort, median, _ = rasterize_surfels(
        **scene, width=width, height=height, **options
    )
    named = {"alpha": alpha, "distort": distort, "median": median}
    images = {name: a[0, ..., 0] for name, a in named.items()}
    images |= {"color": image[0, ..., :3], "depth": image[0, ..., -1], "normal": normal[0]}
    return images if surface is None else images | {"surface": surface[0]}


def test_images_agree_with_reference():
    scene = random_scene() | {"backgrounds": torch.tensor([[0.1, 0.7, 0.3]])}
    expected = reference.render(scene, WIDTH, HEIGHT)
    clear = expected.margin > 1e-4
    assert clear.float().mean() > 0.99
    for simd in LEVELS:
        images = render(scene, renderer=create_renderer(1, simd))
        for name in OUTPUTS:
            truth = getattr(expected, name)
            error = (images[name].double() - truth).abs()
            assert error.median() < 5e-7, (simd, name)
            assert (error / truth.abs().clamp(min=1))[clear].max() < 1e-4, (simd, name)


def loss_gradients(call, scene, clear, dtype) -> dict[str, torch.Tensor]:
    inputs = leaves(scene, dtype)
    images = call(inputs)
    loss = torch.zeros(())
    for seed, name in enumerate(OUTPUTS):
        weight = normal_tensor(seed, *images[name].shape).to(dtype)
        loss = loss + (images[name] * weight)[clear].sum()
    loss.backward()
    return {name: inputs[name].grad.double() for name in LEARNED}


def reference_gradients(scene, clear, dtype=torch.float64, **options) -> dict[str, torch.Tensor]:
    def call(s):
        return reference.render(s, WIDTH, HEIGHT, dtype=dtype, **options)._asdict()

    return loss_gradients(call, scene, clear, dtype)


def native_gradients(scene, clear, simd: str, **options) -> dict[str, torch.Tensor]:
    call = partial(render, renderer=create_renderer(1, simd), **options)
    return loss_gradients(call, scene, clear, torch.float32)


def lengths(gradient: torch.Tensor) -> torch.Tensor:
    return gradient.reshape(len(gradient), -1).norm(dim=1)


@pytest.mark.parametrize("sh_degree", [None, 3])
def test_gradients_agree_with_reference(sh_degree):
    scene = random_scene(seed=3, sh_degree=sh_degree)
    clear = reference.render(scene, WIDTH, HEIGHT, sh_degree=sh_degree).margin > 1e-4
    exact = reference_gradients(scene, clear, sh_degree=sh_degree)
    # The change of float64 by half a unit in the last digit of the inputs.
    ends = {
        k: scene[k].double() * (1 + 2.0**-24 * normal_tensor(0, *scene[k].shape).sign())
        for k in LEARNED
    }
    other = reference_gradients(scene | ends, clear, sh_degree=sh_degree)
    moved = {k: 3 * lengths(other[k] - exact[k]) for k in LEARNED}
    for simd in LEVELS:
        ours = native_gradients(scene, clear, simd, sh_degree=sh_degree)
        for name in LEARNED:
            error = (ours[name] - exact[name]).abs()
            allowed = 1e-3 + 1e-5 * exact[name].abs()
            if name != "viewmats":  # each entry sums over the whole scene
                assert (error <= allowed).double().mean() > 0.99, name
            assert (lengths(error) <= lengths(allowed) + moved[name]).all(), name
            assert exact[name].abs().max() > 1


@pytest.mark.parametrize("sine", [1e-4, 1e-2])
def test_nearly_edge_on_surfels_keep_their_digits(sine):
    scene = edge_on_scene(sine)
    clear = reference.render(scene, WIDTH, HEIGHT).margin > 1e-2
    assert clear.float().mean() > 0.8
    exact = reference_gradients(scene, clear)
    single = reference_gradients(scene, clear, torch.float32)
    for simd in LEVELS:
        ours = native_gradients(scene, clear, simd)
        for name in ("means", "quats"):
            size = lengths(exact[name])
            seen = size > 0.1
            assert seen.sum() > 30
            error, theirs = (
                (lengths(g[name] - exact[name]) / size)[seen].square().mean().sqrt()
                for g in (ours, single)
            )
            assert error <= theirs, (simd, name)


def test_third_scale_does_not_matter():
    scene = random_scene(seed=2)
    other = scene | {"scales": scene["scales"].clone()}
    other["scales"][:, 2] = torch.tensor([0.0, math.nan, 1e9]).repeat(100)
    before, after = render(scene), render(other)
    assert all(torch.equal(before[name], after[name]) for name in OUTPUTS)


def tilted_plane(tilt=1.1) -> tuple[dict[str, Any], torch.Tensor, torch.Tensor]:
    g, count = torch.Generator().manual_seed(0), 3000
    normal = torch.tensor([0.0, math.sin(tilt), -math.cos(tilt)])
    sides = torch.tensor([[2.0, 0, 0], [0.0, 3 * math.cos(tilt), 3 * math.sin(tilt)]])
    # The z axis is minus the normal.
    scene = single_gaussian(scale=0.15, quat=(math.cos(tilt / 2), math.sin(tilt / 2), 0.0, 0.0))
    scene = repeated(scene, count)
    scene["means"] += (torch.rand(count, 2, generator=g) - 0.5) @ sides
    y, x = torch.meshgrid(torch.arange(33.0) - 16, torch.arange(33.0) - 16, indexing="ij")
    rays = torch.stack([x / 100, y / 100, torch.ones_like(x)], -1)
    return scene, normal, (2 * normal[2]) / (rays @ normal)


def test_tilted_plane_has_exact_depth_and_normals():
    scene, normal, depth = tilted_plane()
    images = render(scene, width=33, height=33, render_mode="RGB+ED")
    assert images["alpha"].min() > 0.99
    assert (images["depth"] / depth - 1).abs().max() < 1e-5
    assert (images["median"] / depth - 1).abs().max() < 1e-5
    assert images["distort"].abs().max() < 1e-4
    torch.testing.assert_close(images["normal"], images["alpha"][..., None] * normal)
    inner = images["surface"][1:-1, 1:-1]
    assert (inner - normal).abs().max() < 1e-3 and not images["surface"][0].any()
    gaussians, _, _ = rasterize(**scene, width=33, height=33, render_mode="RGB+ED")
    assert (gaussians[0, ..., 3] / depth - 1).abs().max() > 0.01
    R = rotation_matrices(torch.tensor([[1.0, 0.1, -0.2, 0.3]]))[0]
    scene["viewmats"][0, :3, :3] = R
    depths = depth[None, ..., None].requires_grad_()
    normals = depth_to_normals(depths, scene["viewmats"], scene["Ks"])
    assert (normals[0, 1:-1, 1:-1] - R.T @ normal).abs().max() < 1e-3
    normals[..., 0].sum().backward()
    assert depths.grad is not None and depths.grad.abs().max() > 0


def test_depth_without_a_plane_has_no_normal():
    depths = torch.zeros(1, 7, 7, 1)
    depths[0, 3, 3] = 2.0
    depths[0, 1, 1:5] = 2.0
    depths.requires_grad_()
    Ks = torch.tensor([[[100.0, 0, 3.5], [0, 100.0, 3.5], [0, 0, 1]]])
    normals = depth_to_normals(depths, torch.eye(4)[None], Ks)
    assert not normals[0, 5, 5].any() and torch.isfinite(normals).all()
    (normals * normal_tensor(0, *normals.shape)).sum().backward()
    assert depths.grad is not None and depths.grad.abs().max() < 1e3
    with pytest.raises(ValueError, match=r"depths must be of shape .* got \(7, 7\)"):
        depth_to_normals(depths[0, ..., 0], torch.eye(4)[None], Ks)


@pytest.mark.parametrize("quat", [(1.0, 1.0, 0, 0), (1.0, 1.0 + 1e-6, 0, 0), (1.0, 1.001, 0, 0)])
def test_edge_on_surfel_is_its_blob(quat):
    scene = leaves(single_gaussian(quat=quat))
    images = render(scene, width=33, height=33)
    assert images["alpha"][16, 16].item() == pytest.approx(0.5, abs=1e-5)
    assert images["depth"][16, 16].item() == pytest.approx(1.0, abs=1e-4)
    sum((image * image).sum() for image in images.values()).backward()
    assert all(torch.isfinite(scene[name].grad).all() for name in LEARNED)


def test_surfel_through_the_camera_plane_is_drawn_in_front_only():
    quat = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)  # normal along -y
    scene = single_gaussian(opacity=0.9, scale=3.0, depth=1.0, quat=quat)
    scene["means"][0, 1] = 0.5
    expected = reference.render(scene, 33, 33, near=0.2)
    images = render(scene, width=33, height=33, near_plane=0.2)
    assert not images["alpha"][:16].any() and images["alpha"][24:].min() > 0.01
    assert (images["alpha"].double() - expected.alpha).abs().max() < 1e-5
    assert (images["depth"].double() - expected.depth).abs().max() < 1e-4


def test_modes_and_meta():
    scene = random_scene(seed=4)
    depth = render(scene)
    expected = depth["depth"] / depth["alpha"].clamp(min=1e-10)
    meta = {}
    for mode, channels in {"RGB": 3, "D": 1, "ED": 1, "RGB+D": 4, "RGB+ED": 4}.items():
        image, _, _, surface, _, _, meta = rasterize_surfels(
            **scene, width=WIDTH, height=HEIGHT, render_mode=mode
        )
        assert image.shape == (1, HEIGHT, WIDTH, channels)
        assert (surface is None) == (mode == "RGB")
        if "ED" in mode:
            assert torch.equal(image[0, ..., -1], expected)
    ids = meta["gaussian_ids"]
    X_CW, K = scene["viewmats"][0].double(), scene["Ks"][0].double()
    p_C = scene["means"][ids].double() @ X_CW[:3, :3].T + X_CW[:3, 3]
    torch.testing.assert_close(meta["depths"].double(), p_C[:, 2], rtol=1e-5, atol=1e-6)
    pixels = (p_C @ K.T)[:, :2] / p_C[:, 2:]
    torch.testing.assert_close(meta["means2d"].double(), pixels, rtol=1e-4, atol=1e-3)
    assert (meta["normals"].double() @ X_CW[:3, :3].T * p_C).sum(1).max() <= 1e-6
    assert (meta["radii"] >= 1).all() and 0 < len(ids) < 300


class OnCuda(list):
    device = torch.device("cuda")


def test_gsplat_gives_pairs_with_normals_in_the_world(monkeypatch):
    C, N = 1, 5
    shown = torch.rand(C, HEIGHT, WIDTH, 4)
    alpha, normals = torch.rand(C, HEIGHT, WIDTH, 1), torch.rand(C, N, 3)
    radii = torch.tensor([[[3, 3], [0, 2], [1, 1], [0, 0], [2, 0]]], dtype=torch.int32)

    def rasterization_2dgs(*arguments, **_):
        assert arguments[4].shape == (C, N, 3)  # as gsplat joins depths (C, N, 1) to colors
        meta = {name: torch.rand(C, N) for name in ("depths", "opacities", "means2d")}
        meta |= {"radii": radii, "normals": normals}
        return shown, alpha, shown[..., :3], shown[0, ..., :3], alpha, alpha, meta

    stand_in = types.SimpleNamespace(rasterization_2dgs=rasterization_2dgs)
    monkeypatch.setattr(surfel_rasterization, "import_extra", lambda *_: stand_in)
    monkeypatch.setattr(surfel_rasterization, "named_tensors", lambda *_, **__: None)
    scene = random_scene(count=N) | {"means": OnCuda([0.0] * N)}
    scene["viewmats"][0, :3, :3] = R = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    options = {"width": WIDTH, "height": HEIGHT, "render_mode": "RGB+ED"}
    _, _, _, surface, _, _, meta = rasterize_surfels(**scene, **options)
    assert surface is not None and surface.shape == (1, HEIGHT, WIDTH, 3)
    assert meta["gaussian_ids"].tolist() == [0, 2] and meta["camera_ids"].tolist() == [0, 0]
    assert len(meta["radii"]) == len(meta["depths"]) == 2
    torch.testing.assert_close(meta["normals"], normals[0, [0, 2]] @ R)
