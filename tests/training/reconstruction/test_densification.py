import numpy as np
import pytest
import torch

from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.optimize import DefaultStrategy
from splatpilot.training.reconstruction.parameters import SplatParameters
from splatpilot.training.reconstruction.splat_rendering import render

K = torch.tensor([[[40.0, 0, 32], [0, 40, 24], [0, 0, 1]]])
VIEWMAT = torch.eye(4)[None]


def three_gaussians(scales=(0.005, 0.5, 0.005), opacities=(0.9, 0.9, 0.9)) -> SplatParameters:
    means = [[-0.3, 0, 2.0], [0.3, 0, 2.0], [0.0, 0.3, 2.0]]
    scene = GaussianScene.from_colors(
        means,
        np.tile([1.0, 0, 0, 0], (3, 1)),
        np.repeat(scales, 3).reshape(3, 3),
        opacities,
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    )
    return SplatParameters.of_scene(scene, 0, "cpu")


def strategy_for(splats: SplatParameters, **changes) -> DefaultStrategy:
    config = ReconstructConfig(
        **{"strategy": "default", "iterations": 100, "refine_start": 1, "refine_every": 1}
        | {"reset_every": 0, "refine_fraction": 1.0}
        | changes
    )
    return DefaultStrategy(config, torch.zeros(3), 1.0, len(splats))


def test_large_gradients_double_small_gaussians_and_split_large_ones():
    """Where gradients are large, a small Gaussian gets a twin and a large one becomes two smaller
    ones within it; the others stay as they are."""
    splats = three_gaussians()
    strategy = strategy_for(splats)
    strategy.gradients, strategy.counts = torch.tensor([1.0, 1.0, 0.0]), torch.ones(3)
    small, large, other = splats["means"].detach().clone()
    strategy.refine(1, splats)
    assert len(splats) == 5
    means, scales = splats["means"], splats.scales[:, 0]
    assert (means == small).all(dim=1).sum() == 2 and (means == other).all(dim=1).sum() == 1
    parts = torch.nonzero(scales > 0.1)[:, 0]
    np.testing.assert_allclose(scales[parts].detach(), [0.5 / 1.6] * 2, rtol=1e-6)
    distance = (means[parts] - large).norm(dim=1)
    assert (distance > 0).all() and (distance < 3).all()
    assert (splats.sh[parts] == splats.sh[parts[0]]).all()


def test_only_the_strongest_grow_up_to_the_limit():
    """No more Gaussians than allowed are made."""
    splats = three_gaussians(scales=(0.005, 0.005, 0.005))
    strategy = strategy_for(splats, max_gaussians=4)
    strategy.gradients, strategy.counts = torch.tensor([1.0, 3.0, 2.0]), torch.ones(3)
    strongest = splats["means"][1].detach().clone()
    strategy.refine(1, splats)
    assert len(splats) == 4
    assert (splats["means"] == strongest).all(dim=1).sum() == 2


def test_faint_and_huge_gaussians_are_removed_and_opacities_reset():
    """Faint Gaussians go at once, huge ones after the first reset, which dims all the others."""
    splats = three_gaussians(scales=(0.005, 0.5, 0.005), opacities=(0.9, 0.9, 0.004))
    strategy = strategy_for(splats, reset_every=2)
    strategy.refine(1, splats)
    assert len(splats) == 2
    strategy.refine(2, splats)
    np.testing.assert_allclose(splats.opacities.detach(), [0.01, 0.01], rtol=1e-4)
    strategy.refine(3, splats)
    assert splats.scales.max() < 0.01


@pytest.mark.parametrize("representation", ["3dgs", "2dgs"])
def test_gradients_are_those_of_places_on_the_image(representation):
    """What is gathered is the change of the loss with a shift of the Gaussian by half an image,
    as differences of renderings have it, but for what the shift does to its shape."""
    splats = three_gaussians(scales=(0.1, 0.1, 0.1))
    strategy = strategy_for(splats, representation=representation)
    torch.manual_seed(0)
    weights = torch.rand((48, 64, 3))

    def loss(means):
        gaussians = (means, splats["quats"], splats.scales, splats.opacities, splats.sh)
        rendering = render(representation, gaussians, VIEWMAT, K, 64, 48)
        return rendering, (rendering.color * weights).sum()

    rendering, value = loss(splats["means"])
    strategy.watch(rendering)
    value.backward()
    strategy.observe(rendering, splats, VIEWMAT, K)
    with torch.no_grad():
        for i in range(3):
            slope = []
            for axis, half in ((0, 32), (1, 24)):
                step = torch.zeros_like(splats["means"])
                step[i, axis] = 0.01 * splats["means"][i, 2] / 40  # a hundredth of a pixel
                change = loss(splats["means"] + step)[1] - loss(splats["means"] - step)[1]
                slope.append(change.item() / 0.02 * half)
            assert strategy.gradients[i].item() == pytest.approx(np.hypot(*slope), rel=0.3)
