"""VideoRecorder."""

import cv2
import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.sensors import ImageDepth16U, ImageRgba8U

from splatpilot.systems.visualization.video import VideoRecorder, colorize_depth


class Brightening(LeafSystem):
    """Images whose red grows with time, and a constant depth of 1 m."""

    def __init__(self):
        super().__init__()
        self.DeclareAbstractOutputPort("color", lambda: Value(ImageRgba8U(32, 16)), self._color)
        self.DeclareAbstractOutputPort("depth", lambda: Value(ImageDepth16U(32, 16)), self._depth)

    def _color(self, context, value):
        value.get_mutable_value().mutable_data[..., 0] = int(200 * context.get_time())

    def _depth(self, context, value):
        value.get_mutable_value().mutable_data[...] = 1000


@pytest.fixture
def recorder_after_one_second() -> VideoRecorder:
    builder = DiagramBuilder()
    source = builder.AddSystem(Brightening())
    recorder = builder.AddSystem(VideoRecorder(32, 16, fps=10))
    builder.Connect(source.GetOutputPort("color"), recorder.GetInputPort("color_image"))
    builder.Connect(source.GetOutputPort("depth"), recorder.GetInputPort("depth_image_16u"))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.99)
    return recorder


def test_video_that_cannot_be_written_is_not_kept(recorder_after_one_second, tmp_path, monkeypatch):
    path = tmp_path / "video.mp4"
    recorder_after_one_second.save(path, max_depth=20.0)
    before, frames = path.read_bytes(), recorder_after_one_second.frames
    monkeypatch.setattr(recorder_after_one_second, "frames", lambda d: list(frames(d))[:7])
    with pytest.raises(OSError, match=r"video\.mp4: cannot be written \(only 7 of 10 images"):
        recorder_after_one_second.save(path, max_depth=20.0)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(OSError, match=r"nowhere/video\.mp4"):
        recorder_after_one_second.save(tmp_path / "nowhere" / "video.mp4", max_depth=20.0)


def test_video_holds_every_frame_in_order(recorder_after_one_second, tmp_path):
    path = tmp_path / "video.mp4"
    recorder_after_one_second.save(path, max_depth=20.0)
    video = cv2.VideoCapture(str(path))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert len(frames) == 10
    assert frames[0].shape == (16, 64, 3)
    reds = [frame[:, :32, 2].mean() for frame in frames]
    np.testing.assert_allclose(reds, 20 * np.arange(10), atol=5)  # a quarter of a step
    for frame in frames:
        right = frame[:, 36:].reshape(-1, 3).mean(axis=0)  # but for what runs over the seam
        np.testing.assert_allclose(right, colorize_depth(np.ones((1, 1)), 20.0)[0, 0], atol=5)


def test_frames_may_be_read_again_before_they_end(recorder_after_one_second):
    next(recorder_after_one_second.frames(20.0))
    assert len(list(recorder_after_one_second.frames(20.0))) == 10


def test_depth_colors_fade_with_distance():
    picture = colorize_depth(np.array([[0.0, 0.5, 2.0, 8.0, 65.535]]), max_depth=20.0)
    brightness = picture[0].astype(int).sum(axis=1)
    assert brightness[0] == brightness[4] == 0
    assert brightness[1] > brightness[2] > brightness[3] > 0
