import math

import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform, RollPitchYaw
from random_scenes import normal_tensor
from scipy.ndimage import correlate1d

from splatpilot import _native
from splatpilot.training.reconstruction.losses import (
    depth_edge_weights,
    log_depth_loss,
    outline_loss,
    photometric_loss,
    surface_loss,
)


@pytest.fixture(autouse=True)
def one_thread():
    """Torch's threads cost more than they give on images this small."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def image_pair(shape, seed=0):
    """A true image with flat parts and texture, and a noisy render of it."""
    rng = torch.Generator().manual_seed(seed)
    target = torch.rand(shape, generator=rng)
    target[..., : shape[-2] // 3, :] = 0.25
    rendered = (target + 0.1 * normal_tensor(seed, *shape)).clamp(0, 1)
    return rendered, target


def depth_pair(shape, seed=0):
    """A true depth of 0 to 200 m with unknown pixels, and a noisy render of it."""
    rng = torch.Generator().manual_seed(seed)
    depth = 200 * torch.rand(shape, generator=rng) ** 3
    rendered = depth * (1 + 0.1 * normal_tensor(seed, *shape))
    flat = depth.view(-1)
    flat[::7], flat[1::11], flat[2::13] = 0.0, math.nan, math.inf
    return rendered.contiguous(), depth


def value_and_gradient(loss, rendered, *others, **options):
    rendered = rendered.detach().clone().requires_grad_()
    value = loss(rendered, *others, **options)
    value.backward()
    assert rendered.grad is not None
    return value.item(), rendered.grad


def ssim_by_scipy(x: np.ndarray, y: np.ndarray) -> float:
    """Mean SSIM of images (H, W, C) straight from the paper's definition, in float64."""
    k = np.arange(-5, 6)
    window = np.exp(-(k**2) / (2 * 1.5**2))
    window /= window.sum()

    def mean(z):
        along_y = correlate1d(z, window, axis=0, mode="constant")
        return correlate1d(along_y, window, axis=1, mode="constant")

    mx, my = mean(x), mean(y)
    vx, vy, cxy = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    luminance = (2 * mx * my + 1e-4) / (mx**2 + my**2 + 1e-4)
    structure = (2 * cxy + 9e-4) / (vx + vy + 9e-4)
    return float(np.mean(luminance * structure))


SHAPES = [(1, 1, 1), (1, 40, 3), (40, 1, 3), (5, 7, 1), (13, 33, 2), (11, 11, 4), (3, 2, 19, 23, 3)]


@pytest.mark.parametrize("simd", _native.simd_levels())
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_photometric_agrees_with_autograd_in_float64(shape, weight, simd, monkeypatch):
    monkeypatch.setenv("SPLATPILOT_SIMD", simd)
    x, y = image_pair(shape)
    value, gradient = value_and_gradient(photometric_loss, x, y, weight)
    expected, expected_gradient = value_and_gradient(
        photometric_loss, x.double(), y.double(), weight
    )
    assert value == pytest.approx(expected, rel=1e-5)
    error = (gradient - expected_gradient).abs().max()
    assert error <= 1e-5 * expected_gradient.abs().max()


def test_photometric_agrees_with_scipy_for_any_layout_and_number_of_threads():
    x, y = image_pair((24, 31, 3))
    a, b = x.double().numpy(), y.double().numpy()
    assert photometric_loss(x, y, 0.0).item() == pytest.approx(np.abs(a - b).mean(), rel=1e-6)
    expected = 1 - ssim_by_scipy(a, b)
    value, gradient = value_and_gradient(photometric_loss, x, y, 1.0)
    assert value == pytest.approx(expected, rel=1e-5)
    assert photometric_loss(x.double(), y.double(), 1.0).item() == pytest.approx(expected, 1e-12)
    planar = x.permute(2, 0, 1).contiguous()
    torch.set_num_threads(2)
    other, other_gradient = value_and_gradient(
        lambda x, y: 0.5 * photometric_loss(x.permute(1, 2, 0), y, 1.0), planar, y
    )
    assert other == 0.5 * value
    assert torch.equal(0.5 * gradient, other_gradient.permute(1, 2, 0))


@pytest.mark.parametrize("simd", _native.simd_levels())
@pytest.mark.parametrize("shape", [(1,), (15,), (16,), (2, 31, 33)])
@pytest.mark.parametrize("weighted", [False, True])
def test_log_depth_agrees_with_autograd_in_float64(shape, weighted, simd, monkeypatch):
    monkeypatch.setenv("SPLATPILOT_SIMD", simd)
    x, d = depth_pair(shape)
    d.view(-1)[-1] = 3.0
    w = torch.rand(shape, generator=torch.Generator().manual_seed(1)) if weighted else None
    value, gradient = value_and_gradient(log_depth_loss, x, d, w)
    w = None if w is None else w.double()
    expected, expected_gradient = value_and_gradient(log_depth_loss, x.double(), d.double(), w)
    assert value == pytest.approx(expected, rel=1e-5)
    torch.testing.assert_close(gradient.double(), expected_gradient, rtol=1e-5, atol=1e-12)
    unknown = ~((d > 1e-3) & (d < 150))
    assert not gradient[unknown].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_depth_outside_the_range(dtype):
    rendered, depth = torch.tensor([0.0, 2.0], dtype=dtype), torch.tensor([1.0, 2.0], dtype=dtype)
    value, gradient = value_and_gradient(log_depth_loss, rendered, depth)  # 0 counts as epsilon
    assert value == pytest.approx(math.log(1e3) / 2, rel=1e-6)
    assert gradient.tolist() == [0.0, 0.0]
    depth = torch.tensor([math.nan, 0.0, -1.0, math.inf, 150.0, 1e-3], dtype=dtype)
    rendered = torch.tensor([1.0, math.nan, 2.0, math.inf, 3.0, 0.0], dtype=dtype)
    value, gradient = value_and_gradient(log_depth_loss, rendered, depth)
    assert value == 0.0 and not gradient.any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("invalid", [math.nan, math.inf])
def test_invalid_values_of_a_render_are_not_hidden(dtype, invalid):
    rendered, depth = torch.ones(20, dtype=dtype), torch.ones(20, dtype=dtype)
    rendered[3] = invalid
    assert math.isnan(log_depth_loss(rendered, depth).item())
    x, y = (t.to(dtype) for t in image_pair((20, 20, 3)))
    x[3, 4, 1] = invalid
    assert math.isnan(photometric_loss(x, y).item())


def test_depth_edges():
    v, u = torch.meshgrid(torch.arange(30.0), torch.arange(40.0), indexing="ij")
    floor = 1 / (0.002 + 0.01 * v + 0.001 * u)  # 2.9 m to 150 m and beyond
    assert torch.equal(depth_edge_weights(floor, far=1e6), torch.ones(30, 40))
    for factor, edge in ((1.05, False), (1.25, True)):
        step = torch.full((10, 20), 4.0)
        step[:, 10:] *= factor
        assert bool((depth_edge_weights(step, jump=0.1) > 1).any()) == edge
    thin = torch.full((2, 20, 30), math.inf)
    thin[0, :, 12] = 5.0
    thin[1, 10, 12] = math.nan
    weights = depth_edge_weights(thin)
    columns = torch.arange(30)
    expected = torch.where((columns >= 9) & (columns <= 15), 5.0, 1.0).expand(20, 30)
    torch.testing.assert_close(weights[0], expected)
    assert torch.equal(weights[1], torch.ones(20, 30))


IMAGE = torch.full((4, 5, 3), 0.5)


@pytest.mark.parametrize(
    ("loss", "arguments", "message"),
    [
        (photometric_loss, [IMAGE, IMAGE[:3]], r"target must be \(4, 5, 3\) .* got \(3,"),
        (photometric_loss, [IMAGE, IMAGE.double()], "target must be .* torch.float64"),
        (photometric_loss, [IMAGE.int(), IMAGE.int()], "divide images by 255"),
        (photometric_loss, [IMAGE[..., 0], IMAGE[..., 0]], r"rendered must be \(..., H"),
        (photometric_loss, [IMAGE[:0], IMAGE[:0]], "rendered must be .*not empty"),
        (photometric_loss, [IMAGE, IMAGE, 1.5], "ssim_weight must be .* got 1.5"),
        (photometric_loss, [IMAGE, IMAGE.clone().requires_grad_()], "target must be without"),
        (log_depth_loss, [IMAGE, IMAGE[:3]], r"depth must be \(4, 5, 3\) .* got \(3,"),
        (log_depth_loss, [IMAGE, IMAGE, IMAGE[:3]], r"weights must be .* got \(3, 5, 3\)"),
    ],
)
def test_invalid_arguments(loss, arguments, message):
    with pytest.raises(ValueError, match=message):
        loss(*arguments)


HEIGHT, WIDTH, F = 40, 60, 20.0
K = torch.tensor([[F, 0, WIDTH / 2], [0, F, HEIGHT / 2], [0, 0, 1]])
VIEWMAT = torch.eye(4)
VIEWMAT[2, 3] = 0.5  # half a meter behind the origin
UPRIGHT = torch.tensor([1.0, 0.0, 0.0, 0.0])


def loss_of(means, quats, scales, depth, seed=0):
    every, rng = torch.arange(len(means)), np.random.default_rng(seed)
    return surface_loss(means, quats, scales, every, VIEWMAT, K, depth, rng)


def test_gaussians_move_to_their_surface():
    depth = torch.full((HEIGHT, WIDTH), 2.0)
    depth[:, 40:] = torch.inf
    z = torch.tensor([2.06, 1.98, 1.5, 2.02, 2.02])
    column = torch.tensor([10.5, 30.5, 20.5, -0.5, 50.5])
    means = torch.stack([(column - WIDTH / 2) / F * z, 0.0 * z, z - 0.5], dim=1).requires_grad_()
    scene = means, UPRIGHT.expand(5, 4)
    loss = loss_of(*scene, torch.full((5, 3), 1e-9), depth)
    assert loss.item() == pytest.approx((np.log(1.03) - np.log(0.99)) / 2, rel=1e-4)
    loss.backward()
    expected = np.zeros((5, 3))
    expected[:2, 2] = 0.5 / 2.06, -0.5 / 1.98
    np.testing.assert_allclose(means.grad, expected, rtol=1e-4)
    # Points depend only on the generator.
    a, b, c = (loss_of(*scene, torch.full((5, 3), 0.02), depth, seed).item() for seed in (1, 1, 2))
    assert a == b != c
    assert loss_of(*scene, torch.full((5, 3), 0.02), torch.zeros(HEIGHT, WIDTH)).item() == 0


def test_outlines_are_those_of_surfaces():
    depth = torch.tensor([[2.0, torch.inf, 0.0, 200.0]])
    weights = torch.tensor([[1.0, 5.0, 5.0, 1.0]])
    alpha = torch.full((1, 4), 0.5, requires_grad=True)
    loss = outline_loss(alpha, depth, weights)
    assert loss.item() == pytest.approx(0.5 * (1 + 5 + 1) / 3)
    loss.backward()
    assert alpha.grad is not None
    np.testing.assert_allclose(alpha.grad, [[-1 / 3, 5 / 3, 0, 1 / 3]], rtol=1e-5)
    assert outline_loss(alpha, 0 * weights, weights).item() == 0


def test_native_code_and_formulas_agree():
    rng = np.random.default_rng(5)
    n = 2000
    X_WC = RigidTransform(RollPitchYaw(0.1, -0.2, 0.3), [0.1, 0.2, -0.5])
    viewmat = torch.from_numpy(X_WC.inverse().GetAsMatrix4())
    depth = torch.from_numpy(rng.uniform(1.5, 2.5, (HEIGHT, WIDTH)))
    depth[:5], depth[5:10] = 0, torch.inf
    means = torch.from_numpy(rng.uniform([-3, -2, 1], [3, 2, 2.5], (n, 3)))
    quats = torch.from_numpy(rng.normal(size=(n, 4)))
    scales = torch.from_numpy(rng.uniform(0.001, 0.1, (n, 3)))
    seen = torch.from_numpy(rng.permutation(n)[: n // 2])
    draws = torch.from_numpy(rng.normal(size=(n // 2, 3)).astype(np.float32))

    class Draws:  # in place of a generator
        def standard_normal(self, *_):
            return draws.numpy()

    def found(dtype):
        leaves = [x.detach().to(dtype, copy=True).requires_grad_() for x in (means, quats, scales)]
        rest = (viewmat.to(dtype), K.to(dtype), depth.to(dtype), Draws())
        loss = surface_loss(*leaves, seen, *rest)
        (3 * loss).backward()
        return [loss.detach(), *(leaf.grad for leaf in leaves)]

    exact = found(torch.float64)
    assert (exact[1] != 0).any(dim=1).sum() > 20
    for native, reference in zip(found(torch.float32), exact, strict=True):
        np.testing.assert_allclose(native, reference, rtol=1e-4, atol=1e-7)
