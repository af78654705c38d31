"""Tests of rendering through distorted cameras."""

import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from random_scenes import normal_tensor
from torch import Tensor

from splatpilot.systems.splats import rasterize
from splatpilot.systems.splats.baked_scene import create_renderer
from splatpilot.systems.splats.camera_models import project_fisheye

SIZE = (160, 120)
K = torch.tensor([[110.0, 0, 78.0], [0, 105.0, 61.0], [0, 0, 1]], dtype=torch.float64)
RADIAL = torch.tensor([-0.28, 0.09, -0.012, 0.03, 0.01, 0.002], dtype=torch.float64)
TANGENTIAL = torch.tensor([0.003, -0.002], dtype=torch.float64)
FISHEYE = torch.tensor([0.04, -0.012, 0.005, -0.001], dtype=torch.float64)


def lens(model: str, dtype=torch.float32, cameras: int = 1) -> dict[str, Any]:
    """`rasterize`'s arguments for a distorted camera."""
    rows = {
        "opencv": {"radial_coeffs": RADIAL, "tangential_coeffs": TANGENTIAL},
        "zero": {"radial_coeffs": torch.zeros(6)},
        "fisheye": {"radial_coeffs": FISHEYE},
    }[model]
    lens: dict[str, Any] = {name: row.to(dtype).repeat(cameras, 1) for name, row in rows.items()}
    lens["camera_model"] = "fisheye" if model == "fisheye" else "pinhole"
    return lens


def blobs(count: int, scale: float, seed: int = 0, spread: float = 0.6) -> dict[str, Any]:
    """Gaussians of `scale` times their depth, at slopes |x/z|, |y/z| up to `spread`."""
    g = torch.Generator().manual_seed(seed)
    z = 2 + 2 * torch.rand(count, 1, generator=g)
    slopes = spread * (2 * torch.rand(count, 2, generator=g) - 1)
    return {
        "means": torch.cat([slopes * z, z], 1),
        "quats": normal_tensor(seed, count, 4),
        "scales": scale * z * (0.5 + torch.rand(count, 3, generator=g)),
        "opacities": 0.3 + 0.6 * torch.rand(count, generator=g),
        "colors": torch.rand(count, 3, generator=g),
        "viewmats": torch.eye(4)[None],
        "Ks": K.float()[None],
    }


def test_zero_distortion_is_the_pinhole():
    """In every mode, for s/z = 1/400, images equal the pinhole's by 5e-5 (depths of up to 4 m: by
    3e-4 m) in the mean, and but for a few contributions of 1/255 that cross the cut."""
    scene = blobs(4000, 1 / 400)
    for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED"):
        for rasterize_mode in ("classic", "antialiased"):
            options: dict[str, Any] = {"render_mode": mode, "rasterize_mode": rasterize_mode}
            options["backgrounds"] = torch.tensor([[0.2, 0.5, 0.9]])
            image, alpha, meta = rasterize(**scene, width=160, height=120, **options)
            got, got_alpha, got_meta = rasterize(
                **scene, width=160, height=120, **options, **lens("zero")
            )
            assert torch.equal(got_meta["gaussian_ids"], meta["gaussian_ids"])
            assert (got_alpha - alpha).abs().max() < 5e-3
            covered = (alpha > 0.1) & (got_alpha > 0.1)
            error = (got - image).abs() * covered
            assert covered.float().mean() > 0.1
            assert error.mean() < (5e-5 if mode == "RGB" else 3e-4)
            assert error.max() < (5e-3 if mode == "RGB" else 0.05)


def test_spherical_harmonics_see_the_pose():
    """Colours from spherical harmonics are the pinhole's for a camera that is moved and turned."""
    scene = blobs(2000, 1 / 400)
    scene["colors"] = normal_tensor(1, 2000, 16, 3)
    cos, sin = math.cos(0.2), math.sin(0.2)
    scene["viewmats"] = torch.tensor(
        [[[cos, 0, sin, -0.5], [0, 1, 0, 0.3], [-sin, 0, cos, 0.2], [0, 0, 0, 1]]]
    )
    images = [
        rasterize(**scene, width=160, height=120, sh_degree=3, **options)[0]
        for options in ({}, lens("zero"))
    ]
    assert images[0].mean() > 0.02
    assert (images[1] - images[0]).abs().mean() < 1e-4


def test_margin():
    """Near the camera plane, where images are stretched without bound, Gaussians are left out."""
    scene = blobs(2, 0.01)
    scene["means"] = torch.tensor([[1.0, 0, 0.05], [0.9, 0, 1]])
    scene["scales"] = torch.tensor([[0.1, 0.1, 0.01]]).repeat(2, 1)
    _, _, meta = rasterize(**scene, width=160, height=120, **lens("zero"))
    assert meta["gaussian_ids"].tolist() == [1]


def test_means_shift_with_curvature():
    """Without distortion means differ from the pinhole's by at most f (s/z)^2, quadratically."""
    shifts = []
    for scale in (1 / 100, 1 / 400):
        scene = blobs(400, scale)
        means = [
            rasterize(**scene, width=160, height=120, **options)[2]["means2d"]
            for options in ({}, lens("zero"))
        ]
        shifts.append(float((means[1] - means[0]).norm(dim=1).max()))
        assert shifts[-1] < 110 * (1.5 * scale) ** 2
    assert 10 < shifts[0] / shifts[1] < 25  # 16


@pytest.mark.parametrize("model", ["opencv", "fisheye"])
def test_undistorted_render_is_the_pinhole_render(model):
    """OpenCV's undistortion of a distorted render is the pinhole's render.

    What remains is interpolation and, proportional to the size of the Gaussians, what a projected
    Gaussian lacks to be one; a shift by half a pixel would be three times as much.
    """
    width, height = 2 * SIZE[0], 2 * SIZE[1]
    scene = blobs(1500, 0.012, spread=0.8)
    K_cv = K.numpy() * [[2], [2], [1]]
    scene["Ks"] = torch.from_numpy(K_cv).float()[None]
    options: dict[str, Any] = {"width": width, "height": height, "eps2d": 0.0}
    distorted = rasterize(**scene, **options, **lens(model))[0][0].numpy()
    pinhole = rasterize(**scene, **options)[0][0].numpy()
    K_cv[:2, 2] -= 0.5  # OpenCV's pixel centres are whole numbers
    shape = (np.eye(3), K_cv, (width, height), cv2.CV_32FC1)
    if model == "fisheye":
        maps = cv2.fisheye.initUndistortRectifyMap(K_cv, FISHEYE.numpy(), *shape)
    else:
        order = [0, 1, 6, 7, 2, 3, 4, 5]
        coefficients = torch.cat([RADIAL, TANGENTIAL])[order].numpy()
        maps = cv2.initUndistortRectifyMap(K_cv, coefficients, *shape)
    undistorted = cv2.remap(distorted, *maps, cv2.INTER_LANCZOS4)
    x, y = maps
    inside = (x > 4) & (x < width - 5) & (y > 4) & (y < height - 5)
    error = np.abs(undistorted - pinhole)[inside]
    untouched = np.abs(distorted - pinhole)[inside]
    assert inside.mean() > 0.7
    assert error.mean() < 0.002 and np.quantile(error, 0.99) < 0.012
    assert untouched.mean() > 0.1


@pytest.mark.parametrize("model", ["opencv", "fisheye"])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_rendered_gradients(model, rasterize_mode):
    """Derivatives of colour, depth and alpha by every input agree with finite differences.

    Every Gaussian covers the whole image and none hides another, so that no threshold is met.
    """
    g = torch.Generator().manual_seed(2)
    scene = blobs(5, 1.2, seed=3, spread=0.3) | lens(model)
    scene["opacities"] = scene["opacities"] * 0.5
    scene["colors"] = 0.2 * normal_tensor(2, 5, 9, 3)
    scene["backgrounds"] = torch.rand(1, 3, generator=g)
    if rasterize_mode == "antialiased":
        scene["eps2d"] = 30.0
    tensors = {name: t for name, t in scene.items() if isinstance(t, Tensor)}
    options = {name: t for name, t in scene.items() if name not in tensors}
    weights = torch.rand(1, 24, 32, 5, generator=g, dtype=torch.float64)
    scene["Ks"] = tensors["Ks"] = tensors["Ks"] * torch.tensor([[0.2], [0.2], [1.0]])

    def loss(**tensors):
        image, alpha, meta = rasterize(
            **tensors, **options, width=32, height=24, sh_degree=2, render_mode="RGB+ED",
            rasterize_mode=rasterize_mode,
        )  # fmt: skip
        assert len(meta["gaussian_ids"]) == 5
        return (torch.cat([image, alpha], -1).double() * weights).sum()

    leaves = {name: t.clone().requires_grad_() for name, t in tensors.items()}
    loss(**leaves).backward()
    for seed, (name, tensor) in enumerate(tensors.items()):
        gradient = leaves[name].grad
        assert gradient is not None and gradient.isfinite().all()
        direction = normal_tensor(seed, *tensor.shape)
        if name == "viewmats":
            direction[:, 3] = 0
            direction *= 0.1  # stays a rotation to the tolerance of the check
        if name == "Ks":
            direction = direction * 10 * (tensor > 1)
        h = 2e-3
        with torch.no_grad():
            ends = [loss(**(tensors | {name: tensor + s * h * direction})) for s in (1, -1)]
        expected = float(ends[0] - ends[1]) / (2 * h)
        got = float((gradient.double() * direction).sum())
        scale = float((gradient.double() * direction).abs().sum())
        assert abs(got - expected) < 2e-3 * scale, name


def test_fold_backs_are_culled():
    """What lies beyond the valid range is left out, though the polynomials have a place for it."""
    inside = torch.tensor([[0.3, 0.0, 1.0]])
    beyond = torch.tensor([[1.5, 0.0, 1.0], [0.0, 1.4, 1.0]])  # at r' = 0.15 and 0.31
    behind = torch.tensor([[0.0, 0.0, -2.0], [0.3, 0.1, -1.0]])
    across = torch.tensor([[0.9, 0.0, 1.0]])  # its centre is within, a sigma point is not
    means = torch.cat([inside, beyond, behind, across])
    scene = blobs(len(means), 0.01) | {"means": means, "scales": torch.full((len(means), 3), 0.02)}
    scene["scales"][-1] = 0.3
    barrel: dict[str, Any] = {"radial_coeffs": torch.tensor([[-0.4, 0.0]])}
    fisheye: dict[str, Any] = {
        "camera_model": "fisheye",
        "radial_coeffs": torch.tensor([[-0.6, 0.0, 0.0, 0.0]]),
    }
    for options in (barrel, fisheye):
        leaves = {n: t.clone().requires_grad_() for n, t in scene.items()}
        image, _, meta = rasterize(**leaves, width=SIZE[0], height=SIZE[1], **options)
        assert meta["gaussian_ids"].tolist() == [0]
        image.sum().backward()
        for name, leaf in leaves.items():
            assert leaf.grad is not None and leaf.grad.isfinite().all(), name
        assert not leaves["means"].grad[1:].any()  # pyright: ignore[reportOptionalSubscript]


def test_depth_range_and_field_of_view():
    """Near, far and the fisheye's angle limit cull by the centre; depth is planar z."""
    means = torch.tensor([[0, 0, 0.5], [0, 0, 2.0], [3.0, 2.0, 5.0], [0.8, 0, 1.0]])
    scene = blobs(4, 0.01) | {"means": means, "scales": torch.full((4, 3), 0.02)}
    for model in ("opencv", "fisheye"):
        options: dict[str, Any] = lens(model) | {"near_plane": 1.0, "far_plane": 4.0}
        _, _, meta = rasterize(**scene, width=160, height=120, **options)
        assert meta["gaussian_ids"].tolist() == [1, 3]
        assert meta["depths"].tolist() == [2.0, 1.0]
    options: dict[str, Any] = lens("fisheye") | {
        "near_plane": 1.0,
        "far_plane": 4.0,
        "max_angle": 0.5,
    }
    _, _, meta = rasterize(**scene, width=160, height=120, **options)  # atan(0.8) = 0.67
    assert meta["gaussian_ids"].tolist() == [1]
    depth, _, _ = rasterize(**scene, width=160, height=120, render_mode="ED", **lens("fisheye"))
    u, v = meta_pixel(scene, 2)
    assert depth[0, v, u, 0] == pytest.approx(5.0, abs=1e-4)


def meta_pixel(scene, index: int) -> tuple[int, int]:
    pixels, _ = project_fisheye(scene["means"][index].double(), K, FISHEYE)
    return int(pixels[0]), int(pixels[1])


def test_fisheye_sees_to_the_side():
    """At 80 degrees from the axis a fisheye shows what leaves a pinhole's image."""
    angle = math.radians(80)
    scene = blobs(1, 0.02)
    scene["means"] = torch.tensor([[2 * math.sin(angle), 0.0, 2 * math.cos(angle)]])
    scene["Ks"] = torch.tensor([[[50.0, 0, 80], [0, 50, 60], [0, 0, 1]]])
    _, alpha, meta = rasterize(**scene, width=160, height=120, camera_model="fisheye")
    assert meta["means2d"][0].tolist() == pytest.approx([80 + 50 * angle, 60], abs=0.1)
    assert alpha[0, 60, int(80 + 50 * angle), 0] > 0.2
    assert rasterize(**scene, width=160, height=120)[1].max() == 0


def test_same_bits_for_any_number_of_threads():
    """Images and gradients are equal bit for bit with 1, 2 and 4 threads."""
    results = []
    for threads in (1, 2, 4):
        scene: dict[str, Any] = {
            n: t.requires_grad_() for n, t in blobs(5000, 0.02, seed=4).items()
        }
        image, alpha, _ = rasterize(
            **scene,
            width=160,
            height=120,
            render_mode="RGB+ED",
            renderer=create_renderer(threads),
            **lens("opencv"),
        )
        (image.square().sum() + alpha.sum()).backward()
        results.append([image, alpha, *(t.grad for t in scene.values())])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_batches_of_cameras():
    """Each camera of a batch renders what it renders alone, with its own coefficients."""
    scene, coefficients = blobs(200, 0.02), lens("opencv", cameras=2)
    coefficients["radial_coeffs"][1] *= -0.5
    scene["viewmats"] = torch.eye(4).repeat(2, 1, 1)
    scene["viewmats"][1, 0, 3] = 0.4
    scene["Ks"] = scene["Ks"].repeat(2, 1, 1)
    image, _, meta = rasterize(**scene, width=160, height=120, **coefficients)
    for c in (0, 1):
        names = ("viewmats", "Ks")
        one: dict[str, Any] = scene | {n: scene[n][c : c + 1] for n in names}
        own: dict[str, Any] = {
            n: t[c : c + 1] for n, t in coefficients.items() if n != "camera_model"
        }
        alone, _, own_meta = rasterize(**one, width=160, height=120, **own)
        assert torch.equal(alone[0], image[c])
        assert torch.equal(own_meta["means2d"], meta["means2d"][meta["camera_ids"] == c])
    assert not torch.equal(image[0], image[1])

    def gradient(views, **options) -> Tensor:
        means = scene["means"].clone().requires_grad_()
        inputs: dict[str, Any] = views | {"means": means}
        rasterize(**inputs, width=160, height=120, **options)[0].square().sum().backward()
        assert means.grad is not None
        return means.grad

    single = [
        gradient(
            scene | {n: scene[n][c : c + 1] for n in ("viewmats", "Ks")},
            **{n: t[c : c + 1] for n, t in coefficients.items() if n != "camera_model"},
        )
        for c in (0, 1)
    ]
    assert torch.allclose(gradient(scene, **coefficients), single[0] + single[1], atol=1e-4)


def test_errors():
    """Wrong models, coefficient counts and values are refused by name."""
    scene = blobs(3, 0.02)
    cases: list[tuple[dict[str, Any], str]] = [
        ({"camera_model": "ortho"}, "'ortho'.*pinhole, fisheye"),
        ({"radial_coeffs": torch.zeros(1, 5)}, r"radial_coeffs.*\(1, 2\) or \(1, 3\) or \(1, 6\)"),
        ({"radial_coeffs": torch.zeros(2, 6)}, "radial_coeffs has shape"),
        ({"tangential_coeffs": torch.zeros(1, 3)}, r"tangential_coeffs.*\(1, 2\)"),
        ({"camera_model": "fisheye", "radial_coeffs": torch.zeros(1, 6)}, r"\(1, 4\)"),
        ({"camera_model": "fisheye", "tangential_coeffs": torch.zeros(1, 2)}, "has none"),
        ({"camera_model": "fisheye", "max_angle": 2.0}, "max_angle is 2.0"),
        ({"radial_coeffs": torch.tensor([[0.1, math.nan]])}, r"radial_coeffs\[0, 1\] is nan"),
        ({"radial_coeffs": torch.zeros(1, 2).double()}, "radial_coeffs is torch.float64"),
    ]
    for options, message in cases:
        with pytest.raises(ValueError, match=message):
            rasterize(**scene, width=16, height=16, **options)
    scene["means"][1, 2] = math.inf
    with pytest.raises(ValueError, match=r"means\[1, 2\] is inf"):
        rasterize(**scene, width=16, height=16, **lens("fisheye"))


def test_nothing_visible():
    """Empty scenes, and scenes behind the camera, show the background, with zero gradients."""
    for count in (0, 3):
        scene: dict[str, Any] = {n: t.requires_grad_() for n, t in blobs(count, 0.02).items()}
        scene["means"] = (blobs(count, 0.02)["means"] * torch.tensor([1, 1, -1])).requires_grad_()
        background = torch.tensor([[0.1, 0.2, 0.3]], requires_grad=True)
        image, alpha, _ = rasterize(
            **scene, width=9, height=7, backgrounds=background, **lens("opencv")
        )
        assert torch.equal(image, background[:, None, None].expand_as(image)) and alpha.max() == 0
        image.sum().backward()
        gradient = scene["means"].grad
        assert gradient is None or (gradient == 0).all()
