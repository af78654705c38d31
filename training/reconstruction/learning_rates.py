"""How fast each kind of parameter of Gaussians is learned, from the first step to the last."""

import math

from splatpilot.training.reconstruction.config import ReconstructConfig

# The learning rate of the means falls to this fraction.
_LAST_OF_MEANS = 0.01
# Gaussians that start from depth are where they belong: their means move slower, and what they look
# like is found in a quarter of the steps by rates that are higher at first and fall to a fraction.
_ON_SURFACE = {"means": 0.25, "quats": 6.0, "log_scales": 6.0, "sh_0": 3.0, "sh_rest": 3.0}
_LAST_ON_SURFACE = 0.1


def learning_rates(config: ReconstructConfig, extent: float, part: float) -> dict[str, float]:
    """Returns the learning rate of each parameter of `SplatParameters`.

    Args:
        config: with rates as published for Gaussians that start anywhere.
        extent: [m] of the scene, by which the means' is scaled.
        part: of all steps, 0 to 1, that have been taken.
    """
    rates = {
        "means": config.means_rate * extent * _LAST_OF_MEANS**part,
        "quats": config.quats_rate,
        "log_scales": config.scales_rate,
        "logit_opacities": config.opacities_rate,
        "sh_0": config.colors_rate,
        "sh_rest": config.colors_rate / 20,
    }
    if config.initialization != "depth":
        return rates
    slower = _LAST_ON_SURFACE + (1 - _LAST_ON_SURFACE) * (1 + math.cos(math.pi * part)) / 2
    return {
        name: rate * _ON_SURFACE.get(name, 1.0) * (1.0 if name == "means" else slower)
        for name, rate in rates.items()
    }
