import numpy as np
import torch

from splatpilot.training.reconstruction.parameters import splat_shapes

N = 45  # not a multiple of any register


def inputs(dtype):
    generator = torch.Generator().manual_seed(3)
    log_scales = -6 + 4 * torch.randn(N, 3, generator=generator, dtype=torch.float64)
    logits = 5 * torch.randn(N, generator=generator, dtype=torch.float64)
    smallest = 0.01 * torch.rand(N, generator=generator, dtype=torch.float64)
    smallest[::3] = 0
    return log_scales.to(dtype), logits.to(dtype), smallest.to(dtype)


def shapes_and_gradients(dtype):
    log_scales, logits, smallest = inputs(dtype)
    log_scales.requires_grad_()
    logits.requires_grad_()
    scales, opacities = splat_shapes(log_scales, logits, smallest)
    weights = torch.linspace(-1, 2, N, dtype=dtype)
    ((scales * weights[:, None]).sum() + (opacities * weights).sum()).backward()
    assert log_scales.grad is not None and logits.grad is not None
    return [x.detach().numpy() for x in (scales, opacities, log_scales.grad, logits.grad)]


def test_native_code_and_formulas_agree():
    """Values and gradients of float32 are those of float64 by torch, to float32's precision."""
    for found, expected in zip(
        shapes_and_gradients(torch.float32), shapes_and_gradients(torch.float64), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-7)


def test_the_smallest_scale_is_added_in_squares():
    """A Gaussian of next to no size has the smallest scale, and a sigmoid of 0 is one half; far
    beyond what floats can hold, opacities end at 0 and 1 and nothing is NaN."""
    log_scales = torch.tensor([[-50.0, np.log(0.3), -np.inf]])
    scales, opacities = splat_shapes(log_scales, torch.tensor([0.0]), torch.tensor([0.4]))
    np.testing.assert_allclose(scales, [[0.4, 0.5, 0.4]], rtol=1e-6)
    assert opacities.item() == 0.5
    _, far = splat_shapes(torch.zeros(2, 3), torch.tensor([-200.0, 200.0]), torch.zeros(2))
    np.testing.assert_allclose(far, [0.0, 1.0], atol=1e-30)
