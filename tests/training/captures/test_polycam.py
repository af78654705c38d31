import json

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.training.captures.capture_registry import read_capture

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# The room's z is the files' y.
X_RF = RigidTransform(RotationMatrix.MakeXRotation(np.pi / 2))


@pytest.fixture
def write(tmp_path, K, room_views):
    """Writes the room as Polycam does: y up, each keyframe focused by itself, small depth."""

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
            cv2.imwrite(
                str(folder / f"{prefix}images/{stem}.jpg"),
                view.image[..., ::-1],
                [cv2.IMWRITE_JPEG_QUALITY, 100],
            )
            millimetres = np.round(1000 * depth).astype(np.uint16)
            cv2.imwrite(str(folder / f"depth/{stem}.png"), millimetres)
            pose = (X_RF.inverse() @ view.X_WC).GetAsMatrix4() @ OPENGL
            camera = {f"t_{r}{c}": pose[r, c] for r in range(3) for c in range(4)}
            camera |= {"fx": focused[0, 0], "fy": focused[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
            camera |= {"width": 64, "height": 48, "blur_score": 12.5}
            (folder / f"{prefix}cameras/{stem}.json").write_text(json.dumps(camera))
        return tmp_path

    return write


@pytest.mark.parametrize("prefix", ["", "corrected_"])
def test_room(write, shows_room, prefix):
    capture = read_capture(write(prefix))
    assert capture.source.startswith("Polycam") and capture.metric and not capture.dropped
    shows_room(capture, color=4.0, depth=0.03)


def test_corrected_poses_come_first(write, shows_room):
    path = write("corrected_")
    (path / "keyframes/cameras").mkdir()
    assert len(read_capture(path)) == 10


def test_damaged_keyframes_are_named(write):
    path = write()
    cameras = sorted((path / "keyframes/cameras").iterdir())
    cameras[2].write_text("{}")
    (path / "keyframes/depth" / f"{cameras[4].stem}.png").unlink()
    capture = read_capture(path)
    assert len(capture) == 9
    assert "638443504.json: not the camera of a keyframe" in capture.dropped[0]
    assert not capture.registered_depth(3).any() and capture.registered_depth(2).any()
    for camera in cameras[3:6]:
        camera.write_text('{"fx": "wide"}')
    with pytest.raises(ValueError, match="6 of 10 frames can be used"):
        read_capture(path)
