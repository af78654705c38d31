"""The distance field for torch."""

import numpy as np
import pytest
import torch

from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_torch import EsdfTorch


def random_field() -> Esdf:
    random = np.random.default_rng(0)
    return Esdf(
        random.normal(size=(9, 8, 7)).astype(np.float32),
        random.integers(0, 3, (9, 8, 7)).astype(np.uint8),
        np.array([-1.0, 2.0, 0.5]),
        0.1,
    )


@pytest.mark.parametrize("field", [random_field(), random_field().conservative()])
def test_same_answers_as_numpy(field):
    """Distance, gradient and state are numpy's to 1e-6, inside and outside, in any batch shape."""
    random = np.random.default_rng(1)
    p = random.uniform(field.lower_W - 0.3, field.upper_W + 0.3, (4, 50, 3))
    expected = field.query(p)
    tensor = EsdfTorch(field)
    sample = tensor.query(torch.from_numpy(p))
    np.testing.assert_allclose(sample.distance, expected.distance, atol=1e-6)
    np.testing.assert_allclose(sample.gradient, expected.gradient, atol=1e-6)
    np.testing.assert_array_equal(sample.state, expected.state)
    np.testing.assert_allclose(tensor.distance(torch.from_numpy(p)), expected.distance, atol=1e-6)
    single = tensor.query(torch.from_numpy(p[0, 0]).float())
    assert single.distance.dtype == torch.float32 and single.distance.shape == ()
    np.testing.assert_allclose(single.distance, expected.distance[0, 0], atol=1e-4)


@pytest.mark.parametrize("field", [random_field(), random_field().conservative()])
def test_autograd_gives_the_exact_gradient(field):
    """Back-propagation equals the analytic gradient, and finite differences inside the cells."""
    random = np.random.default_rng(2)
    tensor = EsdfTorch(field)
    p = torch.from_numpy(random.uniform(field.lower_W - 0.3, field.upper_W + 0.3, (200, 3)))
    p.requires_grad_()
    tensor.distance(p).nansum().backward()
    assert p.grad is not None
    np.testing.assert_allclose(p.grad, tensor.query(p.detach()).gradient, atol=1e-9)
    cell = random.integers(0, 6, (10, 3)) + random.uniform(0.1, 0.9, (10, 3))
    inside = torch.from_numpy(field.lower_W + 0.1 * (cell + 0.5)).requires_grad_()
    assert torch.autograd.gradcheck(tensor.distance, inside)


def test_gradient_stays_finite_on_the_box():
    """On the faces and at the corners of the box autograd returns numbers."""
    field = random_field().conservative()
    p = torch.tensor(np.stack([field.lower_W, field.upper_W]), requires_grad=True)
    EsdfTorch(field).distance(p).sum().backward()
    assert p.grad is not None and torch.isfinite(p.grad).all()


def test_points_must_have_three_coordinates():
    """Points of another last dimension are refused."""
    with pytest.raises(ValueError, match=r"\(5, 2\)"):
        EsdfTorch(random_field()).distance(torch.zeros(5, 2))
