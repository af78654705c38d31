"""Cameras in Gaussian scenes."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import RenderLabel
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, LeafSystem, ValueProducer
from pydrake.systems.sensors import (
    CameraInfo,
    ImageDepth16U,
    ImageDepth32F,
    ImageLabel16I,
    ImageRgba8U,
)

from splatpilot.systems.common.drake import (
    input_port,
    optional_input,
    output_port,
    weak_callback,
)
from splatpilot.systems.common.validation import require, require_type
from splatpilot.systems.sensing.noise import color_of_light, light_of_color
from splatpilot.systems.splats.background import BLACK, Background, RenderedView
from splatpilot.systems.splats.baked_scene import NO_GAUSSIANS, BakedScene, bake
from splatpilot.systems.splats.lens import Distortion, pixel_slopes
from splatpilot.systems.splats.moving_bodies import Bodies
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.state import pose_between


def color_pixels(color: NDArray) -> NDArray[np.uint8]:
    """Converts colors in [0, 1], clipped, to 8 bits."""
    return np.clip(color * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)


def ranged_depth(
    depth: NDArray[np.float32], min_depth: float, max_depth: float
) -> NDArray[np.float32]:
    """Converts planar depth (H, W) [m], 0 without a surface, to that of Drake's cameras: 0 nearer
    than `min_depth`, infinity beyond `max_depth` and without a surface."""
    in_range = (depth > 0) & (depth <= max_depth)
    return np.where(in_range, np.where(depth < min_depth, np.float32(0), depth), np.inf)


_LABEL_TOLERANCE = 0.02  # [m] between the surface in a pixel and that of its body


def surface_labels(
    depth: NDArray[np.float32], bodies: Iterable[tuple[int, NDArray[np.float32]]]
) -> NDArray[np.int16]:
    """Labels pixels (H, W) of depths [m], 0 without a surface, by the labels of bodies and their
    depths alone; other surfaces are `kUnspecified`, and the rest `kEmpty`."""
    unspecified, empty = int(RenderLabel.kUnspecified), int(RenderLabel.kEmpty)
    labels = np.where(depth > 0, unspecified, empty).astype(np.int16)
    for label, alone in bodies:
        labels[(alone > 0) & (np.abs(alone - depth) < _LABEL_TOLERANCE)] = label
    return labels


@cache
def empty_scene() -> BakedScene:
    """Returns a scene without Gaussians."""
    return BakedScene(cast(GaussianScene, NO_GAUSSIANS))


_MAX_STEP = 0.5  # [px] that a point at 1 m may move on the image from one band to the next
_MIN_BANDS = 8  # of an image with a rolling shutter if Gaussians move
_MIN_BLUR = 0.25  # [px] that a point at 1 m must move to blur an image
_MAX_BLUR_STEP = 6.0  # [px] that a point at 1 m may move from one pose of an exposure to the next
_MAX_EXPOSURES = 15  # Number of poses of an image with motion blur.


def image_shift(X_WC0: RigidTransform, X_WC1: RigidTransform, focal: float) -> float:
    """Returns a bound [px] of the shift of points at 1 m between images from two poses."""
    angle = (X_WC0.rotation().inverse() @ X_WC1.rotation()).ToAngleAxis().angle()
    distance = np.linalg.norm(X_WC1.translation() - X_WC0.translation())
    return focal * (abs(angle) + float(distance))


def row_bands(
    X_WC0: RigidTransform, X_WC1: RigidTransform, focal: float, height: int, min_count: int = 1
) -> list[tuple[int, int]]:
    """Divides an image of a rolling shutter, from X_WC0 at the first row to X_WC1 at the last, into
    at least `min_count` bands that render from one pose; returns first rows, and rows behind."""
    steps = image_shift(X_WC0, X_WC1, focal) / _MAX_STEP
    count = min(height, max(min_count, math.ceil(steps)))
    edges = np.linspace(0, height, count + 1).round().astype(int).tolist()
    return list(pairwise(edges))


def blurred_light(
    view: RenderedView,
    camera_info: CameraInfo,
    X_CtCs: Sequence[RigidTransform],
    lens: Distortion | None = None,
) -> NDArray[np.float32]:
    """Computes the mean light (H, W, 3) of an exposure from the view of the camera C in its middle,
    shifted along the motion of each pixel's surface; pixels without depth are far away.

    Args:
        X_CtCs: poses of C in the frames of the camera at the start and the end of the exposure.
    """
    focal = np.array([camera_info.focal_x(), camera_info.focal_y()], dtype=np.float32)
    size = camera_info.width(), camera_info.height()
    slopes = pixel_slopes(lens, camera_info.intrinsic_matrix(), *size).astype(np.float32)
    x, y = np.ascontiguousarray(np.moveaxis(slopes, -1, 0))
    near = np.isfinite(view.depth) & (view.depth > 0.0)
    inverse = np.where(near, 1.0 / np.where(near, view.depth, 1.0), np.float32(0.0))
    ends = []
    for X_CtC in X_CtCs:
        R, t = X_CtC.rotation().matrix().tolist(), X_CtC.translation().tolist()
        # Planes one by one: several times faster than points.
        p_CtQ = [R[k][0] * x + R[k][1] * y + (R[k][2] + t[k] * inverse) for k in range(3)]
        slope = np.stack(p_CtQ[:2], axis=-1) / p_CtQ[2].clip(1e-3)[..., None]
        ends.append(slope if lens is None else lens.project(slope))
    motion = np.nan_to_num(focal * (ends[1] - ends[0])).astype(np.float32)  # (H, W, 2) [px]
    light = light_of_color(255.0 * view.color.clip(0.0))
    count = min(_MAX_EXPOSURES, math.ceil(float(np.abs(motion).max()))) | 1
    u, v = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in size))
    mean = np.zeros_like(light)
    for s in (np.float32((k + 0.5) / count - 0.5) for k in range(count)):
        maps = u - s * motion[..., 0], v - s * motion[..., 1]
        mean += cv2.remap(light, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return mean / np.float32(count)


class CameraState(NamedTuple):
    """A camera at one instant."""

    camera_info: CameraInfo
    X_BC: RigidTransform
    X_WB: RigidTransform  # pose of the body, with a readout at the last row
    time: float = 0.0  # [s] at which the image is taken
    # Pose of the body at the beginning of the exposure of the first row.
    X_WB_start: RigidTransform | None = None
    bodies: Bodies | None = None


class SplatCamera(LeafSystem):
    """Renders color, depth and label images of a Gaussian scene, with the ports of `RgbdSensor`.

    .. pydrake_system::

        name: SplatCamera
        input_ports: [body_pose, moving (optional), start_pose (with a readout or an exposure)]
        output_ports: [color_image, depth_image_32f, depth_image_16u, label_image,
            body_pose_in_world, image_time]

    `body_pose` is the pose X_WB of the body that carries the camera; the camera has the pose X_WC =
    X_WB X_BC with x right, y down and z forward. With a `readout`, a rolling shutter, that is the
    pose at the last row, and `start_pose` X_WB at the first; with an `exposure`, at its end and its
    beginning. Color images are the mean of the light in between; depth is that in the middle.
    `moving` adds the Gaussians of `MovingBodies`. `image_time` [s] is that of the capture.

    Depth is planar z of the surface, the median depth of `rasterize`, in meters
    (`depth_image_32f`) or millimeters (`depth_image_16u`). As in Drake, nearer than `min_depth`
    reads 0; farther than `max_depth` and pixels without a surface read infinity or 65535. Labels
    are those of `surface_labels`, and k for body k of `MovingBodies.DeclareBody`.

    X_BC and the intrinsics are parameters of the Context, see `SetX_BC` and `SetCameraInfo`.
    """

    body_pose_input_port = input_port("body_pose")
    moving_input_port = input_port("moving")
    color_image_output_port = output_port("color_image")
    depth_image_32f_output_port = output_port("depth_image_32f")
    depth_image_16u_output_port = output_port("depth_image_16u")
    # As `RgbdSensor` spells them.
    depth_image_32F_output_port = depth_image_32f_output_port
    depth_image_16U_output_port = depth_image_16u_output_port
    label_image_output_port = output_port("label_image")
    body_pose_in_world_output_port = output_port("body_pose_in_world")
    image_time_output_port = output_port("image_time")

    def __init__(
        self,
        scene: BakedScene | GaussianScene,
        camera_info: CameraInfo,
        X_BC: RigidTransform | None = None,
        *,
        min_depth: float = 0.1,
        max_depth: float = 20.0,
        near: float = 0.01,
        far: float = 1e10,
        background: Background = BLACK,
        latency: float | Callable[[float], float] = 0.0,
        distortion: Distortion | None = None,
        readout: float = 0.0,
        exposure: float = 0.0,
        merged_spread: float = 0.0,
    ):
        """Bakes the scene unless it is baked; see `BakedScene.render` for further arguments.

        Args:
            camera_info, X_BC: defaults of the parameters: the intrinsics, and the pose of the
                camera in the body that carries it, identity if None.
            min_depth, max_depth: range of the depth image [m].
            latency: age of the images [s], or the function from the time [s] to it. The pose at the
                input port must be as old.
            readout: time between reading the first row and the last [s]; 0 reads all at once.
            exposure: time for which each row collects light [s]; images blur by motion.
        """
        super().__init__()
        valid, got = 0 <= min_depth < max_depth < np.inf, f"[{min_depth}, {max_depth}] m"
        require(valid, "the depth range", "0 <= min_depth < max_depth < inf", got)
        for name, duration in (("readout", readout), ("exposure", exposure)):
            require(0.0 <= duration < np.inf, name, "finite and >= 0 s", duration)
        require_type(camera_info, CameraInfo, "camera_info")
        X_BC = RigidTransform() if X_BC is None else X_BC
        require_type(X_BC, RigidTransform, "X_BC")
        self._scene = bake(scene)
        self._camera_info, self._X_BC = camera_info, X_BC
        self._depth_range = (min_depth, max_depth)
        self._clipping = (near, far)
        self._background = background
        self._latency, self._readout, self._exposure = latency, readout, exposure
        if distortion is not None:
            distortion.validate()
        self._options: dict[str, Any] = {
            "distortion": distortion,
            "max_depth": max_depth,
            "merged_spread": merged_spread,
        }

        self._info_index = self.DeclareAbstractParameter(Value(camera_info))
        self._mount_index = self.DeclareAbstractParameter(Value(self._X_BC))
        pose_port = self.DeclareAbstractInputPort("body_pose", Value(RigidTransform()))
        self.DeclareAbstractInputPort("moving", AbstractValue.Make(object()))
        if readout + exposure > 0.0:
            self.DeclareAbstractInputPort("start_pose", Value(RigidTransform()))
        tickets = {self.all_input_ports_ticket(), self.all_parameters_ticket()}
        color_entry, depth_entry = (
            self.DeclareCacheEntry(
                name,
                ValueProducer(
                    Value[object],  # pyright: ignore[reportArgumentType]
                    weak_callback(calc),
                ),
                tickets,
            )
            for name, calc in (("color", self._calc_colors), ("depth", self._calc_depth))
        )
        # The indices: Drake would never free a system that keeps the entries themselves.
        self._color_index, self._depth_index = color_entry.cache_index(), depth_entry.cache_index()
        width, height = camera_info.width(), camera_info.height()
        color, depth = {color_entry.ticket()}, {depth_entry.ticket()}
        for name, image, calc, prerequisites in (
            ("color_image", ImageRgba8U, self._calc_color, color),
            ("depth_image_32f", ImageDepth32F, self._calc_depth_32f, depth),
            ("depth_image_16u", ImageDepth16U, self._calc_depth_16u, depth),
            ("label_image", ImageLabel16I, self._calc_label, depth | tickets),
        ):
            self.DeclareAbstractOutputPort(
                name,
                alloc=lambda image=image: Value(image(width, height)),
                calc=weak_callback(calc),
                prerequisites_of_calc=prerequisites,
            )
        self.DeclareAbstractOutputPort(
            "body_pose_in_world",
            alloc=lambda: Value(RigidTransform()),
            calc=weak_callback(self._calc_body_pose),
            prerequisites_of_calc={pose_port.ticket()},
        )
        self.DeclareVectorOutputPort(
            "image_time", 1, self._calc_image_time, prerequisites_of_calc={self.time_ticket()}
        )

    @property
    def distortion(self) -> Distortion | None:
        """The lens; a pinhole if None."""
        return self._options["distortion"]

    def camera_info(self, context: Context | None = None) -> CameraInfo:
        """Returns the intrinsics of a Context, or the default ones."""
        if context is None:
            return self._camera_info
        return cast(Any, context.get_abstract_parameter(self._info_index)).get_value()

    def X_BC(self, context: Context | None = None) -> RigidTransform:
        """Returns the camera's pose in the body in a Context, or the default one."""
        if context is None:
            return self._X_BC
        return cast(Any, context.get_abstract_parameter(self._mount_index)).get_value()

    def SetX_BC(self, context: Context, X_BC: RigidTransform) -> None:
        """Sets the camera's pose in the body, in this system's Context."""
        self.ValidateContext(context)
        context.get_mutable_abstract_parameter(self._mount_index).set_value(X_BC)

    def SetCameraInfo(self, context: Context, camera_info: CameraInfo) -> None:
        """Sets the intrinsics, in this system's Context; the image keeps its size."""
        self.ValidateContext(context)
        sizes = [f"{info.width()}x{info.height()}" for info in (self._camera_info, camera_info)]
        require(sizes[0] == sizes[1], "the image size", f"{sizes[0]} pixels", sizes[1])
        context.get_mutable_abstract_parameter(self._info_index).set_value(camera_info)

    def render(
        self,
        X_WB: RigidTransform,
        bodies: Bodies | None = None,
        X_WB_start: RigidTransform | None = None,
    ) -> RenderedView:
        """Renders the view from body pose X_WB, with bodies as old as the images.

        Args:
            X_WB_start: pose `readout` plus `exposure` earlier.
        """
        time = bodies.time if bodies else 0.0
        camera = CameraState(
            self._camera_info, self._X_BC, X_WB, time - self._age(time), X_WB_start, bodies
        )
        view = self._render_view(self._shutter(camera, 0.5))
        if self._num_exposures(camera) == 0:
            return view
        return view._replace(color=self._render_color(camera))

    def _render_view(self, camera: CameraState) -> RenderedView:
        return self._render_instant(self._scene.render, camera, background=self._background)

    def _render_color(self, camera: CameraState) -> NDArray[np.float32]:
        count, lights = self._num_exposures(camera), []
        if count == 0:
            return self._render_instant(
                self._scene.render_color, self._shutter(camera, 0.5), background=self._background
            )
        for k in range(count):
            first, middle, last = (self._shutter(camera, (k + s) / count) for s in (0.0, 0.5, 1.0))
            X_WC = middle.X_WB @ camera.X_BC
            X_CtCs = [(end.X_WB @ camera.X_BC).inverse() @ X_WC for end in (first, last)]
            view, lens = self._render_view(middle), self._options["distortion"]
            lights.append(blurred_light(view, camera.camera_info, X_CtCs, lens))
        return color_of_light(np.mean(lights, axis=0)) / np.float32(255.0)

    def _num_exposures(self, camera: CameraState) -> int:
        """Returns the number of poses of an exposure that are rendered; 0 without motion blur."""
        if self._exposure == 0.0 or camera.X_WB_start is None:
            return 0
        X_WC0, X_WC1 = (X_WB @ camera.X_BC for X_WB in (camera.X_WB_start, camera.X_WB))
        share = self._exposure / (self._exposure + self._readout)
        shift = share * image_shift(X_WC0, X_WC1, camera.camera_info.focal_x())
        if shift < _MIN_BLUR:
            return 0
        return min(_MAX_EXPOSURES, math.ceil(shift / _MAX_BLUR_STEP))

    def _shutter(self, camera: CameraState, s: float) -> CameraState:
        """Returns a camera with an exposure at a fraction s of it, from 0 to 1."""
        if self._exposure == 0.0 or camera.X_WB_start is None:
            return camera
        duration = self._exposure + self._readout
        first = s * self._exposure / duration
        X_WBs = [
            pose_between(camera.X_WB_start, camera.X_WB, part)
            for part in (first, first + self._readout / duration)
        ]
        start = X_WBs[0] if self._readout > 0.0 else None
        time = camera.time - (1.0 - s) * self._exposure
        return camera._replace(X_WB=X_WBs[1], X_WB_start=start, time=time)

    def _render_instant(self, render: Callable[..., Any], camera: CameraState, **shown: Any) -> Any:
        """Renders the bands of an image, or of all images of a view, and joins them."""
        info, X_WC1 = camera.camera_info, camera.X_WB @ camera.X_BC
        K, width, height = info.intrinsic_matrix(), info.width(), info.height()

        def render_rows(X_WC: RigidTransform, time: float, rows: tuple[int, int] | None) -> Any:
            bodies = camera.bodies
            moving = NO_GAUSSIANS if bodies is None else bodies.gaussians(max(0.0, time))
            options = self._options | shown | {"moving": moving, "rows": rows}
            return render(K, width, height, X_WC, *self._clipping, **options)

        if camera.X_WB_start is None:
            return render_rows(X_WC1, camera.time, None)
        X_WC0 = camera.X_WB_start @ camera.X_BC
        min_count = 1 if camera.bodies is None else _MIN_BANDS
        bands = []
        for rows in row_bands(X_WC0, X_WC1, float(max(K[0, 0], K[1, 1])), height, min_count):
            s = 0.5 * sum(rows) / height  # of the time from the first row to the last
            time = camera.time - (1.0 - s) * self._readout
            bands.append(render_rows(pose_between(X_WC0, X_WC1, s), time, rows))
        if not isinstance(bands[0], RenderedView):
            return np.concatenate(bands)
        return RenderedView(*map(np.concatenate, zip(*bands, strict=True)))

    def _render_depth(self, scene: BakedScene, camera: CameraState) -> NDArray[np.float32]:
        return self._render_instant(scene.render_depth, self._shutter(camera, 0.5))

    def _age(self, time: float) -> float:
        return self._latency(time) if callable(self._latency) else self._latency

    def _camera_state(self, context: Context) -> CameraState:
        has_start = self._readout + self._exposure > 0.0
        names = ["body_pose", "start_pose"] if has_start else ["body_pose"]
        X_WB, *start = (cast(RigidTransform, self.GetInputPort(n).Eval(context)) for n in names)
        bodies = optional_input(self, "moving", context)
        time = bodies.time - self._age(bodies.time) if bodies else 0.0
        camera = self.camera_info(context), self.X_BC(context)
        return CameraState(*camera, X_WB, time, start[0] if start else None, bodies)

    def _calc_colors(self, context, value) -> None:
        value.set_value(self._render_color(self._camera_state(context)))

    def _calc_depth(self, context, value) -> None:
        value.set_value(self._render_depth(self._scene, self._camera_state(context)))

    def _calc_color(self, context, value) -> None:
        color = cast(Any, self.get_cache_entry(self._color_index).Eval(context))
        pixels = value.get_mutable_value().mutable_data  # (H, W, 4)
        pixels[..., :3] = color_pixels(color)
        pixels[..., 3] = 255

    def _depth(self, context) -> NDArray[np.float32]:
        return cast(Any, self.get_cache_entry(self._depth_index).Eval(context))

    def _calc_depth_32f(self, context, value) -> None:
        depth = ranged_depth(self._depth(context), *self._depth_range)
        value.get_mutable_value().mutable_data[..., 0] = depth

    def _calc_depth_16u(self, context, value) -> None:
        depth = ranged_depth(self._depth(context), *self._depth_range)
        value.get_mutable_value().mutable_data[..., 0] = np.minimum(depth * 1000.0 + 0.5, 65535.0)

    def _calc_label(self, context, value) -> None:
        camera = self._camera_state(context)
        bodies = camera.bodies or Bodies(0.0)
        alone = (replace(bodies, obstacles=None, tracks=(track,)) for track in bodies.tracks)
        depths = (self._render_depth(empty_scene(), camera._replace(bodies=b)) for b in alone)
        labels = surface_labels(self._depth(context), enumerate(depths))
        value.get_mutable_value().mutable_data[..., 0] = labels

    def _calc_body_pose(self, context, value) -> None:
        value.set_value(self.GetInputPort("body_pose").Eval(context))

    def _calc_image_time(self, context: Context, output: BasicVector) -> None:
        time = context.get_time()
        # The oldest pose that is known is that of the start.
        output.SetAtIndex(0, min(time, max(0.0, time - self._age(time))))
