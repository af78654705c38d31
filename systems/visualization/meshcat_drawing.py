"""Drawing in Meshcat: world, goal, vehicle, distances, hypotheses and camera images."""

import json
from typing import cast

import cv2
import numpy as np
from pydrake.common import MemoryFile
from pydrake.common.value import Value
from pydrake.geometry import Cylinder, InMemoryMesh, Mesh, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem, OutputPort
from pydrake.systems.sensors import CameraInfo, ImageRgba8U

from splatpilot.systems.collision.distance_field import DistanceField, FieldState
from splatpilot.systems.collision.field_mesh import add_primitive, data_uri
from splatpilot.systems.collision.shapes import MovingSpheres
from splatpilot.systems.common.drake import vector_input
from splatpilot.systems.policies.hypotheses import Hypotheses, hypotheses_size, num_hypotheses_in
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.quadrotor_geometry import quadrotor_parts
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state


def draw_gaussians(
    meshcat: Meshcat,
    path: str,
    scene: GaussianScene,
    lower_W: np.ndarray,
    upper_W: np.ndarray,
    max_points: int = 120_000,
) -> None:
    """Draws the centers of the Gaussians in the box from lower_W to upper_W as colored points.

    Points are thinned evenly, and have the size of the median Gaussian to close surfaces.
    """
    inside = np.flatnonzero(np.all((scene.means >= lower_W) & (scene.means <= upper_W), axis=1))
    if len(inside) > max_points:
        inside = inside[np.linspace(0, len(inside) - 1, max_points).astype(int)]
    cloud = PointCloud(len(inside), Fields(BaseField.kXYZs | BaseField.kRGBs))
    cloud.mutable_xyzs()[:] = scene.means[inside].T
    # Meshcat expects linear colors of points.
    cloud.mutable_rgbs()[:] = (scene.base_colors[inside].T ** 2.2 * 255).astype(np.uint8)
    extent = np.median(scene.scales[inside].max(axis=1)) if len(inside) else 0.05
    meshcat.SetObject(path, cloud, point_size=2.0 * float(extent))


GOAL_COLOR, START_COLOR = Rgba(0.1, 0.9, 0.3, 0.4), Rgba(0.1, 0.5, 1.0, 0.4)
MARKER_RADIUS = 0.25  # [m] of start and goal in scenes without a flight


def draw_goal(
    meshcat: Meshcat, path: str, p_WG: np.ndarray, radius: float, color: Rgba = GOAL_COLOR
) -> None:
    """Draws a goal region, a translucent sphere about p_WG (3,) [m], and a pole above it."""
    meshcat.SetObject(path, Sphere(radius), color)
    meshcat.SetObject(f"{path}/pole", Cylinder(0.04, 3.0), color)
    meshcat.SetTransform(f"{path}/pole", RigidTransform(np.array([0.0, 0.0, 1.5])))
    meshcat.SetTransform(path, RigidTransform(p_WG))


def box_edges(lower_W: np.ndarray, upper_W: np.ndarray) -> np.ndarray:
    """Returns the ends (12, 2, 3) [m] of the edges of a box from its corners (3,) [m]."""
    corners = np.array(list(np.ndindex(2, 2, 2)))
    starts, ends = np.nonzero(np.abs(corners[:, None] - corners).sum(axis=-1) == 1)
    once = starts < ends
    p_WQ = np.where(corners == 0, lower_W, upper_W)
    return np.stack([p_WQ[starts[once]], p_WQ[ends[once]]], axis=1)


def draw_box(meshcat: Meshcat, path: str, lower_W: np.ndarray, upper_W: np.ndarray) -> None:
    """Draws the edges of the box from lower_W (3,) to upper_W (3,) [m]."""
    edges = box_edges(lower_W, upper_W)
    meshcat.SetLineSegments(path, edges[:, 0].T, edges[:, 1].T, 1.0, Rgba(1.0, 1.0, 1.0))


def draw_vehicle(meshcat: Meshcat, path: str, radius: float) -> None:
    """Draws a quadrotor whose propeller tips reach `radius` [m]; frame B: x forward, z up."""
    for part in quadrotor_parts(radius):
        meshcat.SetObject(f"{path}/{part.name}", part.shape, part.color)
        meshcat.SetTransform(f"{path}/{part.name}", part.X_BP)


UNKNOWN_GRAY = 0.4  # Shade of unobserved space.


def distance_colors(distances: np.ndarray) -> np.ndarray:
    """Returns colors (N, 3), 0 to 1, of distances (N,): red at 0, yellow at 0.5, blue from 1 on."""
    ramp = np.clip(distances, 0.0, 1.0)
    return np.stack([np.interp(ramp, (0.5, 1), (1, 0)), 1 - np.abs(2 * ramp - 1), ramp**2], -1)


def distance_slice(
    field: DistanceField, height: float, spacing: float, max_distance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Makes a mesh of the slice of a field at z = `height` [m], see `distance_colors`.

    Unknown space is gray.

    Args:
        spacing: [m] between samples.
        max_distance: [m] of the last color.

    Returns:
        Vertices p_WQ (N, 3) [m], faces (M, 3), visible from above, and colors (N, 3), 0 to 1.
    """
    lower_W, upper_W = np.asarray(field.lower_W), np.asarray(field.upper_W)
    counts = np.maximum(2, np.ceil((upper_W[:2] - lower_W[:2]) / spacing).astype(int))
    # A little inside, where every field has an answer.
    margin = 1e-3 * (upper_W[:2] - lower_W[:2])
    xs, ys = (
        np.linspace(lower_W[i] + margin[i], upper_W[i] - margin[i], counts[i]) for i in range(2)
    )
    p_WQ = np.stack(np.meshgrid(xs, ys, [height], indexing="ij"), axis=-1).reshape(-1, 3)
    sample = field.query(p_WQ)
    colors = distance_colors(np.nan_to_num(sample.distance) / max_distance)
    colors[sample.state >= FieldState.UNKNOWN] = UNKNOWN_GRAY

    i, j = np.meshgrid(np.arange(counts[0] - 1), np.arange(counts[1] - 1), indexing="ij")
    corner = (i * counts[1] + j).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + counts[1], corner + 1], axis=-1),
            np.stack([corner + 1, corner + counts[1], corner + counts[1] + 1], axis=-1),
        ]
    )
    return p_WQ, faces.astype(np.int32), colors


def draw_distance_slice(meshcat: Meshcat, path: str, field: DistanceField, height: float) -> None:
    """Draws the `distance_slice` of a field at z = `height` [m], blue from 2 m on."""
    p_WQ, faces, colors = distance_slice(field, height, spacing=0.2, max_distance=2.0)
    meshcat.SetTriangleColorMesh(path, p_WQ.T, faces.T, colors.T)


_TRAIL = 120
"""[-] Number of images that the trail spans."""


class FlightVisualizer(LeafSystem):
    """Draws the vehicle, its trail and the fan of trajectory hypotheses in Meshcat.

    .. pydrake_system::

        name: FlightVisualizer
        input_ports: [state, hypotheses]

    Publishes every `period` [s]. `/splatpilot/vehicle` must have the vehicle's shape, see
    `draw_vehicle`. Hypotheses are green (lowest cost) to red (highest).
    """

    def __init__(
        self,
        meshcat: Meshcat,
        num_hypotheses: int,
        period: float = 1 / 15,
    ):
        """Declares the ports; `num_hypotheses` is 0 for no port `hypotheses`."""
        super().__init__()
        self._meshcat, self._num_hypotheses = meshcat, num_hypotheses
        self.DeclareVectorInputPort("state", 13)
        if num_hypotheses:
            self.DeclareVectorInputPort("hypotheses", hypotheses_size(num_hypotheses))
        # Positions of the last images, the latest last; NaN before.
        self.DeclareDiscreteState(np.full(3 * _TRAIL, np.nan))
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._extend_trail)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        state_port: OutputPort,
        meshcat: Meshcat,
        hypotheses_port: OutputPort | None = None,
    ) -> "FlightVisualizer":
        """Adds a visualizer, named `flight_visualizer`."""
        count = num_hypotheses_in(hypotheses_port.size()) if hypotheses_port is not None else 0
        visualizer = FlightVisualizer(meshcat, count)
        builder.AddNamedSystem("flight_visualizer", visualizer)
        builder.Connect(state_port, visualizer.GetInputPort("state"))
        if hypotheses_port is not None:
            builder.Connect(hypotheses_port, visualizer.GetInputPort("hypotheses"))
        return visualizer

    def _trail(self, context: Context) -> np.ndarray:
        """Returns the positions (n, 3) [m] of the last images and of this one."""
        before = context.get_discrete_state_vector().value().reshape(-1, 3)
        p_WB = QuadrotorState.of(vector_input(self, "state", context)).p_WB
        return np.vstack([before[~np.isnan(before[:, 0])], p_WB])

    def _extend_trail(self, context: Context, discrete_state) -> EventStatus:
        trail = self._trail(context)[-_TRAIL:]
        missing = np.full((_TRAIL - len(trail), 3), np.nan)
        discrete_state.set_value(np.vstack([missing, trail]).ravel())
        return EventStatus.Succeeded()

    def _publish(self, context: Context) -> EventStatus:
        X_WB = pose_from_state(vector_input(self, "state", context))
        self._meshcat.SetTransform("/splatpilot/vehicle", X_WB, context.get_time())
        red = Rgba(0.9, 0.1, 0.1)
        self._meshcat.SetLine("/splatpilot/trail", self._trail(context).T, 4.0, red)
        if self._num_hypotheses:
            vector = vector_input(self, "hypotheses", context)
            plan = Hypotheses.from_vector(vector, self._num_hypotheses)
            if plan is not None:
                self._meshcat.SetTriangleColorMesh("/splatpilot/hypotheses", *fan_mesh(plan))
        return EventStatus.Succeeded()


_RIBBON_WIDTH = 0.02  # [m]


def fan_mesh(plan: Hypotheses) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Makes horizontal ribbons along K hypotheses, from green (lowest cost) to red (highest).

    Returns:
        Vertices (3, V) [m], triangles (3, F) int32 seen from both sides, colors (3, V) in 0 to 1.
    """
    K = len(plan.costs)
    start = np.broadcast_to(plan.X_WB.translation(), (K, 1, 3))
    path = np.concatenate([start, plan.waypoints_W], axis=1)  # (K, T + 1, 3)
    along = np.gradient(path, axis=1)
    across = np.stack([-along[..., 1], along[..., 0], np.zeros(along.shape[:2])], axis=-1)
    across *= 0.5 * _RIBBON_WIDTH / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    sides = np.stack([path - across, path + across], axis=2)
    cost = (plan.costs - plan.costs.min()) / max(np.ptp(plan.costs), 1e-9)
    color = np.column_stack(
        [np.minimum(1, 2 * cost), np.minimum(1, 2 * (1 - cost)), np.full(K, 0.1)]
    )
    T = path.shape[1]
    first = (2 * (np.arange(K)[:, None] * T + np.arange(T - 1))).ravel()
    a, b, c, d = first, first + 1, first + 2, first + 3
    faces = np.concatenate([[a, b, c], [c, b, d], [a, c, b], [c, d, b]], axis=1)
    return sides.reshape(-1, 3).T, faces.astype(np.int32), np.repeat(color, 2 * T, axis=0).T


_CAMERA_PATH = "/splatpilot/vehicle/camera"
_PICTURE_DEPTH = 0.6  # [m] from the camera to the shown image


class CameraVisualizer(LeafSystem):
    """Shows the camera's image in Meshcat, across its view frustum.

    .. pydrake_system::

        name: CameraVisualizer
        input_ports: [color_image]

    Evaluates an image every `period` [s] and shows every `stride`-th, below the vehicle's Meshcat
    path.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        camera_info: CameraInfo,
        X_BC: RigidTransform,
        period: float = 1 / 15,
        stride: int = 3,
    ):
        """Declares the port.

        Args:
            X_BC: pose of the camera in the vehicle's body frame.
            period: [s] between images, equal to that of other users of the camera.
            stride: number of images per shown one.
        """
        super().__init__()
        self._meshcat, self._period, self._stride = meshcat, period, stride
        width, height = camera_info.width(), camera_info.height()
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float)
        center = [camera_info.center_x(), camera_info.center_y()]
        focal = [camera_info.focal_x(), camera_info.focal_y()]
        # (4, 3) [m], frame C: top left, top right, bottom right, bottom left.
        self._p_CCorners = _PICTURE_DEPTH * np.column_stack(
            [(corners - center) / focal, np.ones(4)]
        )
        self.DeclareAbstractInputPort("color_image", Value(ImageRgba8U(width, height)))
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        meshcat.SetTransform(_CAMERA_PATH, X_BC)
        edges = np.stack([np.zeros((4, 3)), self._p_CCorners], axis=1).reshape(8, 3)
        meshcat.SetLine(f"{_CAMERA_PATH}/frustum", edges.T, 2.0)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder, camera: SplatCamera, meshcat: Meshcat, period: float = 1 / 15
    ) -> "CameraVisualizer":
        """Adds a visualizer, named `camera_visualizer`, of the images of a camera."""
        visualizer = CameraVisualizer(meshcat, camera.camera_info(), camera.X_BC(), period)
        builder.AddNamedSystem("camera_visualizer", visualizer)
        builder.Connect(camera.GetOutputPort("color_image"), visualizer.GetInputPort("color_image"))
        return visualizer

    def _publish(self, context: Context) -> EventStatus:
        time = context.get_time()
        if round(time / self._period) % self._stride:
            return EventStatus.DidNothing()
        image = cast(ImageRgba8U, self.GetInputPort("color_image").Eval(context))
        rgb = np.asarray(image.data)[..., :3]
        gltf = MemoryFile(picture_gltf(rgb, self._p_CCorners), ".gltf", "onboard picture")
        self._meshcat.SetObject(f"{_CAMERA_PATH}/picture", Mesh(InMemoryMesh(mesh_file=gltf)))
        return EventStatus.Succeeded()


def picture_gltf(rgb: np.ndarray, corners: np.ndarray) -> str:
    """Makes a glTF 2.0 document of an image on a rectangle, unlit and visible from both sides.

    Args:
        rgb: (H, W, 3) uint8.
        corners: (4, 3) [m], top left, top right, bottom right and bottom left.
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


_HIDDEN = np.array([0.0, 0.0, -1000.0])  # [m], of spheres that are absent


class MovingSpheresVisualizer(LeafSystem):
    """Draws moving spheres at the Context's time, sphere k at
    `/splatpilot/spheres/k`; it has no ports."""

    def __init__(
        self,
        meshcat: Meshcat,
        spheres: MovingSpheres,
        period: float = 1 / 15,
    ):
        super().__init__()
        self._meshcat, self._spheres = meshcat, spheres
        for k, radius in enumerate(spheres.radii):
            meshcat.SetObject(f"/splatpilot/spheres/{k}", Sphere(radius), Rgba(0.9, 0.75, 0.1))
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder, spheres: MovingSpheres, meshcat: Meshcat
    ) -> "MovingSpheresVisualizer":
        """Adds a visualizer, named `spheres_visualizer`."""
        visualizer = MovingSpheresVisualizer(meshcat, spheres)
        builder.AddNamedSystem("spheres_visualizer", visualizer)
        return visualizer

    def _publish(self, context: Context) -> EventStatus:
        time = context.get_time()
        for k, center in enumerate(self._spheres.centers(time)):
            p_WO = center if np.isfinite(center).all() else _HIDDEN
            self._meshcat.SetTransform(f"/splatpilot/spheres/{k}", RigidTransform(p_WO), time)
        return EventStatus.Succeeded()
