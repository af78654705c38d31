import numpy as np
import pytest
import torch

from splatpilot.training.reconstruction.splat_rendering import Rendering
from splatpilot.training.reconstruction.surface_loss import surface_loss

HEIGHT, WIDTH = 4, 6


def test_gaussians_are_drawn_to_the_surface_they_belong_to():
    """Of five Gaussians the two within 5 % of the true depth at their pixel count, each by the
    logarithm, and are moved along the camera's axis alone; one before an edge, one beside the
    image and one where nothing is seen are left alone."""
    depth = torch.full((HEIGHT, WIDTH), 2.0)
    depth[:, 3:] = torch.inf
    viewmat = torch.eye(4)[None]
    viewmat[0, 2, 3] = 0.5  # [m], the camera stands half a metre behind the origin
    z = [2.06, 1.98, 1.5, 2.02, 2.02]
    means = torch.tensor([[0.1 * i, 0.2, z[i] - 0.5] for i in range(5)], requires_grad=True)
    pixels = torch.tensor([[0.5, 1.5], [2.9, 3.9], [1.5, 1.5], [-0.5, 1.5], [4.5, 1.5]])
    seen = {"means2d": pixels, "gaussian_ids": torch.arange(5)}
    image = torch.zeros(HEIGHT, WIDTH)
    loss = surface_loss(Rendering(image, image, image, seen), means, viewmat, depth)
    assert loss.item() == pytest.approx((np.log(1.03) - np.log(0.99)) / 2, rel=1e-5)
    loss.backward()
    expected = np.zeros((5, 3))
    expected[:2, 2] = 0.5 / 2.06, -0.5 / 1.98
    np.testing.assert_allclose(means.grad, expected, rtol=1e-5)


def test_without_true_depth_there_is_no_loss():
    """Where no depth is known the loss is 0, not NaN."""
    means = torch.ones((1, 3), requires_grad=True)
    seen = {"means2d": torch.ones((1, 2)), "gaussian_ids": torch.zeros(1, dtype=torch.long)}
    image = torch.zeros(HEIGHT, WIDTH)
    loss = surface_loss(Rendering(image, image, image, seen), means, torch.eye(4)[None], image)
    loss.backward()
    assert means.grad is not None
    assert loss.item() == 0 and not means.grad.any()
