"""Drawing in Meshcat: world, goal, vehicle, distances, hypotheses and camera images."""

import json
import math
from typing import cast

import cv2
import numpy as np
from pydrake.common import MemoryFile
from pydrake.common.value import Value
from pydrake.geometry import Cylinder, InMemoryMesh, Mesh, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    System,
)
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageRgba8U

from splatpilot.systems.collision.distance_field import DistanceField, FieldState
from splatpilot.systems.collision.field_mesh import add_primitive, data_uri
from splatpilot.systems.splats.lens import Distortion, pixel_slopes
from splatpilot.systems.splats.moving_bodies import Bodies
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.quadrotor_geometry import quadrotor_parts


def draw_gaussians(
    meshcat: Meshcat,
    path: str,
    scene: GaussianScene,
    lower_W: np.ndarray | float = -np.inf,
    upper_W: np.ndarray | float = np.inf,
    max_points: int = 120_000,
) -> None:
    """Draws the centers of the Gaussians in the box from lower_W to upper_W as colored points,
    thinned evenly, of the size of the median Gaussian."""
    inside = np.flatnonzero(np.all((scene.means >= lower_W) & (scene.means <= upper_W), axis=1))
    if len(inside) > max_points:
        inside = inside[np.linspace(0, len(inside) - 1, max_points).astype(int)]
    extent = np.median(scene.scales[inside].max(axis=1)) if len(inside) else 0.05
    colors = scene.base_colors[inside]
    draw_points(meshcat, path, scene.means[inside], colors, 2.0 * float(extent))


def draw_points(
    meshcat: Meshcat, path: str, p_Q: np.ndarray, colors: np.ndarray, size: float
) -> None:
    """Draws points (N, 3) [m] of a size [m]; sRGB colors (N, 3) are 0 to 1."""
    cloud = PointCloud(len(p_Q), Fields(BaseField.kXYZs | BaseField.kRGBs))
    cloud.mutable_xyzs()[:] = p_Q.T
    # Meshcat expects linear colors of points.
    cloud.mutable_rgbs()[:] = (colors.T**2.2 * 255).astype(np.uint8)
    meshcat.SetObject(path, cloud, point_size=size)


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


def draw_box(meshcat: Meshcat, path: str, lower_W: np.ndarray, upper_W: np.ndarray) -> None:
    """Draws the edges of the box from lower_W (3,) to upper_W (3,) [m]."""
    corners = np.array(list(np.ndindex(2, 2, 2)))
    steps = corners - corners[:, None]
    starts, ends = np.nonzero((steps >= 0).all(axis=-1) & (steps.sum(axis=-1) == 1))
    p_WQ = np.where(corners == 0, lower_W, upper_W)
    meshcat.SetLineSegments(path, p_WQ[starts].T, p_WQ[ends].T, 1.0, Rgba(1.0, 1.0, 1.0))


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


def draw_distance_slice(meshcat: Meshcat, path: str, field: DistanceField, height: float) -> None:
    """Draws a slice of a field at z = `height` [m], visible from above: `distance_colors` of half
    the distance, and unknown space gray."""
    # A little inside, where every field has an answer.
    lower, upper = np.asarray(field.lower_W)[:2], np.asarray(field.upper_W)[:2]
    margin, spacing = 1e-3 * (upper - lower), math.sqrt(np.prod(upper - lower) / _SLICE_POINTS)
    nx, ny = np.maximum(2, np.ceil((upper - lower) / max(0.2, spacing)).astype(int))
    first, last = lower + margin, upper - margin
    x, y = (np.linspace(first[k], last[k], count) for k, count in enumerate((nx, ny)))
    p_WQ = np.stack(np.meshgrid(x, y, [height], indexing="ij"), axis=-1).reshape(-1, 3)
    sample = field.query(p_WQ)
    colors = distance_colors(np.nan_to_num(sample.distance) / 2.0)
    colors[sample.state >= FieldState.UNKNOWN] = UNKNOWN_GRAY
    corner = np.arange(nx * ny).reshape(nx, ny)[:-1, :-1].ravel()
    faces = [[corner, corner + ny, corner + 1], [corner + 1, corner + ny, corner + ny + 1]]
    faces = np.concatenate(faces, axis=1).astype(np.int32)
    meshcat.SetTriangleColorMesh(path, p_WQ.T, faces, colors.T)


def vehicle_path(system: System, base: str) -> str:
    """Returns `/splatpilot/VEHICLE` if the system is named `VEHICLE_base`, `/splatpilot` if it is
    `base`."""
    name = system.get_name()
    return "/splatpilot" if name == base else f"/splatpilot/{name.removesuffix(f'_{base}')}"


_SLICE_POINTS = 40_000  # [-] of a slice, at most
_PICTURE_DEPTH = 0.6  # [m] from the camera to the shown image
_DEPTH_POINTS = 10_000  # [-] at most


def draw_frustum(
    meshcat: Meshcat, path: str, camera_info: CameraInfo, X_BC: RigidTransform
) -> np.ndarray:
    """Draws the view frustum of a camera; returns its corners (4, 3) [m], frame C: top left, top
    right, bottom right, bottom left."""
    corners = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], dtype=float)
    corners *= [camera_info.width(), camera_info.height(), 1]  # [px], homogeneous
    p_CCorners = _PICTURE_DEPTH * corners @ np.linalg.inv(camera_info.intrinsic_matrix()).T
    meshcat.SetTransform(path, X_BC)
    edges = np.stack([np.zeros((4, 3)), p_CCorners], axis=1).reshape(8, 3)
    meshcat.SetLine(f"{path}/frustum", edges.T, 2.0)
    return p_CCorners


class CameraVisualizer(LeafSystem):
    """Shows the camera's image in Meshcat, across its view frustum, and its depth as points.

    .. pydrake_system::

        name: CameraVisualizer
        input_ports: [color_image, depth_image_32f]

    Evaluates an image every `period` [s] and shows every `stride`-th; ForcedPublish shows it too.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        camera_info: CameraInfo,
        X_BC: RigidTransform,
        period: float = 1 / 15,
        stride: int = 3,
        *,
        depth: bool = False,
        path: str = "/splatpilot/vehicle/camera",
        distortion: Distortion | None = None,
    ):
        """Declares the ports.

        Args:
            X_BC: pose of the camera in the vehicle's body frame.
            period: [s] between images, equal to that of other users of the camera.
            stride: number of images per shown one.
            depth: declares the port `depth_image_32f`, whose points are drawn.
            path: of the camera in Meshcat, below that of the vehicle.
            distortion: lens of the depth image; a pinhole if None.
        """
        super().__init__()
        self._meshcat, self._period, self._stride = meshcat, period, stride
        self._path, self._depth, self._distortion = path, depth, distortion
        self._K = camera_info.intrinsic_matrix()
        self._p_CCorners = draw_frustum(meshcat, path, camera_info, X_BC)
        width, height = camera_info.width(), camera_info.height()
        self.DeclareAbstractInputPort("color_image", Value(ImageRgba8U(width, height)))
        if depth:
            self.DeclareAbstractInputPort("depth_image_32f", Value(ImageDepth32F(width, height)))
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish_some)
        self.DeclareForcedPublishEvent(self._publish)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        camera: SplatCamera,
        meshcat: Meshcat,
        period: float = 1 / 15,
        *,
        depth: bool = False,
        name: str = "",
        path: str = "",
    ) -> "CameraVisualizer":
        """Adds a visualizer of the images of a camera.

        Args:
            depth: draws its depth as points.
            name: the camera's name and `_visualizer` by default.
            path: `/splatpilot/vehicle/camera` by default, `/splatpilot/NAME/vehicle/camera` if the
                camera is named `NAME_camera`.
        """
        path = path or f"{vehicle_path(camera, 'camera')}/vehicle/camera"
        visualizer = CameraVisualizer(
            meshcat,
            camera.camera_info(),
            camera.X_BC(),
            period,
            depth=depth,
            path=path,
            distortion=camera.distortion,
        )
        builder.AddNamedSystem(name or f"{camera.get_name()}_visualizer", visualizer)
        for k in range(visualizer.num_input_ports()):
            port = visualizer.get_input_port(k)
            builder.Connect(camera.GetOutputPort(port.get_name()), port)
        return visualizer

    def _publish_some(self, context: Context) -> EventStatus:
        if round(context.get_time() / self._period) % self._stride:
            return EventStatus.DidNothing()
        return self._publish(context)

    def _publish(self, context: Context) -> EventStatus:
        image = cast(ImageRgba8U, self.GetInputPort("color_image").Eval(context))
        rgb = np.asarray(image.data)[..., :3]
        gltf = MemoryFile(picture_gltf(rgb, self._p_CCorners), ".gltf", "onboard picture")
        self._meshcat.SetObject(f"{self._path}/picture", Mesh(InMemoryMesh(mesh_file=gltf)))
        send_picture(self._meshcat, self._path, rgb)
        if self._depth:
            image = cast(ImageDepth32F, self.GetInputPort("depth_image_32f").Eval(context))
            depth = np.asarray(image.data)[..., 0]
            step = int(np.ceil(np.sqrt(depth.size / _DEPTH_POINTS)))
            slopes = pixel_slopes(self._distortion, self._K, *depth.shape[::-1])
            z, slopes, colors = (array[::step, ::step] for array in (depth, slopes, rgb / 255))
            valid = np.isfinite(z) & (z > 0)
            p_CQ = z[valid, None] * np.insert(slopes[valid], 2, 1.0, axis=1)
            draw_points(self._meshcat, f"{self._path}/depth", p_CQ, colors[valid], 0.03)
        return EventStatus.Succeeded()


def encode_jpeg(rgb: np.ndarray) -> bytes:
    """Encodes an image (H, W, 3) as a JPEG file."""
    return cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()


def send_picture(meshcat: Meshcat, path: str, rgb: np.ndarray) -> None:
    """Sends an image (H, W, 3) to pages of `live_page`, as a property of a path: the size of the
    JPEG file [bytes], then numbers of six of its bytes, the lowest first."""
    data = encode_jpeg(rgb)
    padded = np.frombuffer(data + bytes(-len(data) % 6), np.uint8).reshape(-1, 6)
    numbers = padded @ (256.0 ** np.arange(6))
    meshcat.SetProperty(path, "jpeg", [float(len(data)), *numbers.tolist()])


def picture_gltf(rgb: np.ndarray, corners: np.ndarray) -> str:
    """Makes a glTF 2.0 document of an image on a rectangle, unlit and visible from both sides.

    Args:
        rgb: (H, W, 3) uint8.
        corners: (4, 3) [m], top left, top right, bottom right and bottom left.
    """
    jpeg = encode_jpeg(rgb)
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
        "images": [{"uri": data_uri("image/jpeg", jpeg)}],
    }
    uv, triangles = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), np.array([[0, 1, 2], [0, 2, 3]])
    primitive = add_primitive(document, corners, uv, triangles)
    document["meshes"] = [{"primitives": [{**primitive, "material": 0}]}]
    return json.dumps(document)


_HIDDEN = np.array([0.0, 0.0, -1000.0])  # [m], of bodies that are absent


class MovingBodiesVisualizer(LeafSystem):
    """Draws bodies that move: obstacles of a world as spheres, others by their Gaussians.

    .. pydrake_system::

        name: MovingBodiesVisualizer
        input_ports: [moving]

    - ``moving``: that of `MovingBodies`; body k is drawn at `PATH/k`.
    """

    def __init__(self, meshcat: Meshcat, path: str = "/splatpilot/moving", period: float = 1 / 15):
        super().__init__()
        self._meshcat, self._path = meshcat, path
        meshcat.Delete(path)  # of another diagram
        self.DeclareAbstractInputPort("moving", Value(object()))
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def _publish(self, context: Context) -> EventStatus:
        bodies = cast(Bodies, self.get_input_port().Eval(context))
        time, first = bodies.time, len(bodies.radii) - len(bodies.tracks)
        for k, (center, radius) in enumerate(zip(bodies.centers(time), bodies.radii, strict=True)):
            path = f"{self._path}/{k}"
            is_new = not self._meshcat.HasPath(path)
            if k >= first:
                track = bodies.tracks[k - first]
                X_WO = track.pose(time)
                if is_new:
                    draw_gaussians(self._meshcat, path, track.gaussians)
            else:
                X_WO = RigidTransform(center if np.isfinite(center).all() else _HIDDEN)
                if is_new:
                    self._meshcat.SetObject(path, Sphere(radius), Rgba(0.9, 0.75, 0.1))
            self._meshcat.SetTransform(path, X_WO, time)
        return EventStatus.Succeeded()
