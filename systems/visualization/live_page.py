"""A page that shows what Drake's Meshcat draws while it runs, with the world's Gaussians."""

from pydrake.geometry import Meshcat

from splatpilot.systems.splats.background import Background
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.visualization.splat_page import splat_page


def live_page(
    meshcat: Meshcat,
    gaussians: GaussianScene,
    background: Background,
    heights: tuple[float, float],
    cut: float,
) -> str:
    """
    The HTML of a page that holds the Gaussians and hears the rest from `meshcat`, on this machine.

    Gaussians that Meshcat draws as points at `/splatpilot/scene` are hidden in it, and what Meshcat
    would give out as files, as the onboard camera's picture, is left out.

    Args:
        meshcat: as it is now, which the page shows until it hears more.
        gaussians, background: what cameras see.
        heights: from floor to ceiling [m], between which `cut` may be moved.
        cut: height above which Gaussians are left out at first [m].
    """
    return splat_page(
        meshcat.StaticHtml(),
        gaussians,
        background,
        {"url": meshcat.ws_url(), "lower": heights[0], "upper": heights[1], "cut": cut},
        ("live.js",),
        "showLive(splats, data); window.live = splats;",
    )
