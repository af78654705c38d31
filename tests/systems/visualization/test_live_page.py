"""A page beside a running Meshcat, in a real browser where there is one."""

import dataclasses

import numpy as np
from baked_scenes import uniform_scene
from pydrake.common import MemoryFile
from pydrake.geometry import Box, InMemoryMesh, Mesh, Rgba
from pydrake.math import RigidTransform

from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.visualization.meshcat_drawing import (
    draw_gaussians,
    picture_gltf,
    send_picture,
)
from splatpilot.systems.visualization.pages import ReplayView, live_page

SKY = EnvironmentMap(np.full((4, 8, 3), [0.2, 0.9, 0.9], np.float32))


def test_page_follows_meshcat(open_in_browser, plain_meshcat):
    meshcat = plain_meshcat()
    meshcat.SetCameraPose([-4, 0, 0], [0, 0, 0])
    red = uniform_scene([[0.0, 0.0, 0.0]], [0.6] * 3, color=(0.9, 0.0, 0.0))
    view = ReplayView("forest", RigidTransform(), fov_y=1.0, radius=0.3, lower=-2.0, upper=2.0)
    html = live_page(meshcat, red, SKY, view, cut=1.0)
    # Nearer than the Gaussian, to be seen if they were drawn.
    green = dataclasses.replace(red, sh=red.sh[:, :, [1, 0, 2]], means=red.means - [1.0, 0, 0])
    draw_gaussians(meshcat, "/splatpilot/scene", green, np.full(3, -5.0), np.full(3, 5.0))
    page = open_in_browser(html, 320, 240, "window.live && live.settled", ".panel, .bar")

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
    gltf = MemoryFile(picture_gltf(np.zeros((4, 4, 3), np.uint8), np.eye(4, 3)), ".gltf", "picture")
    meshcat.SetObject("/picture", Mesh(InMemoryMesh(mesh_file=gltf)))
    page.set_slider("live-cut", -0.1)
    assert middle()[2] < 20  # The box behind it.
    meshcat.SetTransform("/splatpilot/vehicle", RigidTransform([0, 3, 0]))
    meshcat.SetTransform("/splatpilot/vehicle/camera", RigidTransform([0.1, 0, 0]))
    picture = np.full((30, 40, 3), 200, np.uint8)
    send_picture(meshcat, "/splatpilot/vehicle/camera", picture)
    page.tab.wait_for_function("document.getElementById('live-picture').naturalWidth === 40")
    page.tab.keyboard.press("3")
    page.settle()
    eye = page.tab.evaluate(
        """() => viewer.scene.worldToLocal(new MeshCat.THREE.Vector3()
          .setFromMatrixPosition(viewer.camera.matrixWorld)).toArray()"""
    )
    np.testing.assert_allclose(eye, [0.1, 3, 0], atol=1e-5)
