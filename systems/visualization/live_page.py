"""A page that shows what Drake's Meshcat draws while it runs, with the world's Gaussians."""

from pydrake.geometry import Meshcat

from splatpilot.systems.splats.background import Background
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.visualization.splat_page import splat_page


def live_page(meshcat: Meshcat, gaussians: GaussianScene, background: Background) -> str:
    """
    The HTML of a page that holds the Gaussians and hears the rest from `meshcat`, on this machine.

    Gaussians that Meshcat draws as points at `/splatpilot/scene` are hidden in it.
    """
    return splat_page(
        meshcat.StaticHtml(),
        gaussians,
        background,
        {"url": meshcat.ws_url()},
        ("live.js",),
        "connectTo(data.url); window.live = splats;",
    )
