import math

import numpy as np
import pytest
import torch

from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.mcmc import McmcStrategy, share_out
from splatpilot.training.reconstruction.parameters import ScaleLimits, SplatParameters

RATES = {
    "means": 1e-3,
    "quats": 1e-3,
    "log_scales": 1e-3,
    "logit_opacities": 1e-2,
    "sh_0": 1e-3,
}


def scene(count: int, opacities: np.ndarray) -> GaussianScene:
    rng = np.random.default_rng(0)
    return GaussianScene.from_colors(
        rng.uniform(-1, 1, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(0.05, 0.1, (count, 3)),
        opacities,
        rng.uniform(size=(count, 3)),
    )


@pytest.mark.parametrize("count", [1, 2, 5, 20])
def test_shared_gaussians_are_as_opaque_and_as_wide(count):
    """Copies in one place let through what the one did at its centre, and stop as much light over
    a line through it (the condition that the published equation is derived from)."""
    opacity, scale = torch.tensor([0.8]), torch.tensor([[0.3, 0.2, 0.1]])
    new_opacity, new_scale = share_out(opacity, scale, torch.tensor([count]))
    assert 1 - (1 - new_opacity.item()) ** count == pytest.approx(0.8, abs=1e-5)
    x = np.linspace(-6, 6, 20001)
    ratio = (new_scale / scale)[0]
    assert ratio.tolist() == pytest.approx([ratio[0].item()] * 3)
    one = 0.8 * np.exp(-(x**2) / 2)
    copies = 1 - (1 - new_opacity.item() * np.exp(-((x / ratio[0].item()) ** 2) / 2)) ** count
    assert copies.sum() == pytest.approx(one.sum(), rel=1e-4)


def test_dead_gaussians_move_to_living_ones():
    """After a change none is dead, those that were stand where living ones do, and the number
    grows by a twentieth up to the limit."""
    opacities = np.where(np.arange(200) % 4 == 0, 0.001, 0.9)
    splats = SplatParameters.of_scene(scene(200, opacities), 0, "cpu")
    living = splats["means"][torch.arange(200) % 4 != 0].detach().clone()
    config = ReconstructConfig(
        strategy="mcmc", refine_start=1, refine_every=1, iterations=10, noise=0.0,
        max_gaussians=215,
    )  # fmt: skip
    strategy = McmcStrategy(config)
    strategy.refine(1, splats, RATES)
    assert len(splats) == 210
    assert splats.opacities.min() > 0.005
    same = (splats["means"].detach()[:, None] == living).all(dim=2)  # (210, 150)
    assert same.any(dim=1).all()
    strategy.refine(2, splats, RATES)
    assert len(splats) == 215


def test_what_is_added_to_scales_is_added_once():
    """Gaussians whose smallest scale is far above their own share out their own alone."""
    splats = SplatParameters.of_scene(scene(50, np.full(50, 0.9)), 0, "cpu")
    largest = splats["log_scales"].max().item()
    splats.limit_scales(ScaleLimits(torch.full((50,), 5.0), torch.full((50,), torch.inf)))
    config = ReconstructConfig(
        strategy="mcmc", refine_start=1, refine_every=1, iterations=10, noise=0.0
    )
    McmcStrategy(config).refine(1, splats, RATES)
    assert len(splats) == 52
    assert splats["log_scales"].max().item() <= largest


def test_noise_moves_faint_gaussians_along_their_own_axes():
    """The random walk has the covariance of the Gaussian, squared, and leaves opaque ones alone."""
    count = 4000
    opacities = np.where(np.arange(count) % 2, 0.0051, 0.9)
    flat = scene(count, opacities)
    flat = GaussianScene(
        flat.means,
        np.tile([math.cos(0.3), 0, 0, math.sin(0.3)], (count, 1)),
        np.tile([0.2, 0.1, 0.01], (count, 1)),
        flat.opacities,
        flat.sh,
    )
    splats = SplatParameters.of_scene(flat, 0, "cpu")
    before = splats["means"].detach().clone()
    config = ReconstructConfig(strategy="mcmc", refine_start=100, iterations=10, noise=1e3)
    McmcStrategy(config).refine(1, splats, RATES)
    step = (splats["means"] - before).detach().numpy()
    faint = np.arange(count) % 2 == 1
    assert np.abs(step[~faint]).max() < 1e-6
    c, s = math.cos(0.6), math.sin(0.6)
    own = step[faint] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    # 1e3 * 1e-3 * about a half * variances
    np.testing.assert_allclose(own.std(axis=0), 0.4975 * np.array([0.04, 0.01, 1e-4]), rtol=0.1)
