"""A page beside a running Meshcat, in a real browser where there is one."""

import dataclasses

import numpy as np
from pydrake.geometry import Box, Meshcat, Rgba
from pydrake.math import RigidTransform

from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.visualization.drawing import draw_gaussians
from splatpilot.systems.visualization.live_page import live_page

SKY = EnvironmentMap(np.full((4, 8, 3), [0.2, 0.9, 0.9], np.float32))


def test_page_follows_meshcat(open_in_browser):
    """The Gaussians are there, and not what Meshcat draws as points; what is drawn in Meshcat after
    the page has been opened appears, before the Gaussians, and moves; the sky stays."""
    meshcat = Meshcat()
    meshcat.SetCameraPose([-4, 0, 0], [0, 0, 0])
    for path in ("/Grid", "/Axes"):
        meshcat.SetProperty(path, "visible", False)
    red = GaussianScene.from_colors(
        [[0.0, 0.0, 0.0]], [[1.0, 0, 0, 0]], [[0.6] * 3], [0.99], [[0.9, 0.0, 0.0]]
    )
    html = live_page(meshcat, red, SKY)
    green = dataclasses.replace(red, sh=red.sh[:, :, [1, 0, 2]])
    draw_gaussians(meshcat, "/splatpilot/scene", green, np.full(3, -5.0), np.full(3, 5.0))
    page = open_in_browser(html, 320, 240, "window.live && live.settled", "#none")

    def middle() -> list[int]:
        return page.picture()[120, 160].tolist()

    page.tab.wait_for_function(
        "viewer.scene_tree.find(['splatpilot', 'scene', '<object>']).object.isPoints"
    )
    blue, green, bright = middle()
    assert bright > 180 and blue < 20 and green < 20
    assert page.picture()[120, 10].tolist() == [230, 230, 51]
    meshcat.SetObject("/box", Box(0.5, 0.5, 0.5), Rgba(0, 0, 1))
    meshcat.SetTransform("/box", RigidTransform([-1.5, 0, 0]))
    page.tab.wait_for_function(
        "viewer.scene_tree.find(['box']).object.position.x === -1.5"
        " && viewer.scene_tree.find(['box']).object.children.length > 0"
    )
    blue, green, bright = middle()
    assert blue > 60 and bright < 20
    meshcat.SetTransform("/box", RigidTransform([3.0, 0, 0]))
    page.tab.wait_for_function("viewer.scene_tree.find(['box']).object.position.x === 3")
    assert middle()[2] > 180
    assert page.picture()[120, 10].tolist() == [230, 230, 51]
    assert page.errors == []
