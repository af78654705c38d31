import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.losses import photometric_loss
from splatpilot.training.reconstruction.optimize import Objective
from splatpilot.training.reconstruction.photometry import Photometry
from splatpilot.training.reconstruction.splat_rendering import Rendering
from splatpilot.training.reconstruction.views import ReconstructionViews

HEIGHT, WIDTH = 24, 32
K = np.array([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]])


def loss_and_gradient(color: np.ndarray, image: np.ndarray, valid: np.ndarray):
    """The loss of a rendered color (H, W, 3) against an image, and its gradient."""
    depth = np.where(valid, np.float32(2), np.float32(0))
    views = ReconstructionViews(
        [CaptureFrame(image, depth, RigidTransform(), K, valid)], Photometry(np.ones(1), 0.0)
    )
    rendered = torch.tensor(color, dtype=torch.float32, requires_grad=True)
    ones = torch.ones(HEIGHT, WIDTH)
    objective = Objective(ReconstructConfig(surface_weight=0, depth_weight=0), views, None)
    loss = objective.loss(
        Rendering(rendered, 2 * ones, ones, {}),
        (ones,) * 5,
        0,
        torch.tensor(1.0),
        0,
        torch.zeros(1, 3),
        outlines=False,
    )
    loss.backward()
    assert rendered.grad is not None
    return loss.item(), rendered.grad.numpy()


@pytest.fixture
def images():
    """A rendered color and an image that differs from it everywhere."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return rng.uniform(size=(HEIGHT, WIDTH, 3)), image


def test_masked_pixels_have_no_part_in_the_loss(images):
    color, image = images
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[5:15, 8:20] = False
    blob = np.where(valid[..., None], image, np.uint8([255, 0, 0]))
    loss, gradient = loss_and_gradient(color, image, valid)
    other_loss, other_gradient = loss_and_gradient(color, blob, valid)
    assert loss == other_loss
    np.testing.assert_array_equal(gradient, other_gradient)
    assert not gradient[~valid].any() and gradient[valid].all()


def test_without_a_mask_the_loss_is_photometric(images):
    color, image = images
    loss, _ = loss_and_gradient(color, image, np.ones((HEIGHT, WIDTH), bool))
    expected = photometric_loss(
        torch.tensor(color, dtype=torch.float32), torch.tensor(image).float() / 255
    )
    assert loss == pytest.approx(expected.item(), rel=1e-6)
