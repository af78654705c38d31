import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.training.reconstruction.losses import outline_loss, surface_loss

HEIGHT, WIDTH, F = 40, 60, 20.0
K = torch.tensor([[F, 0, WIDTH / 2], [0, F, HEIGHT / 2], [0, 0, 1]])
# The camera stands half a metre behind the origin.
VIEWMAT = torch.eye(4)
VIEWMAT[2, 3] = 0.5
UPRIGHT = torch.tensor([1.0, 0.0, 0.0, 0.0])


def loss_of(means, quats, scales, depth, seed=0):
    everyone = torch.arange(len(means))
    rng = np.random.default_rng(seed)
    return surface_loss(means, quats, scales, everyone, VIEWMAT, K, depth, rng)


def test_gaussians_are_drawn_to_the_surface_they_belong_to():
    """Of five tiny Gaussians the two within 5 % of the true depth at their pixel count, each by the
    logarithm, and are moved along the camera's axis alone; one before an edge, one beside the
    image and one where nothing is seen are left alone."""
    depth = torch.full((HEIGHT, WIDTH), 2.0)
    depth[:, 40:] = torch.inf
    z = torch.tensor([2.06, 1.98, 1.5, 2.02, 2.02])
    column = torch.tensor([10.5, 30.5, 20.5, -0.5, 50.5])
    means = torch.stack([(column - WIDTH / 2) / F * z, 0.0 * z, z - 0.5], dim=1).requires_grad_()
    loss = loss_of(means, UPRIGHT.expand(5, 4), torch.full((5, 3), 1e-9), depth)
    assert loss.item() == pytest.approx((np.log(1.03) - np.log(0.99)) / 2, rel=1e-4)
    loss.backward()
    expected = np.zeros((5, 3))
    expected[:2, 2] = 0.5 / 2.06, -0.5 / 1.98
    np.testing.assert_allclose(means.grad, expected, rtol=1e-4)


def test_thick_gaussians_flatten_and_those_askew_turn():
    """Before a wall across the view, the gradient of many equal Gaussians wants the deviation along
    the view smaller and the others as they are; and of flat ones, tilted by 0.1 rad about x, the
    tilt smaller. Finite differences of the same points agree."""
    n = 2000
    depth = torch.full((HEIGHT, WIDTH), 2.0)
    means = torch.tensor([0.0, 0.0, 1.5]).expand(n, 3)

    def thick(scales):
        return loss_of(means, UPRIGHT.expand(n, 4), scales.expand(n, 3), depth)

    scales = torch.tensor([0.03, 0.03, 0.02], requires_grad=True)
    thick(scales).backward()
    assert scales.grad is not None
    across = np.sqrt(2 / np.pi) / 2.0  # of |log z - log 2| about its mean, by the deviation of z
    np.testing.assert_allclose(scales.grad, [0.0, 0.0, across], atol=0.02)

    def tilted(angle):
        quats = torch.stack([torch.cos(angle / 2), torch.sin(angle / 2), 0 * angle, 0 * angle])
        return loss_of(
            means, quats.expand(n, 4), torch.tensor([0.1, 0.1, 1e-4]).expand(n, 3), depth
        )

    angle = torch.tensor(0.1, requires_grad=True)
    tilted(angle).backward()
    assert angle.grad is not None
    step = 1e-3
    slope = (tilted(angle.detach() + step) - tilted(angle.detach() - step)) / (2 * step)
    assert angle.grad.item() == pytest.approx(slope.item(), rel=0.02)
    assert slope > 0.02


def test_points_are_drawn_by_the_generator_alone():
    """The same generator gives the same bits, another one another value."""
    depth = torch.full((HEIGHT, WIDTH), 2.0)
    scene = torch.tensor([[0.0, 0.0, 1.51]]), UPRIGHT[None], torch.full((1, 3), 0.02), depth
    assert loss_of(*scene, seed=1).item() == loss_of(*scene, seed=1).item()
    assert loss_of(*scene, seed=1).item() != loss_of(*scene, seed=2).item()


def test_without_true_depth_there_is_no_loss():
    """Where no depth is known the loss is 0, not NaN, and so are its gradients."""
    means = torch.ones((1, 3), requires_grad=True)
    nothing = torch.zeros(HEIGHT, WIDTH)
    loss = loss_of(means, UPRIGHT[None], torch.full((1, 3), 0.02), nothing)
    loss.backward()
    assert means.grad is not None
    assert loss.item() == 0 and not means.grad.any()


def test_outlines_are_those_of_what_is_solid():
    """Half there costs half of its weight on a surface and before the sky, and nothing where depth
    is unknown; the gradient pulls up what is solid and down what is not."""
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
    """The loss of many Gaussians of any size and orientation, some seen and some not, before a
    camera askew and a depth with holes, is that of torch in float64; so are its gradients."""
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
