"""Gaussian scenes in any Drake simulation."""

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
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
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageDepth32F, ImageLabel16I, ImageRgba8U

from splatpilot.systems.common.extras import load_triton
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.background import (
    BLACK,
    Background,
    EnvironmentMap,
    RenderedView,
    pixel_rays,
)
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.splat_camera import (
    color_pixels,
    ranged_depth,
    surface_labels,
)

_SHAPES = "shapes"

# A sky, and light from the camera, so that no side of a shape is black.
_LIGHTS = [
    LightParameter(type="directional", frame="world", direction=[0.3, 0.2, -1], intensity=0.7),
    LightParameter(type="point", frame="camera", position=[0, 0, 0], intensity=0.8),
]


class SplatRenderEngine(RenderEngine):
    """Renders a Gaussian scene together with the shapes of a SceneGraph, the nearer in each pixel.

    Add it with `scene_graph.AddRenderer("splats", SplatRenderEngine(scene))` and name "splats" in
    the cameras of `RgbdSensor`. The frame of the Gaussians is SceneGraph's world frame.

    A second engine with the same camera renders the shapes. Per pixel, with its color c and depth d
    (infinite without a shape) and the Gaussians' color C, alpha A and median depth D:

    - color is c if d <= D, else C + (1 - A) c, with c that of the background or environment where
      there is no shape;
    - depth is min(d, D), planar z in meters, 0 nearer than the camera's depth range and infinity
      beyond it; d if the Gaussians have no surface;
    - labels are those of the shapes if d <= D or there is no D, else `RenderLabel.kUnspecified`.

    A pixel has one D: a shape between two translucent layers of Gaussians is drawn before or behind
    both. Gaussians cast no shadows on shapes, nor shapes on Gaussians.

    Drake copies engines; copies share the scene. The last view is cached, so that all images of one
    camera cost one rendering.
    """

    def __init__(
        self, scene: BakedScene, shapes: RenderEngine | None = None, background: Background = BLACK
    ):
        """Creates the engine of the shapes, and a SceneGraph for it.

        Args:
            scene: Gaussians, held by reference.
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
        scene_graph = SceneGraph()
        scene_graph.AddRenderer(_SHAPES, shapes)
        self._share(scene, environment, scene_graph)
        self._source = scene_graph.RegisterSource(_SHAPES)
        self._frames: dict[GeometryId, FrameId] = {}  # of every geometry ever registered
        self._X_WG: dict[FrameId, RigidTransform] = {}
        self._geometries: dict[GeometryId, GeometryId] = {}  # to that in _scene_graph
        self._X_WC = RigidTransform()

    def _share(
        self, scene: BakedScene, environment: EnvironmentMap | None, scene_graph: SceneGraph
    ) -> None:
        self._scene, self._environment = scene, environment
        self._scene_graph = scene_graph
        self._context: Context | None = None  # stale after registration and removal
        self._last_view: tuple[bytes, RenderedView] | None = None

    def __deepcopy__(self, memo: dict) -> "SplatRenderEngine":
        copy = type(self).__new__(type(self))
        RenderEngine.__init__(copy)
        scene_graph = cast(SceneGraph, self._scene_graph.Clone())
        copy._share(self._scene, self._environment, scene_graph)
        copy._source = self._source
        copy._frames = dict(self._frames)
        copy._X_WG = dict(self._X_WG)
        copy._geometries = dict(self._geometries)
        copy._X_WC = self._X_WC
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
        if id in self._geometries:
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
        self._X_WG[self._frames[id]] = RigidTransform(X_WG)

    def DoRemoveGeometry(self, id: GeometryId) -> bool:
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
            rows, columns = np.nonzero(np.isinf(shape_depth))
            K = camera.core().intrinsics().intrinsic_matrix()
            v_W = pixel_rays(K, rows, columns, self._X_WC)
            behind[rows, columns] = self._environment.color(v_W)
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
        splats = surface_labels(view)
        empty = int(RenderLabel.kEmpty)
        shape_seen = (self._shape_depth(camera.core()) <= view.depth) | (splats == empty)
        labels = np.where(shape_seen & (shapes != empty), shapes, splats)
        np.asarray(label_image_out.mutable_data)[..., 0] = labels

    def _view(self, core: RenderCameraCore) -> RenderedView:
        camera, key = self._camera(core)
        if self._last_view is None or self._last_view[0] != key:
            self._last_view = key, self._scene.render(*camera)
        return self._last_view[1]

    def _depth(self, core: RenderCameraCore) -> NDArray[np.float32]:
        """Returns the depth (H, W) [m] of the cached view, else renders it alone."""
        camera, key = self._camera(core)
        if self._last_view is not None and self._last_view[0] == key:
            return self._last_view[1].depth
        return self._scene.render_depth(*camera)

    def _camera(self, core: RenderCameraCore) -> tuple[tuple[Any, ...], bytes]:
        """Returns K, width, height, X_WC, near and far, and these as bytes."""
        info, clipping = core.intrinsics(), core.clipping()
        K, size = info.intrinsic_matrix(), (info.width(), info.height())
        planes = clipping.near(), clipping.far()
        numbers = [K.ravel(), self._X_WC.GetAsMatrix34().ravel(), size, planes]
        return (K, *size, self._X_WC, *planes), np.concatenate(numbers).tobytes()

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
