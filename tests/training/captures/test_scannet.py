import cv2
import numpy as np
import pytest

from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture

K_D = np.array([[24.0, 0, 16], [0, 24.0, 12], [0, 0, 1]])


@pytest.fixture
def write(tmp_path, K, room_views):
    """Writes the room as ScanNet's reader does: depth of another camera, at the same place."""
    for name in ("color", "depth", "pose", "intrinsic"):
        (tmp_path / name).mkdir()
    colors, depths = room_views(K, 64, 48), room_views(K_D, 32, 24)
    for i, (color, depth) in enumerate(zip(colors, depths, strict=True)):
        cv2.imwrite(str(tmp_path / f"color/{i}.png"), color.image[..., ::-1])
        millimetres = np.round(1000 * depth.depth).astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"depth/{i}.png"), millimetres)
        np.savetxt(tmp_path / f"pose/{i}.txt", color.X_WC.GetAsMatrix4())
    for name, intrinsics in (("color", K), ("depth", K_D)):
        matrix = np.eye(4)
        matrix[:3, :3] = intrinsics
        matrix[:2, 2] -= 0.5  # counted from the first pixel's centre
        np.savetxt(tmp_path / f"intrinsic/intrinsic_{name}.txt", matrix)
    return tmp_path


def test_room(write, shows_room):
    capture = read_capture(write)
    assert capture.source.startswith("ScanNet") and not capture.dropped
    shows_room(capture, color=0.5, depth=0.03)


def test_intrinsics_of_larger_images_are_refused(write, K):
    matrix = np.eye(4)
    matrix[:2, :3] = [[117.019, 0, 64.275], [0, 117.019, 47.875]]
    np.savetxt(write / "intrinsic/intrinsic_color.txt", matrix)
    with pytest.raises(ValueError, match=r"principal point must be in the image of 64x48 px, got"):
        read_capture(write)
    given = CaptureConfig(intrinsics=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    np.testing.assert_allclose(read_capture(write, given).K, K)


def test_lost_tracking_is_no_damage(write):
    for i in (1, 4, 5):
        np.savetxt(write / f"pose/{i}.txt", np.full((4, 4), -np.inf))
    capture = read_capture(write)
    assert len(capture) == 7 and "tracking was lost in 3 frames" in capture.dropped[0]
    for i in (2, 3):
        (write / f"pose/{i}.txt").write_text("1 2\n")
    with pytest.raises(ValueError, match=r"5 of 7 frames can be used.*tracking was lost"):
        read_capture(write)
