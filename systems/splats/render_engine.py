"""Gaussian scenes, and bodies of Gaussians, in any Drake simulation."""

from collections.abc import Iterable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.geometry import (
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    FrameId,
    FramePoseVector,
    GeometryFrame,
    GeometryId,
    GeometryInstance,
    LightParameter,
    MakeRenderEngineVtk,
    PerceptionProperties,
    QueryObject,
    RenderCameraCore,
    RenderEngine,
    RenderEngineVtkParams,
    RenderLabel,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageLabel16I, ImageRgba8U

from splatpilot.systems.common.drake import weak_callback
from splatpilot.systems.common.extras import load_triton
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.background import (
    BLACK,
    Background,
    EnvironmentMap,
    RenderedView,
    pixel_rays,
)
from splatpilot.systems.splats.baked_scene import (
    BakedScene,
    PlacedGaussians,
    bake,
    placed_together,
)
from splatpilot.systems.splats.lens import pixel_slopes
from splatpilot.systems.splats.moving_bodies import MovingObstacles
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import (
    color_pixels,
    empty_scene,
    ranged_depth,
    surface_labels,
)

_SHAPES = "shapes"
_PROPERTY = "splats", "gaussians"
_MAX_DISTANCE = 1e8  # [m] from the world's origin of bodies that are drawn
_ABSENT = RigidTransform(np.array([0.0, 0.0, -10.0 * _MAX_DISTANCE]))

# A sky, and light from the camera, so that no side of a shape is black.
_LIGHTS = [
    LightParameter(type="directional", frame="world", direction=[0.3, 0.2, -1], intensity=0.7),
    LightParameter(type="point", frame="camera", position=[0, 0, 0], intensity=0.8),
]


def gaussian_properties(
    gaussians: GaussianScene, label: RenderLabel | None = None
) -> PerceptionProperties:
    """Returns properties of a geometry that a `SplatRenderEngine` draws as Gaussians, others by its
    shape.

    Args:
        gaussians: in the geometry's frame.
        label: of pixels that show the body; that of other Gaussians if None.
    """
    properties = PerceptionProperties()
    properties.AddProperty(*_PROPERTY, gaussians)
    if label is not None:
        properties.AddProperty("label", "id", label)
    return properties


class ObstacleGeometry(LeafSystem):
    """Outputs the poses of a world's moving obstacles for a SceneGraph.

    .. pydrake_system::

        name: ObstacleGeometry
        output_ports: [geometry_pose]
    """

    def __init__(self, obstacles: MovingObstacles, frames: list[FrameId]) -> None:
        super().__init__()
        self._obstacles, self._frames = obstacles, frames
        self.DeclareAbstractOutputPort(
            "geometry_pose",
            lambda: Value(FramePoseVector()),
            weak_callback(self._calc),
            {self.time_ticket()},
        )

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        scene_graph: SceneGraph,
        obstacles: MovingObstacles,
        name: str = "obstacles",
    ) -> "ObstacleGeometry":
        """Registers the obstacles for a `SplatRenderEngine`, and adds the system of their poses."""
        source, frames = scene_graph.RegisterSource(name), []
        bodies = zip(obstacles.spheres.radii, obstacles.bodies, strict=True)
        for index, (radius, gaussians) in enumerate(bodies):
            obstacle = f"obstacle_{index}"
            frames.append(scene_graph.RegisterFrame(source, GeometryFrame(obstacle)))
            geometry = GeometryInstance(RigidTransform(), Sphere(radius), obstacle)
            geometry.set_perception_properties(gaussian_properties(gaussians))
            scene_graph.RegisterGeometry(source, frames[-1], geometry)
        system = ObstacleGeometry(obstacles, frames)
        builder.AddNamedSystem(name, system)
        builder.Connect(system.get_output_port(), scene_graph.get_source_pose_port(source))
        return system

    def _calc(self, context: Context, output) -> None:
        poses = output.get_mutable_value()
        centers = self._obstacles.spheres.centers(context.get_time())
        for frame, center in zip(self._frames, centers, strict=True):
            present = np.isfinite(center).all()  # SceneGraph refuses infinite poses
            poses.set_value(frame, RigidTransform(center) if present else _ABSENT)


class SplatRenderEngine(RenderEngine):
    """Renders a Gaussian scene together with the shapes of a SceneGraph, the nearer in each pixel.

    Add it with `scene_graph.AddRenderer("splats", SplatRenderEngine(scene))` and name "splats" in
    the cameras of `RgbdSensor`. The frame of the Gaussians is SceneGraph's world frame.

    Geometries with `gaussian_properties` are drawn as Gaussians at their poses, and not at all
    beyond 1e8 m. A second engine renders the shapes. With a pixel's shape, of color c and depth d
    (background and infinite without one), and color C, alpha A and median depth D of Gaussians:

    - color is c if d <= D, else C + (1 - A) c;
    - depth is min(d, D), planar z in meters, 0 nearer than the camera's depth range and infinity
      beyond it; d if the Gaussians have no surface;
    - labels are those of the shapes if d <= D or there is no D, else of the body of
      Gaussians, else `RenderLabel.kUnspecified`.

    A shape between two translucent layers of Gaussians is drawn before or behind both. Shapes and
    Gaussians cast no shadows on each other. The last view is cached, so that all images of one
    camera cost one rendering. Copies share the scene.
    """

    def __init__(
        self,
        scene: BakedScene | GaussianScene,
        shapes: RenderEngine | None = None,
        background: Background = BLACK,
    ):
        """Creates the engine of the shapes, and a SceneGraph for it.

        Args:
            shapes: engine of the shapes and the background, copied; RenderEngineVtk if None, which
                needs an OpenGL that works without a display (Debian: libegl1 libegl-mesa0
                libgl1-mesa-dri libglib2.0-0 libx11-6 libsm6).
            background: color in [0, 1], of the default `shapes`; or an environment, of any.
        """
        super().__init__()
        environment = background if isinstance(background, EnvironmentMap) else None
        color = np.asarray(BLACK if environment else background)
        valid = color.shape == (3,) and np.all((color >= 0) & (color <= 1))
        require(valid, "background", "three numbers in [0, 1]", background)
        load_triton()
        if shapes is None:
            params = RenderEngineVtkParams(default_clear_color=color, lights=_LIGHTS)
            shapes = MakeRenderEngineVtk(params)
        # A separate SceneGraph: only SceneGraph moves the geometries of an engine.
        self._scene_graph = SceneGraph()
        self._scene_graph.AddRenderer(_SHAPES, shapes)
        self._source = self._scene_graph.RegisterSource(_SHAPES)
        self._scene, self._environment = bake(scene), environment
        self._context: Context | None = None  # stale after registration and removal
        self._last_view: tuple[bytes, RenderedView] | None = None
        self._frames: dict[GeometryId, FrameId] = {}  # of every geometry ever registered
        self._X_WG: dict[FrameId, RigidTransform] = {}
        self._geometries: dict[GeometryId, GeometryId] = {}  # to that in _scene_graph
        # Bodies of Gaussians, with their shapes and properties.
        self._bodies: dict[GeometryId, tuple[Shape, PerceptionProperties]] = {}
        self._body_poses: dict[GeometryId, RigidTransform] = {}
        self._X_WC = RigidTransform()

    def __deepcopy__(self, memo: dict) -> "SplatRenderEngine":
        copy = type(self).__new__(type(self))
        RenderEngine.__init__(copy)
        for name, value in vars(self).items():
            setattr(copy, name, dict(value) if isinstance(value, dict) else value)
        copy._scene_graph = cast(SceneGraph, self._scene_graph.Clone())
        copy._context = copy._last_view = None
        # Drake does not copy the list of geometries with poses to update of a Python engine; only
        # registration makes one. DoRegisterVisual ignores geometries that the copy already has.
        inspector = self._scene_graph.model_inspector()
        for id, ours in self._geometries.items():
            copy.RegisterVisual(
                id,
                inspector.GetShape(ours),
                inspector.GetPerceptionProperties(ours),
                self._X_WG[self._frames[id]],
            )
        for id, (shape, properties) in self._bodies.items():
            copy.RegisterVisual(id, shape, properties, self._body_poses[id])
        return copy

    @property
    def scene(self) -> BakedScene:
        """The Gaussians, shared by all copies of the engine."""
        return self._scene

    def UpdateViewpoint(self, X_WR: RigidTransform) -> None:
        self._X_WC = RigidTransform(X_WR)

    def DoRegisterVisual(
        self, id: GeometryId, shape: Shape, properties: PerceptionProperties, X_WG: RigidTransform
    ) -> bool:
        if id in self._geometries or id in self._bodies:
            return True
        if properties.HasProperty(*_PROPERTY):
            self._bodies[id] = shape, PerceptionProperties(properties)
            self._body_poses[id] = RigidTransform(X_WG)
            self._last_view = None
            return True
        name = str(id.get_value())
        if id not in self._frames:
            self._frames[id] = self._scene_graph.RegisterFrame(self._source, GeometryFrame(name))
        self._X_WG[self._frames[id]] = RigidTransform(X_WG)
        properties = PerceptionProperties(properties)
        # The calling SceneGraph has decided which renderers accept the shape.
        if properties.HasProperty("renderer", "accepting"):
            properties.RemoveProperty("renderer", "accepting")
        instance = GeometryInstance(RigidTransform(), shape, name)
        instance.set_perception_properties(properties)
        self._geometries[id] = self._scene_graph.RegisterGeometry(
            self._source, self._frames[id], instance
        )
        self._context = None
        return True

    def DoUpdateVisualPose(self, id: GeometryId, X_WG: RigidTransform) -> None:
        if id in self._bodies:
            self._body_poses[id] = RigidTransform(X_WG)
        else:
            self._X_WG[self._frames[id]] = RigidTransform(X_WG)

    def DoRemoveGeometry(self, id: GeometryId) -> bool:
        if id in self._bodies:
            del self._bodies[id], self._body_poses[id]
            self._last_view = None
            return True
        if id not in self._geometries:
            return False
        self._scene_graph.RemoveGeometry(self._source, self._geometries.pop(id))
        self._context = None
        return True

    def DoRenderColorImage(self, camera: ColorRenderCamera, color_image_out: ImageRgba8U) -> None:
        view = self._view(camera.core())
        behind = np.asarray(self._shapes().RenderColorImage(*self._same(camera)).data)
        shape_depth = self._shape_depth(camera.core())
        shape_in_front = shape_depth <= view.depth  # (H, W)
        behind = behind[..., :3].astype(np.float32) / 255
        if self._environment is not None:
            sky, (K, width, height, *_) = np.isinf(shape_depth), self._camera(camera.core())[0]
            v_W = pixel_rays(pixel_slopes(None, K, width, height)[sky], self._X_WC)
            behind[sky] = self._environment.color(v_W)
        blended = view.color + (1 - view.alpha[..., None]) * behind
        color = np.where(shape_in_front[..., None], behind, blended)
        out = np.asarray(color_image_out.mutable_data)  # (H, W, 4)
        out[..., :3] = color_pixels(color)
        out[..., 3] = 255

    def DoRenderDepthImage(self, camera: DepthRenderCamera, depth_image_out: ImageDepth32F) -> None:
        depth_range = camera.depth_range()
        shapes = np.asarray(self._shapes().RenderDepthImage(*self._same(camera)).data)[..., 0]
        splats = self._depth(camera.core())
        splats = ranged_depth(splats, depth_range.min_depth(), depth_range.max_depth())
        np.asarray(depth_image_out.mutable_data)[..., 0] = np.minimum(shapes, splats)

    def DoRenderLabelImage(self, camera: ColorRenderCamera, label_image_out: ImageLabel16I) -> None:
        view = self._view(camera.core())
        shapes = np.asarray(self._shapes().RenderLabelImage(*self._same(camera)).data)[..., 0]
        arguments, bodies = self._camera(camera.core())[0], []
        for id, (_, properties) in self._bodies.items():
            if properties.HasProperty("label", "id"):
                label = int(cast(RenderLabel, properties.GetProperty("label", "id")))
                alone = empty_scene().render_depth(*arguments, moving=self._placed([id]))
                bodies.append((label, alone))
        splats = surface_labels(view.depth, bodies)
        empty = int(RenderLabel.kEmpty)
        shape_seen = (self._shape_depth(camera.core()) <= view.depth) | (splats == empty)
        labels = np.where(shape_seen & (shapes != empty), shapes, splats)
        np.asarray(label_image_out.mutable_data)[..., 0] = labels

    def _view(self, core: RenderCameraCore) -> RenderedView:
        camera, key = self._camera(core)
        if self._last_view is None or self._last_view[0] != key:
            self._last_view = key, self._scene.render(*camera, moving=self._placed(self._bodies))
        return self._last_view[1]

    def _depth(self, core: RenderCameraCore) -> NDArray[np.float32]:
        """Returns the depth (H, W) [m] of the cached view, else renders it alone."""
        camera, key = self._camera(core)
        if self._last_view is not None and self._last_view[0] == key:
            return self._last_view[1].depth
        return self._scene.render_depth(*camera, moving=self._placed(self._bodies))

    def _placed(self, ids: Iterable[GeometryId]) -> PlacedGaussians:
        """Returns the Gaussians of bodies in W that are present."""
        placed = []
        for id in ids:
            X_WG = self._body_poses[id]
            if np.linalg.norm(X_WG.translation()) < _MAX_DISTANCE:
                gaussians = cast(GaussianScene, self._bodies[id][1].GetProperty(*_PROPERTY))
                placed.append(gaussians.transformed_by(X_WG))
        return placed_together(placed)

    def _camera(self, core: RenderCameraCore) -> tuple[tuple[Any, ...], bytes]:
        """Returns K, width, height, X_WC, near and far, and all that a view depends on as bytes."""
        info, clipping = core.intrinsics(), core.clipping()
        K, size = info.intrinsic_matrix(), (info.width(), info.height())
        planes = clipping.near(), clipping.far()
        poses = [X.GetAsMatrix34().ravel() for X in (self._X_WC, *self._body_poses.values())]
        key = np.concatenate([K.ravel(), *poses, size, planes]).tobytes()
        return (K, *size, self._X_WC, *planes), key

    def _shapes(self) -> QueryObject:
        if self._context is None:
            self._context = self._scene_graph.CreateDefaultContext()
        poses = FramePoseVector()
        for frame, X_WG in self._X_WG.items():
            poses.set_value(frame, X_WG)
        self._scene_graph.get_source_pose_port(self._source).FixValue(self._context, poses)
        return cast(QueryObject, self._scene_graph.get_query_output_port().Eval(self._context))

    def _same(self, camera: Any) -> tuple[Any, FrameId, RigidTransform]:
        """Returns a camera of the shapes' renderer, at our pose, as QueryObject takes it."""
        core = camera.core()
        core = RenderCameraCore(_SHAPES, core.intrinsics(), core.clipping(), RigidTransform())
        if isinstance(camera, DepthRenderCamera):
            camera = DepthRenderCamera(core, camera.depth_range())
        else:
            camera = ColorRenderCamera(core, camera.show_window())
        return camera, self._scene_graph.world_frame_id(), self._X_WC

    def _shape_depth(self, core: RenderCameraCore) -> NDArray[np.float32]:
        """Returns the depth (H, W) [m] of the shapes between the clipping planes."""
        clipping = core.clipping()
        camera = DepthRenderCamera(core, DepthRange(clipping.near(), clipping.far()))
        return np.asarray(self._shapes().RenderDepthImage(*self._same(camera)).data)[..., 0]
