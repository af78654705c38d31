"""What is drawn in Meshcat."""

import base64
import json

import cv2
import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource
from pydrake.systems.sensors import CameraInfo, ImageRgba8U

from splatpilot.systems.collision.analytic_distance_field import AnalyticDistanceField
from splatpilot.systems.collision.shapes import Sphere
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor_dynamics import hover_state
from splatpilot.systems.visualization.camera_visualizer import CameraVisualizer, picture_gltf
from splatpilot.systems.visualization.drawing import (
    draw_distance_slice,
    draw_gaussians,
    draw_goal,
    draw_vehicle,
)
from splatpilot.systems.visualization.flight_visualizer import FlightVisualizer


@pytest.fixture(scope="module")
def shared_meshcat():
    return Meshcat()


@pytest.fixture
def meshcat(shared_meshcat):
    shared_meshcat.Delete("/splatpilot")
    return shared_meshcat


def test_flight_is_drawn_page_by_page(meshcat):
    """At 10 Hz, 0.35 s of flight draws the vehicle, four pieces of trail and four fans of three."""
    waypoints_B = np.cumsum(np.full((3, 10, 3), 0.1), axis=1)
    plan = Hypotheses(0.0, RigidTransform([1, 0, 2]), waypoints_B, np.array([1.0, 2.0, 3.0]))
    builder = DiagramBuilder()
    state = builder.AddSystem(ConstantVectorSource(hover_state([1, 0, 2])))
    hypotheses = builder.AddSystem(ConstantVectorSource(plan.to_vector()))
    visualizer = builder.AddSystem(FlightVisualizer(meshcat, num_hypotheses=3, period=0.1))
    builder.Connect(state.get_output_port(), visualizer.GetInputPort("state"))
    builder.Connect(hypotheses.get_output_port(), visualizer.GetInputPort("hypotheses"))
    draw_vehicle(meshcat, "/splatpilot/vehicle", radius=0.354)
    Simulator(builder.Build()).AdvanceTo(0.35)
    assert meshcat.HasPath("/splatpilot/vehicle/body")
    for page in range(4):
        assert meshcat.HasPath(f"/splatpilot/trail/{page:05d}")
        for k in range(3):
            assert meshcat.HasPath(f"/splatpilot/hypotheses/{page:05d}/{k}")
    assert not meshcat.HasPath("/splatpilot/trail/00004")
    assert not meshcat.HasPath("/splatpilot/hypotheses/00000/3")


def test_still_life_is_drawn(meshcat):
    """Scene, goal and distance slice appear under the paths they were given, and in the page."""
    scene = GaussianScene.from_colors(
        means=[[1, 0, 1], [2, 0, 1], [100, 0, 1]],
        quats=np.tile([1.0, 0, 0, 0], (3, 1)),
        scales=np.full((3, 3), 0.1),
        opacities=np.full(3, 0.9),
        colors=np.full((3, 3), 0.5),
    )
    field = AnalyticDistanceField([Sphere([2, 0, 1], 0.5)], [0, -1, 0], [4, 1, 2])
    draw_gaussians(meshcat, "/splatpilot/scene", scene, field.lower_W, field.upper_W)
    draw_goal(meshcat, "/splatpilot/goal", np.array([3.0, 0, 1]), radius=0.3)
    draw_distance_slice(meshcat, "/splatpilot/slice", field, height=1.0)
    for name in ("scene", "goal", "slice"):
        assert meshcat.HasPath(f"/splatpilot/{name}")


def test_camera_picture_is_hung_at_its_rate(meshcat):
    """Every second of 10 images a second: half a second hangs three pictures into the frustum."""
    info = CameraInfo(width=32, height=24, fov_y=1.0)
    builder = DiagramBuilder()
    image = builder.AddSystem(ConstantValueSource(Value(ImageRgba8U(32, 24))))
    picture = builder.AddSystem(CameraVisualizer(meshcat, info, RigidTransform(), 0.1, stride=2))
    builder.Connect(image.get_output_port(), picture.GetInputPort("color_image"))
    Simulator(builder.Build()).AdvanceTo(0.5)
    assert meshcat.HasPath("/splatpilot/vehicle/camera/frustum")
    pages = [meshcat.HasPath(f"/splatpilot/vehicle/camera/picture/{i:05d}") for i in range(4)]
    assert pages == [True, True, True, False]


def test_picture_document_is_the_picture():
    """The glTF document carries the image itself and the rectangle's corners, turned to y up."""
    rgb = np.zeros((24, 32, 3), np.uint8)
    rgb[:12, :, 0] = 250
    corners = np.array([[-1.0, -2, 3], [1, -2, 3], [1, 2, 3], [-1, 2, 3]])
    document = json.loads(picture_gltf(rgb, corners))
    decoded = cv2.imdecode(_bytes(document["images"][0]["uri"]), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(decoded.astype(int) - rgb).mean() < 3
    binary = _bytes(document["buffers"][0]["uri"])
    assert len(binary) == document["buffers"][0]["byteLength"]
    positions = binary[:48].view("<f4").reshape(4, 3)
    # glTF's (x, y, z) is Drake's (x, -z, y).
    np.testing.assert_allclose(
        np.column_stack([positions[:, 0], -positions[:, 2], positions[:, 1]]), corners
    )


def _bytes(uri: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(uri.split(",")[1]), np.uint8)
