import numpy as np
import pytest
import torch

from splatpilot.training.reconstruction.parameters import EPSILON, adam_step


@pytest.mark.parametrize("shape", [(1,), (37, 3), (64,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_steps_are_those_of_torch(shape, dtype):
    """Ten steps with a rate that changes move any number of parameters as torch's own Adam does;
    both the native code of float32 and the formulas of other numbers."""
    generator = torch.Generator().manual_seed(0)
    ours = torch.randn(shape, generator=generator, dtype=dtype)
    theirs = ours.clone().requires_grad_()
    reference = torch.optim.Adam([theirs], lr=0.1, eps=EPSILON)
    mean, square = torch.zeros_like(ours), torch.zeros_like(ours)
    for step in range(1, 11):
        gradients = torch.randn(shape, generator=generator, dtype=dtype) * 10.0 ** (step - 5)
        rate = 0.1 / step
        reference.param_groups[0]["lr"] = rate
        theirs.grad = gradients.clone()
        reference.step()
        adam_step(ours, gradients, mean, square, rate, step)
        tolerance = 2e-6 if dtype == torch.float32 else 1e-13
        np.testing.assert_allclose(ours, theirs.detach(), rtol=tolerance, atol=tolerance)


def test_what_never_had_a_gradient_stays(monkeypatch):
    """Parameters whose gradients were always zero do not move, at any SIMD level."""
    for level in ("", "v2"):
        monkeypatch.setenv("SPLATPILOT_SIMD", level)
        values = torch.arange(20.0)
        gradients = torch.zeros(20)
        gradients[7] = 1e-20
        adam_step(values, gradients, torch.zeros(20), torch.zeros(20), 0.5, 1)
        assert (values == torch.arange(20.0)).tolist() == [k != 7 for k in range(20)]
