"""RerunSink: records a flight for the viewer Rerun."""

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    OutputPort,
    PortDataType,
)
from pydrake.systems.sensors import CameraInfo

from splatpilot.systems.common.drake import connect
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.validation import require
from splatpilot.systems.policies.hypotheses import Hypotheses, num_hypotheses_in
from splatpilot.systems.splats.lens import Distortion
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState
from splatpilot.systems.visualization.flight_visualizer import hypothesis_colors
from splatpilot.systems.visualization.video import TOO_FAR

_JPEG_QUALITY = 80
_CAMERA = "world/vehicle/camera"
# The curves, and the names of their components
_CURVES = {
    "clearance": ("clearance [m]",),
    "command/thrust": ("thrust [m/s^2]",),
    "command/rates": ("x [rad/s]", "y [rad/s]", "z [rad/s]"),
    "state/p_WB": ("x [m]", "y [m]", "z [m]"),
    "state/v_WB": ("x [m/s]", "y [m/s]", "z [m/s]"),
    "state/q_WB": ("w", "x", "y", "z"),
    "state/w_WB_B": ("x [rad/s]", "y [rad/s]", "z [rad/s]"),
}


class RerunSink(LeafSystem):
    """Records its inputs to a file of Rerun (.rrd), on the timeline `time` [s].

    .. pydrake_system::

        name: RerunSink
        input_ports: [state, command, clearance, hypotheses, color_image, depth_image_16u, outcome]

    All inputs are optional; those of the constructor are declared. They are recorded every `period`
    [s], and `outcome`, a string, at each step that changes it. The file is that of the last
    simulation, and complete after `close`.
    """

    def __init__(
        self,
        path: Path,
        ports: Mapping[str, OutputPort],
        *,
        gaussians: GaussianScene | None = None,
        goal: NDArray[np.float64] | None = None,
        radius: float = VEHICLE_RADIUS,
        period: float = 1 / 15,
    ):
        """Declares an input like each of `ports`, by name.

        Args:
            gaussians: those of the world.
            goal: p_WG (3,) [m].
            radius: of the vehicle [m].
        """
        super().__init__()
        self._rr = cast(Any, import_extra("rerun", "rerun"))
        self._log: dict[str, Callable[[Any], None]] = {
            "state": self._log_state,
            "command": self._log_command,
            "clearance": lambda value: self._scalars("clearance", value),
            "hypotheses": self._log_hypotheses,
            "color_image": self._log_color,
            "depth_image_16u": self._log_depth,
            "outcome": self._log_outcome,
        }
        self._outcome: str | None = None
        for name, port in ports.items():
            require(name in self._log, "ports", f"some of {', '.join(self._log)}", name)
            if port.get_data_type() == PortDataType.kVectorValued:
                self.DeclareVectorInputPort(name, port.size())
            else:
                self.DeclareAbstractInputPort(name, port.Allocate())
        self._path = path
        self._recording: Any = None
        self._statics = [
            (curve, self._rr.SeriesLines(names=names)) for curve, names in _CURVES.items()
        ]
        if gaussians is not None:
            self._statics.append(("world/splats", self._splats(gaussians)))
        if goal is not None:
            goals = self._rr.Points3D([goal], radii=0.3, colors=[0, 200, 80])
            self._statics.append(("world/goal", goals))
        radii = [[radius, radius, 0.3 * radius]]
        vehicle = self._rr.Ellipsoids3D(
            half_sizes=radii, colors=[255, 120, 0], fill_mode="solid", labels="vehicle"
        )
        self._statics.append(("world/vehicle", vehicle))
        self.DeclareInitializationPublishEvent(self._begin)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)
        if "outcome" in ports:
            self.DeclarePerStepPublishEvent(self._publish_outcome)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        path: Path,
        ports: Mapping[str, OutputPort],
        *,
        camera: SplatCamera | None = None,
        name: str = "rerun",
        **options: Any,
    ) -> "RerunSink":
        """Adds a sink that is connected to `ports`, and to the images of a camera; for `options`
        see the constructor."""
        if camera is not None:
            images = "color_image", "depth_image_16u"
            ports = {**ports, **{image: camera.GetOutputPort(image) for image in images}}
        sink = RerunSink(path, ports, **options)
        if camera is not None:
            sink.show_camera(camera.camera_info(), camera.X_BC(), camera.distortion)
        builder.AddNamedSystem(name, sink)
        for name, port in ports.items():
            connect(builder, port, sink.GetInputPort(name))
        return sink

    def show_camera(
        self, info: CameraInfo, X_BC: RigidTransform, distortion: Distortion | None = None
    ) -> None:
        """Records the pose of the camera in the vehicle's body frame, and the intrinsics of a
        pinhole. Rerun has no lenses: it would draw depth along other rays."""
        q_BC, size = X_BC.rotation().ToQuaternion().wxyz(), [info.width(), info.height()]
        pinhole = self._rr.Pinhole(image_from_camera=info.intrinsic_matrix(), resolution=size)
        transform = self._transform(X_BC.translation(), q_BC)
        self._statics.append((_CAMERA, transform))
        if distortion is None:
            self._statics.append((_CAMERA, pinhole))

    def close(self) -> None:
        """Completes the file; the sink records no more."""
        if self._recording is not None:
            self._recording.flush()
            self._recording.disconnect()
            self._recording = None

    def _begin(self, context: Context) -> EventStatus:
        """Opens the file, and records what does not change."""
        self.close()
        self._outcome = None
        # The viewer shows files of one identity as one recording.
        identity = str(Path(self._path).resolve())
        self._recording = self._rr.RecordingStream("splatpilot", recording_id=identity)
        self._recording.save(self._path, default_blueprint=self._layout())
        for path, value in self._statics:
            self._recording.log(path, value, static=True)
        return EventStatus.Succeeded()

    def _layout(self) -> Any:
        """Lays out the views: the world around the vehicle, its images, and the curves."""
        views = import_module("rerun.blueprint")
        eye = views.EyeControls3D(tracking_entity="world/vehicle")
        world = views.Spatial3DView(origin="world", name="World", eye_controls=eye)
        images = views.Horizontal(
            views.Spatial2DView(origin=_CAMERA, contents=f"{_CAMERA}/color", name="Color"),
            views.Spatial2DView(origin=_CAMERA, contents=f"{_CAMERA}/depth", name="Depth"),
        )
        curves = [views.TimeSeriesView(origin=curve, name=curve) for curve in _CURVES]
        return views.Blueprint(
            views.Horizontal(
                views.Vertical(world, views.TextLogView(origin="events"), row_shares=[5, 1]),
                views.Vertical(images, views.Grid(*curves, grid_columns=2), row_shares=[2, 3]),
                column_shares=[5, 4],
            ),
            views.TimePanel(timeline="time"),
            collapse_panels=True,
        )

    def _publish(self, context: Context) -> EventStatus:
        if self._recording is None:
            self._begin(context)
        cast(Any, self._recording).set_time("time", duration=context.get_time())
        for k in range(self.num_input_ports()):
            port = self.get_input_port(k)
            self._log[port.get_name()](port.Eval(context))
        return EventStatus.Succeeded()

    def _publish_outcome(self, context: Context) -> EventStatus:
        outcome = self.GetInputPort("outcome").Eval(context)
        if outcome == self._outcome:
            return EventStatus.DidNothing()
        return self._publish(context)

    def _scalars(self, path: str, values: NDArray[np.float64]) -> None:
        self._recording.log(path, self._rr.Scalars(values))

    def _transform(self, p: NDArray[np.float64], q: NDArray[np.float64]) -> Any:
        """Makes a transform of a position and a quaternion (w, x, y, z)."""
        return self._rr.Transform3D(translation=p, quaternion=np.roll(q, -1))

    def _splats(self, gaussians: GaussianScene) -> Any:
        shades = np.column_stack([gaussians.base_colors, gaussians.opacities])
        return self._rr.GaussianSplats3D(
            gaussians.means,
            scales=gaussians.scales,
            quaternions=np.roll(gaussians.quats, -1, axis=1),
            colors=np.round(255 * np.clip(shades, 0, 1)).astype(np.uint8),
        )

    def _log_state(self, x: NDArray[np.float64]) -> None:
        state = QuadrotorState.of(x)
        self._recording.log("world/vehicle", self._transform(state.p_WB, state.q_WB))
        for name, value in zip(("p_WB", "v_WB", "q_WB", "w_WB_B"), state, strict=True):
            self._scalars(f"state/{name}", value)

    def _log_command(self, command: NDArray[np.float64]) -> None:
        self._scalars("command/thrust", command[:1])
        self._scalars("command/rates", command[1:])

    def _log_hypotheses(self, vector: NDArray[np.float64]) -> None:
        plan = Hypotheses.from_vector(vector, num_hypotheses_in(len(vector)))
        if plan is not None:
            start = np.broadcast_to(plan.X_WB.translation(), (len(plan.costs), 1, 3))
            strips = np.concatenate([start, plan.waypoints_W], axis=1)
            colors = np.round(255 * hypothesis_colors(plan.costs)).astype(np.uint8)
            self._recording.log("world/hypotheses", self._rr.LineStrips3D(strips, colors=colors))

    def _log_color(self, image: Any) -> None:
        rgb = np.asarray(image.data)[..., :3]
        self._recording.log(f"{_CAMERA}/color", self._rr.Image(rgb).compress(_JPEG_QUALITY))

    def _log_depth(self, image: Any) -> None:
        depth = np.asarray(image.data)[..., 0]
        png = cv2.imencode(".png", np.where(depth == TOO_FAR, 0, depth))[1].tobytes()
        encoded = self._rr.EncodedDepthImage(blob=png, media_type="image/png", meter=1e3)
        self._recording.log(f"{_CAMERA}/depth", encoded)

    def _log_outcome(self, outcome: str) -> None:
        if outcome != self._outcome:
            self._outcome = outcome
            self._recording.log("events", self._rr.TextLog(outcome or "start"))
