"""The onboard camera's picture, as Meshcat shows it."""

import json
from typing import cast

import cv2
import numpy as np
from pydrake.common import MemoryFile
from pydrake.common.value import Value
from pydrake.geometry import InMemoryMesh, Mesh, Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem
from pydrake.systems.sensors import CameraInfo, ImageRgba8U

from splatpilot.systems.gltf import add_primitive, data_uri
from splatpilot.systems.ports import input_port
from splatpilot.systems.splats.splat_camera import SplatCamera


class CameraVisualizer(LeafSystem):
    """
    Hangs what the camera sees in front of it in Meshcat, as a picture across the view frustum.

    .. pydrake_system::

        name: CameraVisualizer
        input_ports:
        - color_image

    Takes an image every `period` seconds and shows every `stride`-th. The picture is a child of the
    vehicle's Meshcat path, so it moves with the vehicle at X_BC and needs no pose of its own.
    """

    color_image_input_port = input_port("color_image")

    def __init__(
        self,
        meshcat: Meshcat,
        camera_info: CameraInfo,
        X_BC: RigidTransform,
        period: float = 1 / 15,
        stride: int = 3,
        depth: float = 0.6,
        path: str = "/splatpilot/vehicle/camera",
    ):
        """
        Args:
            meshcat: where to draw.
            camera_info, X_BC: intrinsics, and pose of the camera in the vehicle's body frame.
            period: time between two images [s]; as other readers of the camera have it, or it
                renders for each.
            stride: how many images there are to a picture that is shown.
            depth: distance from the camera to the picture [m].
            path: Meshcat path of the camera.
        """
        super().__init__()
        self._meshcat = meshcat
        self._period = period
        self._stride = stride
        self._path = path
        width, height = camera_info.width(), camera_info.height()
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float)
        center = [camera_info.center_x(), camera_info.center_y()]
        focal = [camera_info.focal_x(), camera_info.focal_y()]
        # (4, 3) [m], frame C: top left, top right, bottom right, bottom left.
        self._p_CCorners = depth * np.column_stack([(corners - center) / focal, np.ones(4)])
        self.DeclareAbstractInputPort("color_image", Value(ImageRgba8U(width, height)))
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        meshcat.SetTransform(path, X_BC)
        edges = np.stack([np.zeros((4, 3)), self._p_CCorners], axis=1).reshape(8, 3)
        meshcat.SetLine(f"{path}/frustum", edges.T, 2.0)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder, camera: SplatCamera, meshcat: Meshcat, period: float = 1 / 15
    ) -> "CameraVisualizer":
        """Adds a visualizer, named `camera_visualizer`, of the images of a camera."""
        visualizer = CameraVisualizer(meshcat, camera.camera_info(), camera.X_BC(), period)
        builder.AddNamedSystem("camera_visualizer", visualizer)
        builder.Connect(camera.color_image_output_port(), visualizer.color_image_input_port())
        return visualizer

    def _publish(self, context: Context) -> EventStatus:
        time = context.get_time()
        if round(time / self._period) % self._stride:
            return EventStatus.DidNothing()
        image = cast(ImageRgba8U, self.GetInputPort("color_image").Eval(context))
        rgb = np.asarray(image.data)[..., :3]
        gltf = MemoryFile(picture_gltf(rgb, self._p_CCorners), ".gltf", "onboard picture")
        self._meshcat.SetObject(f"{self._path}/picture", Mesh(InMemoryMesh(mesh_file=gltf)))
        return EventStatus.Succeeded()


def picture_gltf(rgb: np.ndarray, corners: np.ndarray) -> str:
    """
    A glTF 2.0 document of one rectangle textured with a picture, unlit and seen from both sides.

    Args:
        rgb: (H, W, 3) uint8.
        corners: (4, 3) [m], the picture's top left, top right, bottom right and bottom left corner.
    """
    _, jpeg = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": [
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
                "extensions": {"KHR_materials_unlit": {}},
                "doubleSided": True,
            }
        ],
        "extensionsUsed": ["KHR_materials_unlit"],
        "textures": [{"source": 0}],
        "images": [{"uri": data_uri("image/jpeg", jpeg.tobytes())}],
    }
    uv, triangles = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), np.array([[0, 1, 2], [0, 2, 3]])
    primitive = add_primitive(document, corners, uv, triangles)
    document["meshes"] = [{"primitives": [{**primitive, "material": 0}]}]
    return json.dumps(document)
