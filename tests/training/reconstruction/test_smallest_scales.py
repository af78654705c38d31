import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.photometry import Photometry
from splatpilot.training.reconstruction.smallest_scales import smallest_scales
from splatpilot.training.reconstruction.splat_parameters import SplatParameters
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
        smallest_scales(MEANS, views(wall=4.0)), [3 * PIXEL, 0, 0, 0], rtol=1e-5
    )
    np.testing.assert_allclose(
        smallest_scales(MEANS, views(wall=np.inf)), [3 * PIXEL, 5 * PIXEL, 0, 0], rtol=1e-5
    )


def test_unknown_depth_hides_nothing():
    """Captures without depth, 0 everywhere, say what the closest camera does."""
    unknown = views(wall=4.0)
    unknown.depths[:] = 0
    np.testing.assert_allclose(
        smallest_scales(MEANS, unknown), [3 * PIXEL, 5 * PIXEL, 0, 0], rtol=1e-5
    )


def test_scales_have_the_smallest_added_in_squares():
    """Gaussians of 3 mm that may not be below 4 mm have 5 mm; rows that are kept keep theirs, added
    ones have none; and it comes back from a state."""
    tensors = {
        "means": torch.zeros(2, 3),
        "quats": torch.ones(2, 4),
        "log_scales": torch.full((2, 3), 3e-3).log(),
        "logit_opacities": torch.zeros(2),
        "sh_0": torch.zeros(2, 1, 3),
    }
    rates = dict.fromkeys(tensors, 1e-3)
    splats = SplatParameters(tensors, rates)
    assert splats.scales.flatten().tolist() == pytest.approx([3e-3] * 6)
    splats.smallest = torch.tensor([0.0, 4e-3])
    assert splats.scales[1].tolist() == pytest.approx([5e-3] * 3)
    again = SplatParameters(**splats.state(), rates=rates)
    assert torch.equal(again.scales, splats.scales)
    splats.rebuild(torch.tensor([1]), {name: tensor[:1] for name, tensor in tensors.items()})
    assert splats.scales[:, 0].tolist() == pytest.approx([5e-3, 3e-3])
