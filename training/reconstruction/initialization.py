"""From which of a capture's data a reconstruction starts, and how finely."""

from collections.abc import Sequence
from dataclasses import replace

from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.training.captures.capture import Capture
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.initial_gaussians import (
    Detail,
    gaussians_from_depth,
    gaussians_from_points,
    random_points,
)
from splatpilot.training.reconstruction.optimize import extent_of_cameras
from splatpilot.training.reconstruction.photometry import Photometry
from splatpilot.training.reconstruction.views import ReconstructionViews

# Opacity with which Gaussians on surfaces start into the optimisation.
_FIRST_OPACITY = 0.7
# Depth of random Gaussians, in extents of the cameras.
_RANDOM_DEPTH = (0.1, 10.0)


def _starts(capture: Capture) -> dict[str, bool]:
    """Returns the initializations and whether the capture has them, the best first."""
    return {"depth": capture.has_depth, "points": capture.points is not None, "random": True}


def resolved(config: ReconstructConfig, capture: Capture) -> ReconstructConfig:
    """Returns the config with what "auto" means for this capture."""
    kind, strategy = config.initialization, config.strategy
    if kind == "auto":
        kind = next(name for name, there in _starts(capture).items() if there)
    if strategy == "auto":
        strategy = "none" if kind == "depth" else "default"
    return replace(config, initialization=kind, strategy=strategy)


def first_gaussians(
    capture: Capture,
    frames: Sequence,
    photometry: Photometry,
    views: ReconstructionViews,
    config: ReconstructConfig,
) -> GaussianScene:
    """Returns the Gaussians to start from.

    Raises:
        ValueError: if the capture lacks what is asked for.
    """
    kind, has = config.initialization, _starts(capture)
    if not has[kind]:
        raise ValueError(
            f"initialization is {kind!r}, but {capture.name} has none; choose "
            + " or ".join(repr(name) for name, there in has.items() if there)
        )
    if kind == "depth":
        return gaussians_from_depth(frames, photometry, detail_of(config))[0]
    if capture.points is not None and kind == "points":
        points = capture.points
        return gaussians_from_points(points.p_WQ, points.colors)
    _, extent = extent_of_cameras(views)
    near, far = (extent * depth for depth in _RANDOM_DEPTH)
    count = config.initial_gaussians
    return gaussians_from_points(*random_points(frames, count, near, far, config.seed))


def detail_of(config: ReconstructConfig) -> Detail:
    """Returns how finely Gaussians from depth cover surfaces."""
    optimized = config.iterations > 0
    return Detail(
        max_gaussians=config.initial_gaussians if optimized else config.max_gaussians,
        contrast=config.contrast,
        max_cell=config.max_cell,
        max_extent=config.max_extent,
        opacity=_FIRST_OPACITY if optimized else config.opacity,
        optimized=optimized,
    )
