import json

import cv2
import numpy as np
import OpenEXR
import pytest

from splatpilot.training.captures.capture_registry import read_capture

OPENGL = np.diag([1.0, -1.0, -1.0])


def write_exr(file, depth) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"R": depth.astype(np.float32)}) as exr:
        exr.write(str(file))


@pytest.fixture
def write(tmp_path, K, room_views):
    """Writes the room as Record3D exports it: the world is that of the first camera."""

    def write(intrinsics=None, **extra):
        (tmp_path / "rgb").mkdir()
        (tmp_path / "depth").mkdir()
        views = room_views(K, 64, 48)
        depths = room_views(np.diag([0.5, 0.5, 1]) @ K, 32, 24)
        poses = []
        for i, (view, small) in enumerate(zip(views, depths, strict=True)):
            cv2.imwrite(str(tmp_path / f"rgb/{i}.png"), view.image[..., ::-1])
            write_exr(tmp_path / f"depth/{i}.exr", small.depth)
            X = views[0].X_WC.inverse() @ view.X_WC
            w, x, y, z = X.rotation().ToQuaternion().wxyz()
            # From optical axes to OpenGL's at both ends.
            poses.append([x, -y, -z, w, *(OPENGL @ X.translation())])
        content = {"w": 64, "h": 48, "K": K.T.ravel().tolist(), "poses": poses, "fps": 60}
        (tmp_path / "metadata.json").write_text(json.dumps(content | extra))
        return tmp_path

    return write


def relative(capture, room_poses):
    """The pose of the capture's world in the room, from the first camera."""
    return room_poses[0] @ capture.X_WCs[0].inverse()


def test_room(write, shows_room, room_poses):
    capture = read_capture(write())
    assert capture.source.startswith("Record3D") and capture.metric and not capture.dropped
    X_RW = relative(capture, room_poses)
    shows_room(capture, X_RW, color=0.5, depth=0.03)
    assert X_RW.rotation().matrix()[2, 2] > np.cos(np.deg2rad(15))


def test_intrinsics_of_each_frame(write, K, shows_room, room_poses):
    own = [[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]] * 10
    wrong = np.diag([2.0, 2.0, 1]) @ K
    path = write(K=wrong.T.ravel().tolist(), perFrameIntrinsicCoeffs=own)
    capture = read_capture(path)
    shows_room(capture, relative(capture, room_poses), color=0.5, depth=0.03)


def test_what_is_not_an_export(write, tmp_path):
    recording = tmp_path / "room.r3d"
    recording.write_bytes(b"PK")
    with pytest.raises(ValueError, match=r'own format.*export the recording as "EXR'):
        read_capture(recording)
    path = write()
    content = json.loads((path / "metadata.json").read_text())
    (path / "metadata.json").write_text(json.dumps(content | {"poses": content["poses"][:4]}))
    with pytest.raises(ValueError, match=r"4 poses, but 9\.png is frame 9"):
        read_capture(path)
    (path / "metadata.json").write_text(json.dumps(content | {"poses": [[1, 2]]}))
    with pytest.raises(
        ValueError, match=r"invalid metadata of Record3D \(poses must be .* got \(1, 2\)"
    ):
        read_capture(path)


def test_damaged_depth_is_named(write):
    path = write()
    whole = (path / "depth/3.exr").read_bytes()
    (path / "depth/3.exr").write_bytes(whole[:40])
    capture = read_capture(path)
    assert len(capture) == 9 and "3.exr: not a readable EXR file" in capture.dropped[0]
