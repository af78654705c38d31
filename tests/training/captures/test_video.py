import cv2
import numpy as np
import pytest

from splatpilot.training.captures import colmap as video
from splatpilot.training.captures import frames as image_files
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture

RATE = 30.0  # [Hz]


def write_video(path, frames) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), RATE, (160, 120))
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()


def frames(count: int, sharp: set[int]) -> list[np.ndarray]:
    """Frames whose brightness tells their number, with a pattern that is blurred in most."""
    rng = np.random.default_rng(0)
    pattern = cv2.resize(rng.integers(0, 80, (30, 40), dtype=np.uint8), (160, 120), interpolation=0)
    made = []
    for i in range(count):
        image = np.stack([pattern + 2 * i] * 3, axis=-1).astype(np.uint8)
        made.append(image if i in sharp else cv2.GaussianBlur(image, (0, 0), 4))
    return made


@pytest.fixture
def registered(monkeypatch):
    """The folders of frames that were to be registered, and their brightness."""
    seen = {}

    def read(path, config):
        files = sorted(path.iterdir())
        seen[path] = [image_files.read_image(file).mean() for file in files]
        seen["names"] = [file.name for file in files]
        raise ValueError(f"{path}: enough")

    monkeypatch.setattr(video, "read_photographs", read)
    return seen


def test_the_sharpest_frame_of_each_interval_is_taken(tmp_path, registered):
    made = frames(60, sharp={3, 29, 30, 50})
    write_video(tmp_path / "flight.mp4", made)
    config = CaptureConfig(cache=str(tmp_path / "cache"))
    for _ in range(2):
        with pytest.raises(ValueError, match="enough"):
            read_capture(tmp_path / "flight.mp4", config)
        brightness = registered[tmp_path / "cache/frames"]
        expected = [made[i].mean() for i in (3, 29, 30, 50)]
        # 15 frames an interval: 0 to 14, 15 to 29, 30 to 44, 45 to 59.
        np.testing.assert_allclose(brightness, expected, atol=3)
    assert registered["names"] == [f"{i:05d}.jpg" for i in range(4)]


def test_rate(tmp_path, registered):
    write_video(tmp_path / "flight.mp4", frames(60, sharp=set()))
    config = CaptureConfig(cache=str(tmp_path / "cache"), video_rate=10)
    with pytest.raises(ValueError, match="enough"):
        read_capture(tmp_path / "flight.mp4", config)
    assert len(registered["names"]) == 20


def test_what_is_no_video(tmp_path):
    config = CaptureConfig(cache=str(tmp_path / "cache"))
    (tmp_path / "a.mp4").write_bytes(b"something else")
    with pytest.raises(ValueError, match=r"a\.mp4: not a readable video"):
        read_capture(tmp_path / "a.mp4", config)
    write_video(tmp_path / "b.mp4", frames(20, sharp=set()))
    with pytest.raises(ValueError, match=r"b\.mp4: 20 frames in 0\.7 s give 2 of 2 a second"):
        read_capture(tmp_path / "b.mp4", config)
    assert list((tmp_path / "cache").iterdir()) == []
    with pytest.raises(ValueError, match=r"video_rate must be in \(0, 100\] Hz, got 0"):
        read_capture(tmp_path / "b.mp4", CaptureConfig(video_rate=0))
    with pytest.raises(ValueError, match=r"partners must be in \[0, inf\), got -1"):
        read_capture(tmp_path / "b.mp4", CaptureConfig(partners=-1))
    (tmp_path / "c.txt").write_text("a text")
    with pytest.raises(ValueError, match=r"c\.txt: unknown capture format.*a video"):
        read_capture(tmp_path / "c.txt")
