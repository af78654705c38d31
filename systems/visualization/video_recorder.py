"""A video of what the camera saw: colour beside depth."""

import tempfile
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem
from pydrake.systems.sensors import ImageDepth16U, ImageRgba8U
from tqdm import tqdm

from splatpilot.systems.files import written_atomically
from splatpilot.systems.ports import input_port
from splatpilot.systems.splats.splat_camera import SplatCamera


class VideoRecorder(LeafSystem):
    """
    Collects colour and depth images at a fixed rate; `save` writes them as a video afterwards.

    .. pydrake_system::

        name: VideoRecorder
        input_ports:
        - color_image
        - depth_image_16u

    The images wait in a temporary file (0.4 MB each at 320x240) and are encoded after the flight,
    because encoding takes longer than rendering and would be charged to the simulation. Like every
    recorder it writes outside the Context: one recorder is for one simulation at a time.
    """

    color_image_input_port = input_port("color_image")
    depth_image_16u_input_port = input_port("depth_image_16u")

    def __init__(self, width: int, height: int, fps: float):
        """
        Args:
            width, height: size of the images [pixels].
            fps: images a second of simulated time, and of the video.
        """
        super().__init__()
        self._fps = fps
        self._frame = np.dtype(
            [("rgb", np.uint8, (height, width, 3)), ("depth", np.uint16, (height, width))]
        )
        self._file = tempfile.TemporaryFile()
        self.DeclareAbstractInputPort("color_image", Value(ImageRgba8U(width, height)))
        self.DeclareAbstractInputPort("depth_image_16u", Value(ImageDepth16U(width, height)))
        self.DeclareInitializationPublishEvent(self._clear)
        self.DeclarePeriodicPublishEvent(1 / fps, 0.0, self._record)

    @staticmethod
    def AddToBuilder(builder: DiagramBuilder, camera: SplatCamera, fps: float) -> "VideoRecorder":
        """Adds a recorder, named `video`, of the images of a camera."""
        info = camera.camera_info()
        recorder = VideoRecorder(info.width(), info.height(), fps)
        builder.AddNamedSystem("video", recorder)
        builder.Connect(camera.color_image_output_port(), recorder.color_image_input_port())
        builder.Connect(camera.depth_image_16u_output_port(), recorder.depth_image_16u_input_port())
        return recorder

    def _clear(self, context: Context) -> EventStatus:
        self._file.seek(0)
        self._file.truncate()
        return EventStatus.Succeeded()

    def _record(self, context: Context) -> EventStatus:
        color = cast(ImageRgba8U, self.GetInputPort("color_image").Eval(context))
        depth = cast(ImageDepth16U, self.GetInputPort("depth_image_16u").Eval(context))
        frame = np.empty((), self._frame)
        frame["rgb"] = np.asarray(color.data)[..., :3]
        frame["depth"] = np.asarray(depth.data)[..., 0]
        self._file.write(frame.tobytes())
        return EventStatus.Succeeded()

    def save(self, path: Path, max_depth: float) -> None:
        """
        Writes the video (VP9 in MP4, which every browser plays) atomically.

        Args:
            path: the file, ending in .mp4.
            max_depth: depth at which the depth picture's colours end [m].

        Raises:
            OSError: if the file cannot be written.
        """
        height, width = self._frame["depth"].shape
        size = (2 * width, height)
        frames = self._file.tell() // self._frame.itemsize
        self._file.seek(0)
        fourcc = cv2.VideoWriter.fourcc(*"vp09")
        with written_atomically(path) as partial:
            writer = cv2.VideoWriter(str(partial), cv2.CAP_FFMPEG, fourcc, self._fps, size)
            if not writer.isOpened():
                raise OSError(f"{path}: OpenCV cannot write a video here; is the folder writable?")
            for _ in tqdm(range(frames), "video", unit="frame", leave=False, disable=None):
                frame = np.frombuffer(self._file.read(self._frame.itemsize), self._frame)[0]
                depth = colorize_depth(frame["depth"] * 1e-3, max_depth)
                writer.write(np.hstack([frame["rgb"][..., ::-1], depth]))
            writer.release()


def colorize_depth(depth: np.ndarray, max_depth: float) -> np.ndarray:
    """
    Depth (H, W) [m] as a picture (H, W, 3) uint8 in OpenCV's channel order.

    Near is bright and far dark, in inverse depth from 0.5 m to `max_depth`; out of range is black.
    """
    inverse = 1.0 / np.clip(depth, 0.5, max_depth)
    shade = (inverse - 1.0 / max_depth) / (2.0 - 1.0 / max_depth)
    picture = cv2.applyColorMap((np.sqrt(shade) * 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
    picture[(depth <= 0) | (depth > max_depth)] = 0
    return picture
