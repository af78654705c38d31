import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.parameters import ScaleLimits, SplatParameters, scale_limits
from splatpilot.training.reconstruction.photometry import Photometry
from splatpilot.training.reconstruction.views import ReconstructionViews

F = 50.0
PIXEL = 0.2**0.5 / F  # deviation at a depth of 1 m
MEANS = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 6.0], [9.0, 0.0, 4.0], [0.0, 0.0, -3.0]])


def views(wall: float) -> ReconstructionViews:
    """Two cameras that look along z, at 0 and 1 m, and see a wall at z = `wall`."""
    K = np.array([[F, 0, 20.0], [0, F, 15.0], [0, 0, 1]])
    frames = [
        CaptureFrame(
            np.zeros((30, 40, 3), np.uint8),
            np.full((30, 40), wall - z, np.float32),
            RigidTransform([0.0, 0.0, z]),
            K,
        )
        for z in (0.0, 1.0)
    ]
    return ReconstructionViews(frames, Photometry(np.ones(2), 0.0))


def test_the_closest_camera_that_sees_a_gaussian_says_how_small_it_may_be():
    """It is 0.45 pixels of the closer camera; nothing for what is behind the wall that it shows, to
    the side of both or behind them."""
    np.testing.assert_allclose(
        scale_limits(MEANS, views(wall=4.0), bounded=True).smallest, [3 * PIXEL, 0, 0, 0], rtol=1e-5
    )
    np.testing.assert_allclose(
        scale_limits(MEANS, views(wall=np.inf), bounded=True).smallest,
        [3 * PIXEL, 5 * PIXEL, 0, 0],
        rtol=1e-5,
    )


def test_unknown_depth_hides_nothing():
    """Captures without depth, 0 everywhere, say what the closest camera does."""
    unknown = views(wall=4.0)
    unknown.depths[:] = 0
    np.testing.assert_allclose(
        scale_limits(MEANS, unknown, bounded=True).smallest, [3 * PIXEL, 5 * PIXEL, 0, 0], rtol=1e-5
    )


def test_no_gaussian_may_span_the_view_of_a_camera():
    """None may be larger than a twentieth of the depth from the closest camera that sees it, or of
    the distance from the closest camera if none does; those that are not bounded may."""
    seen = views(wall=np.inf)
    bounded = scale_limits(MEANS, seen, bounded=True)
    np.testing.assert_allclose(bounded.largest, [0.15, 0.25, 0.05 * 90**0.5, 0.15], rtol=1e-6)
    assert scale_limits(MEANS, seen, bounded=False).largest.isinf().all()


def test_scales_keep_their_limits():
    """The smallest is added in squares: 3 mm and 4 mm are 5 mm; what is beyond the largest comes
    back to it, also after a step. Rows that are kept keep their limits, added ones have none, and
    they come back from a state."""
    tensors = {
        "means": torch.zeros(3, 3),
        "quats": torch.ones(3, 4),
        "log_scales": torch.full((3, 3), 3e-3).log(),
        "logit_opacities": torch.zeros(3),
        "sh_0": torch.zeros(3, 1, 3),
    }
    splats = SplatParameters(tensors)
    assert splats.scales.flatten().tolist() == pytest.approx([3e-3] * 9)
    limits = ScaleLimits(torch.tensor([0.0, 4e-3, 0.0]), torch.tensor([torch.inf, 1.0, 2e-3]))
    splats.limit_scales(limits)
    assert splats.scales[:, 0].tolist() == pytest.approx([3e-3, 5e-3, 2e-3])
    assert splats["log_scales"][2].exp().tolist() == pytest.approx([2e-3] * 3)
    again = SplatParameters(**splats.state())
    assert torch.equal(again.scales, splats.scales)
    splats.rebuild(torch.tensor([1]), {name: tensor[:1] for name, tensor in tensors.items()})
    assert splats.scales[:, 0].tolist() == pytest.approx([5e-3, 3e-3])


def test_gaussians_at_their_largest_can_shrink_again():
    """Scales come back to the largest after each step that would take them beyond it, and leave it
    where the gradient of what is rendered says so."""
    tensors = {"means": torch.zeros(1, 3), "log_scales": torch.full((1, 3), 0.5).log()}
    tensors["logit_opacities"] = torch.zeros(1)
    splats, rates = SplatParameters(tensors), dict.fromkeys(tensors, 0.1)
    splats.limit_scales(ScaleLimits(torch.zeros(1), torch.tensor([0.2])))
    for sign, expected in ((-1, 0.2), (-1, 0.2), (1, 0.19)):
        (sign * splats.scales.sum()).backward()
        splats.step(rates)
        assert splats.scales[0].tolist() == pytest.approx([expected] * 3, rel=0.1)
    for _ in range(20):
        splats.scales.sum().backward()
        splats.step(rates)
    assert splats.scales.max() < 0.15
