import copy

import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.parameters import (
    SplatParameters,
    learning_rates,
    scale_limits,
    splat_shapes,
)
from splatpilot.training.reconstruction.photometry import Photometry
from splatpilot.training.reconstruction.views import ReconstructionViews

F = 50.0
PIXEL = 0.2**0.5 / F  # standard deviation at a depth of 1 m
MEANS = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 6.0], [9.0, 0.0, 4.0], [0.0, 0.0, -3.0]])
N = 45  # not a multiple of any register


def shapes_and_gradients(dtype):
    generator = torch.Generator().manual_seed(3)
    log_scales = -6 + 4 * torch.randn(N, 3, generator=generator, dtype=torch.float64)
    logits = 5 * torch.randn(N, generator=generator, dtype=torch.float64)
    smallest = 0.01 * torch.rand(N, generator=generator, dtype=torch.float64)
    smallest[::3] = 0
    log_scales, logits = (x.to(dtype).requires_grad_() for x in (log_scales, logits))
    scales, opacities = splat_shapes(log_scales, logits, smallest.to(dtype))
    weights = torch.linspace(-1, 2, N, dtype=dtype)
    ((scales * weights[:, None]).sum() + (opacities * weights).sum()).backward()
    assert log_scales.grad is not None and logits.grad is not None
    return [x.detach().numpy() for x in (scales, opacities, log_scales.grad, logits.grad)]


def test_native_shapes_agree_with_torch_in_float64():
    pairs = (shapes_and_gradients(dtype) for dtype in (torch.float32, torch.float64))
    for found, expected in zip(*pairs, strict=True):
        np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-7)


def test_extreme_logits_and_scales():
    log_scales = torch.tensor([[-50.0, np.log(0.3), -np.inf]]).expand(2, 3)
    logits, smallest = torch.tensor([-200.0, 200.0]), torch.full((2,), 0.4)
    scales, opacities = splat_shapes(log_scales, logits, smallest)
    np.testing.assert_allclose(scales, [[0.4, 0.5, 0.4]] * 2, rtol=1e-6)
    np.testing.assert_allclose(opacities, [0.0, 1.0], atol=1e-30)


def views(wall: float) -> ReconstructionViews:
    """Two cameras that look along z, at 0 and 1 m, and see a wall at z = `wall`; 0 is unknown."""
    K = np.array([[F, 0, 20.0], [0, F, 15.0], [0, 0, 1]])
    frames = [
        CaptureFrame(
            np.zeros((30, 40, 3), np.uint8),
            np.full((30, 40), wall - z if wall else 0.0, np.float32),
            RigidTransform([0.0, 0.0, z]),
            K,
        )
        for z in (0.0, 1.0)
    ]
    return ReconstructionViews(frames, Photometry(np.ones(2), 0.0))


@pytest.mark.parametrize(
    ("wall", "depths"), [(4.0, [3, 0, 0, 0]), (np.inf, [3, 5, 0, 0]), (0.0, [3, 5, 0, 0])]
)
def test_closest_camera_that_sees_a_gaussian_limits_its_size(wall, depths):
    limits = scale_limits(MEANS, views(wall), bounded=True)
    np.testing.assert_allclose(limits[0], PIXEL * np.array(depths), rtol=1e-5)


def test_largest_scale_is_a_twentieth_of_the_distance():
    _, largest = scale_limits(MEANS, views(np.inf), bounded=True)
    np.testing.assert_allclose(largest, [0.15, 0.25, 0.05 * 90**0.5, 0.15], rtol=1e-6)
    assert scale_limits(MEANS, views(np.inf), bounded=False)[1].isinf().all()


def parameters(count: int, scale: float) -> dict[str, torch.Tensor]:
    return {
        "means": torch.zeros(count, 3),
        "quats": torch.ones(count, 4),
        "log_scales": torch.full((count, 3), scale).log(),
        "logit_opacities": torch.zeros(count),
        "sh_0": torch.zeros(count, 1, 3),
    }


def test_scales_keep_their_limits():
    tensors = parameters(3, 3e-3)
    splats = SplatParameters(tensors)
    assert splats.scales.flatten().tolist() == pytest.approx([3e-3] * 9)
    splats.limit_scales([torch.tensor([0.0, 4e-3, 0.0]), torch.tensor([torch.inf, 1.0, 2e-3])])
    assert splats.scales[:, 0].tolist() == pytest.approx([3e-3, 5e-3, 2e-3])
    assert splats["log_scales"][2].exp().tolist() == pytest.approx([2e-3] * 3)
    again = SplatParameters(**splats.state())
    assert torch.equal(again.scales, splats.scales)
    splats.rebuild(torch.tensor([1]), {name: tensor[:1] for name, tensor in tensors.items()})
    assert splats.scales[:, 0].tolist() == pytest.approx([5e-3, 3e-3])


def test_gaussians_at_their_largest_can_shrink_again():
    splats = SplatParameters(parameters(1, 0.5))
    rates = dict.fromkeys(splats.names, 0.1)
    splats.limit_scales([torch.zeros(1), torch.tensor([0.2])])
    for sign, expected in ((-1, 0.2), (-1, 0.2), (1, 0.19)):
        (sign * splats.scales.sum()).backward()
        splats.step(rates)
        assert splats.scales[0].tolist() == pytest.approx([expected] * 3, rel=0.1)
    for _ in range(20):
        splats.scales.sum().backward()
        splats.step(rates)
    assert splats.scales.max() < 0.15


def test_adam_keeps_its_averages_of_rebuilt_and_restored_gaussians():
    def step(splats: SplatParameters) -> None:
        (splats["means"] * torch.arange(3.0)).sum().backward()
        splats.step(dict.fromkeys(splats.names, 0.1))

    splats, whole = SplatParameters(parameters(3, 0.1)), SplatParameters(parameters(3, 0.1))
    for both in (splats, whole):
        step(both)
    splats.rebuild(torch.tensor([2, 0]), {n: t[:1] for n, t in parameters(1, 0.1).items()})
    restored = SplatParameters(**copy.deepcopy(splats.state()))
    for each in (splats, whole, restored):
        step(each)
    assert torch.equal(restored["means"], splats["means"])
    assert torch.equal(splats["means"][:2], whole["means"][[2, 0]])
    assert not torch.equal(splats["means"][2], whole["means"][2])


@pytest.mark.parametrize("start", ["points", "depth"])
def test_learning_rates(start):
    first, middle, last = (
        learning_rates(ReconstructConfig(initialization=start), 3.0, progress)
        for progress in (0.0, 0.5, 1.0)
    )
    published = {"means": 3.0 * 1.6e-4, "quats": 1e-3, "log_scales": 5e-3}
    published |= {"logit_opacities": 5e-2, "sh_0": 2.5e-3, "sh_rest": 1.25e-4}
    assert first["means"] == pytest.approx(published.pop("means"))
    assert last["means"] == pytest.approx(first["means"] / 100)
    for name, rate in published.items():
        if start == "points":
            assert first[name] == last[name] == rate
        else:  # fast at first and slow at last
            assert first[name] >= rate
            assert middle[name] == pytest.approx(0.55 * first[name])
            assert last[name] == pytest.approx(0.1 * first[name])
