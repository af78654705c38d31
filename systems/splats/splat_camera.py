"""A camera that sees Gaussians."""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
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

from splatpilot.systems.common.drake import input_port, output_port, weakly
from splatpilot.systems.splats.background import BLACK, Background, EnvironmentMap, put_behind
from splatpilot.systems.splats.baked_scene import (
    NO_GAUSSIANS,
    BakedScene,
    MovingGaussians,
    PlacedGaussians,
    RenderedView,
)
from splatpilot.systems.splats.lens import Distortion
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.state import pose_between


def render_view(
    scene: BakedScene,
    K: NDArray[np.float64],
    width: int,
    height: int,
    X_WC: RigidTransform,
    near: float,
    far: float,
    background: Background = BLACK,
    moving: PlacedGaussians = NO_GAUSSIANS,
    distortion: Distortion | None = None,
    max_depth: float = np.inf,
) -> RenderedView:
    """What a camera of intrinsics K [px] at X_WC sees, through a lens; see `BakedScene.render`.

    Drake's renderers and ours both have the centre of pixel (i, j) at (i + 1/2, j + 1/2), so its
    intrinsics are taken as they are.
    """
    camera = (K, width, height, X_WC, near, far)
    if not isinstance(background, EnvironmentMap):
        return scene.render(*camera, background, moving, distortion, max_depth)
    view = scene.render(*camera, BLACK, moving, distortion, max_depth)
    return put_behind(view, background, K, X_WC, distortion)


def color_pixels(color: NDArray) -> NDArray[np.uint8]:
    """Colours in [0, 1], clipped, as the nearest of 0 to 255."""
    return np.clip(color * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)


def ranged_depth(
    depth: NDArray[np.float32], min_depth: float, max_depth: float
) -> NDArray[np.float32]:
    """Planar depth (H, W) [m], 0 where there is no surface, as Drake's cameras show it.

    Nearer than `min_depth` reads 0 and farther than `max_depth` reads infinity; so does a pixel
    without a surface.
    """
    seen = (depth > 0) & (depth <= max_depth)
    return np.where(seen, np.where(depth < min_depth, np.float32(0), depth), np.inf)


def surface_labels(view: RenderedView) -> NDArray[np.int16]:
    """`RenderLabel.kUnspecified` where there is a surface and `RenderLabel.kEmpty` elsewhere:
    Gaussians carry no semantics  # (H, W).
    """
    unspecified, empty = int(RenderLabel.kUnspecified), int(RenderLabel.kEmpty)
    return np.where(view.depth > 0, unspecified, empty).astype(np.int16)


# Rolling shutters: each row of an image is seen from where the camera was when it was read.
#
# Rows are read one after the other at even times, the first at the pose X_WC0 and the last at
# X_WC1, those between at `pose_between`. Rows between which an image hardly moves are rendered
# together, as a band, from the pose of their middle.


_STEP = 0.5
"""[px] that an image may move between two bands, so that no row is off by more than half of it."""
_NEAREST = 1.0
"""[m] Depth of what is told to move so far; what is nearer moves more."""


def row_bands(
    X_WC0: RigidTransform, X_WC1: RigidTransform, focal: float, height: int, fewest: int = 1
) -> list[tuple[int, int]]:
    """First row and row after the last of each band of an image.

    Args:
        X_WC0, X_WC1: poses of the camera at the first and the last row.
        focal: [px]
        height: [px]
        fewest: bands at least, for what moves before a camera at rest.
    """
    turned = (X_WC0.rotation().inverse() @ X_WC1.rotation()).ToAngleAxis().angle()
    travelled = np.linalg.norm(X_WC1.translation() - X_WC0.translation())
    moved = focal * (abs(turned) + float(travelled) / _NEAREST)
    count = min(height, max(fewest, math.ceil(moved / _STEP)))
    edges = np.linspace(0, height, count + 1).round().astype(int).tolist()
    return list(pairwise(edges))


class Band(NamedTuple):
    """Rows of an image that are rendered from one pose, as an image of their own."""

    K: NDArray[np.float64]
    """Its intrinsics (3, 3) [px]."""
    height: int
    """[px]"""
    X_WC: RigidTransform
    """Where its middle row is read."""
    s: float
    """When: 0 as the first row of all is, 1 as the last."""


def camera_bands(
    K: NDArray[np.float64],
    height: int,
    X_WC0: RigidTransform,
    X_WC1: RigidTransform,
    fewest: int = 1,
) -> Iterator[Band]:
    """The bands of an image of intrinsics K (3, 3) [px] from its first row to its last; else as
    `row_bands`."""
    focal = float(max(K[0, 0], K[1, 1]))
    for first, last in row_bands(X_WC0, X_WC1, focal, height, fewest):
        s = 0.5 * (first + last) / height
        cropped = K.copy()
        cropped[1, 2] -= first
        yield Band(cropped, last - first, pose_between(X_WC0, X_WC1, s), s)


_BANDS = 8
"""Into which an image with a rolling shutter is cut at least where something moves."""


class _Rows(NamedTuple):
    """What is rendered from one pose."""

    camera: tuple[np.ndarray, int, int, RigidTransform]  # K (3, 3) [px], width, height, X_WC
    moving: PlacedGaussians


class SplatCamera(LeafSystem):
    """
    Colour, depth and label images of a Gaussian scene, with the output ports of Drake's
    `RgbdSensor`.

    .. pydrake_system::

        name: SplatCamera
        input_ports:
        - body_pose
        - start_pose (with a readout)
        output_ports:
        - color_image
        - depth_image_32f
        - depth_image_16u
        - label_image
        - body_pose_in_world
        - image_time

    `body_pose` is the pose X_WB of the body that carries the camera; the camera sits at X_WC = X_WB
    X_BC with x right, y down and z forward, and images all of colour, depth and labels from there.
    With a `readout`, a rolling shutter, that is where its last row is read, and `start_pose` the
    pose X_WB where the first was; see `rolling_shutter`.
    The images are rendered when a port is evaluated, once for all of them, and again only when the
    pose has changed, or the time where something moves. Depth that is looked at alone is rendered
    alone, which is faster, and has the same bits.

    Depth is planar z of the surface, the median depth of `rasterize`, in metres
    (`depth_image_32f`) or millimetres (`depth_image_16u`). As in Drake, nearer than `min_depth`
    reads 0, farther than `max_depth` reads infinity or 65535, and so does a pixel without a
    surface. Labels are `RenderLabel.kUnspecified` where there is a surface and
    `RenderLabel.kEmpty` elsewhere: Gaussians carry no semantics.
    """

    body_pose_input_port = input_port("body_pose")
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
        moving: MovingGaussians | None = None,
        latency: float = 0.0,
        distortion: Distortion | None = None,
        readout: float = 0.0,
    ):
        """
        Args:
            scene: what there is to see. A `BakedScene` is held by reference, so that many cameras
                share one; a `GaussianScene` is baked for this camera alone.
            camera_info: intrinsics, width and height.
            X_BC: pose of the camera in the body that carries it; identity when None.
            min_depth, max_depth: range of the depth image [m].
            near, far: Gaussians whose centre is not between these planes are not drawn [m].
            background: colour behind everything, red, green, blue in [0, 1], or one for each
                direction.
            moving: what moves among the scene's Gaussians.
            latency: age of the images [s]: what moves is where it was so long ago. The pose that
                the camera is given must be as old.
            distortion: of the lens; None for a pinhole. What it does not show is no surface.
            readout: time between reading the first row and the last [s]; 0 reads all at once.

        Raises:
            ValueError: if the depth range is empty, a focal length is not positive or `readout` is
                negative; for a distortion that makes no sense.
        """
        super().__init__()
        if not 0 <= min_depth < max_depth < np.inf:
            raise ValueError(
                f"camera depth range is [{min_depth}, {max_depth}] m; it must satisfy "
                "0 <= min_depth < max_depth < inf"
            )
        if camera_info.focal_x() <= 0 or camera_info.focal_y() <= 0:
            raise ValueError(
                f"camera focal lengths are {camera_info.focal_x()}, {camera_info.focal_y()} "
                "pixels; both must be positive"
            )
        if not 0.0 <= readout < np.inf:
            raise ValueError(f"camera readout is {readout} s; it must be at least 0 and finite")
        self._scene = BakedScene(scene) if isinstance(scene, GaussianScene) else scene
        self._camera_info = camera_info
        self._X_BC = RigidTransform() if X_BC is None else X_BC
        self._depth_range = (min_depth, max_depth)
        self._clipping = (near, far)
        self._background = background
        self._moving, self._latency, self._readout = moving, latency, readout
        if distortion is not None:
            distortion.validate()
        self._distortion = distortion

        pose_port = self.DeclareAbstractInputPort("body_pose", Value(RigidTransform()))
        pose_ticket = self.input_port_ticket(pose_port.get_index())
        tickets = {pose_ticket} if moving is None else {pose_ticket, self.time_ticket()}
        if readout > 0.0:
            start_port = self.DeclareAbstractInputPort("start_pose", Value(RigidTransform()))
            tickets.add(self.input_port_ticket(start_port.get_index()))
        view_entry, depth_entry = (
            self.DeclareCacheEntry(
                name,
                ValueProducer(
                    Value[object],  # pyright: ignore[reportArgumentType]
                    weakly(calc),
                ),
                tickets,
            )
            for name, calc in (("view", self._calc_view), ("depth", self._calc_depth))
        )
        # The indices: Drake would never free a system that keeps the entries themselves.
        self._view_index, self._depth_index = view_entry.cache_index(), depth_entry.cache_index()
        width, height = camera_info.width(), camera_info.height()
        for name, image, calc, entry in (
            ("color_image", ImageRgba8U, self._calc_color, view_entry),
            ("depth_image_32f", ImageDepth32F, self._calc_depth_32f, depth_entry),
            ("depth_image_16u", ImageDepth16U, self._calc_depth_16u, depth_entry),
            ("label_image", ImageLabel16I, self._calc_label, view_entry),
        ):
            self.DeclareAbstractOutputPort(
                name,
                alloc=lambda image=image: Value(image(width, height)),
                calc=weakly(calc),
                prerequisites_of_calc={entry.ticket()},
            )
        self.DeclareAbstractOutputPort(
            "body_pose_in_world",
            alloc=lambda: Value(RigidTransform()),
            calc=weakly(self._calc_body_pose),
            prerequisites_of_calc={pose_ticket},
        )
        self.DeclareVectorOutputPort(
            "image_time", 1, self._calc_image_time, prerequisites_of_calc={self.time_ticket()}
        )

    def camera_info(self) -> CameraInfo:
        """The intrinsics."""
        return self._camera_info

    def X_BC(self) -> RigidTransform:
        """The pose of the camera in the body that carries it."""
        return self._X_BC

    def render(
        self, X_WB: RigidTransform, time: float = 0.0, X_WB_start: RigidTransform | None = None
    ) -> RenderedView:
        """The view from body pose X_WB at a time [s]: float colour, depth up to the camera's
        `max_depth`, and alpha, before they become Drake images. Where X_WB_start is given, the
        first row is read there, `readout` before.
        """
        views = [
            render_view(
                self._scene,
                *rows.camera,
                *self._clipping,
                background=self._background,
                moving=rows.moving,
                distortion=self._distortion,
                max_depth=self._depth_range[1],
            )
            for rows in self._bands(X_WB, time, X_WB_start)
        ]
        if len(views) == 1:
            return views[0]
        return RenderedView(*map(np.concatenate, zip(*views, strict=True)))

    def _bands(
        self, X_WB: RigidTransform, time: float, X_WB_start: RigidTransform | None
    ) -> Iterator[_Rows]:
        """Rows that are rendered from one pose, from the first to the last."""
        info, time = self._camera_info, time - self._latency
        K, width, height = info.intrinsic_matrix(), info.width(), info.height()
        X_WC1 = X_WB @ self._X_BC
        if X_WB_start is None:
            yield _Rows((K, width, height, X_WC1), self._among(time))
            return
        X_WC0, fewest = X_WB_start @ self._X_BC, 1 if self._moving is None else _BANDS
        for band in camera_bands(K, height, X_WC0, X_WC1, fewest):
            camera = (band.K, width, band.height, band.X_WC)
            yield _Rows(camera, self._among(time - (1.0 - band.s) * self._readout))

    def _among(self, time: float) -> PlacedGaussians:
        return NO_GAUSSIANS if self._moving is None else self._moving.at(max(0.0, time))

    def _poses(self, context) -> tuple[RigidTransform, float, RigidTransform | None]:
        """Where the last row is read, when, and where the first is with a rolling shutter."""
        X_WB = cast(RigidTransform, self.GetInputPort("body_pose").Eval(context))
        start = None
        if self._readout > 0.0:
            start = cast(RigidTransform, self.GetInputPort("start_pose").Eval(context))
        return X_WB, context.get_time(), start

    def _calc_view(self, context, value) -> None:
        value.set_value(self.render(*self._poses(context)))

    def _calc_depth(self, context, value) -> None:
        """(H, W) [m], with 0 and inf out of range."""
        entry = self.get_cache_entry(self._view_index)
        if not entry.is_out_of_date(context):
            depth = self._view(context).depth
        else:
            depths = [
                self._scene.render_depth(
                    *rows.camera,
                    *self._clipping,
                    max_depth=self._depth_range[1],
                    moving=rows.moving,
                    distortion=self._distortion,
                )
                for rows in self._bands(*self._poses(context))
            ]
            depth = depths[0] if len(depths) == 1 else np.concatenate(depths)
        value.set_value(ranged_depth(depth, *self._depth_range))

    def _view(self, context) -> RenderedView:
        return cast(RenderedView, self.get_cache_entry(self._view_index).Eval(context))

    def _calc_color(self, context, value) -> None:
        pixels = value.get_mutable_value().mutable_data  # (H, W, 4)
        pixels[..., :3] = color_pixels(self._view(context).color)
        pixels[..., 3] = 255

    def _depth(self, context) -> np.ndarray:
        return cast(Any, self.get_cache_entry(self._depth_index).Eval(context))

    def _calc_depth_32f(self, context, value) -> None:
        value.get_mutable_value().mutable_data[..., 0] = self._depth(context)

    def _calc_depth_16u(self, context, value) -> None:
        millimetres = np.minimum(self._depth(context) * 1000.0 + 0.5, 65535.0)
        value.get_mutable_value().mutable_data[..., 0] = millimetres

    def _calc_label(self, context, value) -> None:
        value.get_mutable_value().mutable_data[..., 0] = surface_labels(self._view(context))

    def _calc_body_pose(self, context, value) -> None:
        value.set_value(self.GetInputPort("body_pose").Eval(context))

    def _calc_image_time(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, context.get_time())
