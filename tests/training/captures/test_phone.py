import json

import cv2
import numpy as np
import OpenEXR
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from room import CAMERA_POSES, K, assert_shows_room, room_views

from splatpilot.training.captures.capture_registry import read_capture

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# The room's z is the files' y.
X_RF = RigidTransform(RotationMatrix.MakeXRotation(np.pi / 2))


@pytest.fixture
def write(tmp_path):
    def write(prefix: str = ""):
        folder = tmp_path / "keyframes"
        for name in (f"{prefix}images", f"{prefix}cameras", "depth"):
            (folder / name).mkdir(parents=True)
        for i in range(10):
            focused = np.diag([1 + 0.01 * (i % 3), 1 + 0.01 * (i % 3), 1]) @ K
            focused[:2, 2] = K[:2, 2]
            view = room_views(focused, 64, 48)[i]
            depth = room_views(np.diag([0.5, 0.5, 1]) @ focused, 32, 24)[i].depth
            stem = str(638443502 + i)
            image = folder / f"{prefix}images/{stem}.jpg"
            cv2.imwrite(str(image), view.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])
            millimeters = np.round(1000 * depth).astype(np.uint16)
            cv2.imwrite(str(folder / f"depth/{stem}.png"), millimeters)
            pose = (X_RF.inverse() @ view.X_WC).GetAsMatrix4() @ OPENGL
            camera = {f"t_{r}{c}": pose[r, c] for r in range(3) for c in range(4)}
            camera |= {"fx": focused[0, 0], "fy": focused[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
            camera |= {"width": 64, "height": 48, "blur_score": 12.5}
            (folder / f"{prefix}cameras/{stem}.json").write_text(json.dumps(camera))
        return tmp_path

    return write


@pytest.mark.parametrize("prefix", ["", "corrected_"])
def test_room(write, prefix):
    path = write(prefix)
    (path / "keyframes/cameras").mkdir(exist_ok=True)
    if prefix:
        for i in range(13):
            (path / f"keyframes/cameras/{638443502 + i}.json").write_text("{}")
        for camera in (path / "keyframes/corrected_cameras").iterdir():  # of the images' size
            values = json.loads(camera.read_text())
            del values["width"], values["height"]
            camera.write_text(json.dumps(values))
    capture = read_capture(path)
    assert capture.source.startswith("Polycam") and capture.metric
    assert_shows_room(capture, color=4.0, depth=0.03)
    dropped = "3 of 13 keyframes have no corrected camera" if prefix else ""
    assert len(capture.dropped) == bool(prefix) and dropped in "".join(capture.dropped)


def test_damaged_keyframes_are_named_and_depth_without_confidence_is_unknown(write):
    path = write()
    cameras = sorted((path / "keyframes/cameras").iterdir())
    cameras[2].write_text("{}")
    (path / "keyframes/depth" / f"{cameras[4].stem}.png").unlink()
    (path / "keyframes/confidence").mkdir()
    confidence = np.full((24, 32), 255, np.uint8)
    confidence[:, :16] = 0
    cv2.imwrite(str(path / "keyframes/confidence/638443502.png"), confidence)
    capture = read_capture(path)
    assert len(capture) == 9
    assert "638443504.json: not a readable camera of a keyframe" in capture.dropped[0]
    assert not capture.registered_depth(3).any() and capture.registered_depth(2).all()
    known = capture.registered_depth(0) > 0
    assert not known[:, :30].any() and known[:, 34:].all()
    for camera in cameras[3:6]:
        camera.write_text('{"fx": "wide"}')
    with pytest.raises(ValueError, match="6 of 10 frames can be used"):
        read_capture(path)


@pytest.fixture
def write_record3d(tmp_path):
    def write_record3d(**extra):
        (tmp_path / "rgb").mkdir()
        (tmp_path / "depth").mkdir()
        views = room_views(K, 64, 48)
        depths = room_views(np.diag([0.5, 0.5, 1]) @ K, 32, 24)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        poses = []
        for i, (view, small) in enumerate(zip(views, depths, strict=True)):
            cv2.imwrite(str(tmp_path / f"rgb/{i}.png"), view.image[..., ::-1])
            with OpenEXR.File(header, {"R": small.depth.astype(np.float32)}) as exr:
                exr.write(str(tmp_path / f"depth/{i}.exr"))
            X = views[0].X_WC.inverse() @ view.X_WC
            w, x, y, z = X.rotation().ToQuaternion().wxyz()
            # From optical axes to OpenGL's at both ends.
            poses.append([x, -y, -z, w, *(OPENGL[:3, :3] @ X.translation())])
        content = {"w": 64, "h": 48, "K": K.T.ravel().tolist(), "poses": poses, "fps": 60}
        (tmp_path / "metadata.json").write_text(json.dumps(content | extra))
        return tmp_path

    return write_record3d


@pytest.mark.parametrize("per_frame", [False, True])
def test_record3d_room(write_record3d, per_frame):
    own = [[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]] * 10
    wrong = (np.diag([2.0, 2.0, 1]) @ K).T.ravel().tolist()
    intrinsics = {"K": wrong, "perFrameIntrinsicCoeffs": own} if per_frame else {}
    capture = read_capture(write_record3d(**intrinsics))
    assert capture.source.startswith("Record3D") and capture.metric and not capture.dropped
    X_RW = CAMERA_POSES[0] @ capture.X_WCs[0].inverse()
    assert_shows_room(capture, X_RW, color=0.5, depth=0.03)
    assert X_RW.rotation().matrix()[2, 2] > np.cos(np.deg2rad(15))


def test_invalid_exports_are_refused(write_record3d, tmp_path):
    recording = tmp_path / "room.r3d"
    recording.write_bytes(b"PK")
    with pytest.raises(ValueError, match=r'own format.*export the recording as "EXR'):
        read_capture(recording)
    path = write_record3d()
    (path / "depth/3.exr").write_bytes((path / "depth/3.exr").read_bytes()[:40])
    capture = read_capture(path)
    assert len(capture) == 9 and "3.exr: not a readable EXR file" in capture.dropped[0]
    content = json.loads((path / "metadata.json").read_text())
    for poses, message in (
        (content["poses"][:4], r"4 poses, but 9\.png is frame 9"),
        ([[1, 2]], r"file of Record3D's metadata \(poses must be .* got \(1, 2\)"),
    ):
        (path / "metadata.json").write_text(json.dumps(content | {"poses": poses}))
        with pytest.raises(ValueError, match=message):
            read_capture(path)
