"""Recordings for Rerun, read by its own reader."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from baked_scenes import uniform_scene
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource
from pydrake.systems.sensors import CameraInfo

from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.splats.lens import Distortion
from splatpilot.systems.splats.splat_camera import SplatCamera, empty_scene
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import StateToPose
from splatpilot.systems.visualization.rerun_sink import RerunSink

rrd = pytest.importorskip("rerun.chunk")


class Outcome(LeafSystem):
    """Ends at 0.25 s."""

    def __init__(self):
        super().__init__()
        self.DeclareAbstractOutputPort("outcome", lambda: Value(""), self._calc)

    def _calc(self, context, value):
        value.set_value("goal" if context.get_time() >= 0.25 else "")


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "flight.rrd"
    waypoints = np.cumsum(np.full((3, 10, 3), 0.1), axis=1)
    plan = Hypotheses(0.0, RigidTransform([1, 0, 2]), waypoints, np.array([1.0, 2.0, 3.0]))
    x = hover_state([1, 0, 2])
    values = {"state": x, "command": [9.81, 0, 0, 1], "clearance": [0.7]}
    builder = DiagramBuilder()
    ports = {
        name: builder.AddSystem(ConstantVectorSource(value)).get_output_port()
        for name, value in (values | {"hypotheses": plan.to_vector()}).items()
    }
    ports["outcome"] = builder.AddSystem(Outcome()).get_output_port()
    quats = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]])
    scene = uniform_scene([[3.0, 0, 2], [4.0, 0, 2]], [0.3] * 3, color=(1.0, 0, 0), quat=quats)
    pose = builder.AddSystem(StateToPose())
    camera = builder.AddSystem(SplatCamera(scene, CameraInfo(32, 24, 1.0), RigidTransform()))
    builder.Connect(ports["state"], pose.get_input_port())
    builder.Connect(pose.get_output_port(), camera.GetInputPort("body_pose"))
    sink = RerunSink.AddToBuilder(
        builder, path, ports, gaussians=scene, goal=x[:3], camera=camera, period=0.1
    )
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.3)
    sink.close()
    return path


def columns(path: Path, entity: str) -> dict[str, list]:
    found: dict[str, list] = {}
    for chunk in rrd.RrdReader(path).stream().to_chunks():
        if chunk.entity_path == entity:
            for name, values in chunk.to_record_batch().to_pydict().items():
                found.setdefault(name, []).extend(values)
    return found


def test_recording_is_valid_and_holds_everything_on_one_timeline(recording):
    verify = [sys.executable, "-m", "rerun_cli", "rrd", "verify", str(recording)]
    verified = subprocess.run(verify, capture_output=True)
    assert verified.returncode == 0, verified.stderr
    for entity in (
        *("/world/vehicle", "/world/hypotheses", "/world/vehicle/camera/color"),
        *("/world/vehicle/camera/depth", "/state/v_WB", "/command/thrust", "/clearance"),
    ):
        times = [time.total_seconds() for time in columns(recording, entity)["time"]]
        np.testing.assert_allclose(np.unique(times), [0.0, 0.1, 0.2, 0.3], atol=1e-9)
    assert columns(recording, "/clearance")["Scalars:scalars"][0] == [0.7]
    blob = columns(recording, "/world/vehicle/camera/depth")["EncodedDepthImage:blob"][0][0]
    depth = np.asarray(cv2.imdecode(np.array(blob, np.uint8), cv2.IMREAD_UNCHANGED))
    assert depth.dtype == np.uint16 and depth.shape == (24, 32) and depth.max() < 65535
    splats = columns(recording, "/world/splats")
    np.testing.assert_allclose(splats["GaussianSplats3D:centers"], [[[3, 0, 2], [4, 0, 2]]])
    # x y z w
    quaternions = splats["GaussianSplats3D:quaternions"]
    np.testing.assert_allclose(quaternions, [[[0, 0, 0, 1], [1, 0, 0, 0]]])
    names = columns(recording, "/state/v_WB")["SeriesLines:names"]
    assert names == [["x [m/s]", "y [m/s]", "z [m/s]"]]
    assert columns(recording, "/events")["TextLog:text"] == [["start"], ["goal"]]


@pytest.mark.parametrize("lens", [None, Distortion(model="fisheye")])
def test_only_pinhole_cameras_have_intrinsics(tmp_path, lens):
    camera = SplatCamera(empty_scene(), CameraInfo(32, 24, 1.0), distortion=lens)
    builder = DiagramBuilder()
    builder.AddSystem(camera)
    builder.ExportInput(camera.GetInputPort("body_pose"), "pose")
    sink = RerunSink.AddToBuilder(builder, tmp_path / "a.rrd", {}, camera=camera)
    simulator = Simulator(builder.Build())
    simulator.get_system().get_input_port().FixValue(simulator.get_context(), RigidTransform())
    simulator.Initialize()
    sink.close()
    found = columns(tmp_path / "a.rrd", "/world/vehicle/camera")
    assert "Transform3D:translation" in found
    assert ("Pinhole:image_from_camera" in found) == (lens is None)


def test_recordings_of_two_files_are_two_recordings(recording, tmp_path):
    moved = tmp_path / "other.rrd"
    sink = RerunSink(moved, {})
    Simulator(sink).Initialize()
    sink.close()
    ids = [rrd.RrdReader(path).recordings()[0].recording_id for path in (recording, moved)]
    assert len(set(ids)) == 2


def test_unknown_port_is_refused(tmp_path):
    port = ConstantVectorSource([0.0]).get_output_port()
    with pytest.raises(ValueError, match=r"ports must be some of state, .* got wings"):
        RerunSink(tmp_path / "a.rrd", {"wings": port})
