"""VideoRecorder: video of a camera, color next to depth."""

import os
import tempfile
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem
from pydrake.systems.sensors import ImageDepth16U, ImageRgba8U

from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.splats.splat_camera import SplatCamera

TOO_FAR = np.iinfo(np.uint16).max  # of Drake's images of depth [mm]


class VideoRecorder(LeafSystem):
    """Records color and depth images at a fixed rate; `frames` reads, `save` writes a video.

    .. pydrake_system::

        name: VideoRecorder
        input_ports: [color_image, depth_image_16u]

    Images are in a temporary file (0.4 MB each at 320x240), outside the Context: one recorder is
    for one simulation at a time.
    """

    def __init__(self, width: int, height: int, fps: float):
        """Declares the ports, for images of `width` x `height` px at `fps` in simulated time."""
        super().__init__()
        self._fps = fps
        self._frame = np.dtype(
            [("rgb", np.uint8, (height, width, 3)), ("depth", np.uint16, (height, width))]
        )
        self._file, self._count = tempfile.TemporaryFile(buffering=0), 0
        self.DeclareAbstractInputPort("color_image", Value(ImageRgba8U(width, height)))
        self.DeclareAbstractInputPort("depth_image_16u", Value(ImageDepth16U(width, height)))
        self.DeclareInitializationPublishEvent(self._clear)
        self.DeclarePeriodicPublishEvent(1 / fps, 0.0, self._record)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder, camera: SplatCamera, fps: float, *, name: str = ""
    ) -> "VideoRecorder":
        """Adds a recorder of a camera, named `video`, or `NAME_video` of another than `camera`."""
        info = camera.camera_info()
        recorder = VideoRecorder(info.width(), info.height(), fps)
        default = "video" if camera.get_name() == "camera" else f"{camera.get_name()}_video"
        builder.AddNamedSystem(name or default, recorder)
        for port in ("color_image", "depth_image_16u"):
            builder.Connect(camera.GetOutputPort(port), recorder.GetInputPort(port))
        return recorder

    def _clear(self, context: Context) -> EventStatus:
        self._file.seek(0)
        self._file.truncate()
        self._count = 0
        return EventStatus.Succeeded()

    def _record(self, context: Context) -> EventStatus:
        color = cast(ImageRgba8U, self.GetInputPort("color_image").Eval(context))
        depth = cast(ImageDepth16U, self.GetInputPort("depth_image_16u").Eval(context))
        frame = np.empty((), self._frame)
        frame["rgb"] = np.asarray(color.data)[..., :3]
        frame["depth"] = np.asarray(depth.data)[..., 0]
        try:
            self._file.write(frame.tobytes())
        except OSError as error:
            raise OSError(
                f"cannot record images in {tempfile.gettempdir()} ({error.strerror}); make room, "
                "name another folder by TMPDIR, or record fewer and smaller ones (camera.fps, "
                "camera.width)"
            ) from None
        self._count += 1
        return EventStatus.Succeeded()

    def frames(self, max_depth: float) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.uint8]]]:
        """Yields the images of color and of depth, see `colorize_depth`, (H, W, 3) each in OpenCV's
        channel order."""
        size = self._frame.itemsize
        for k in range(self._count):
            frame = np.frombuffer(os.pread(self._file.fileno(), size, k * size), self._frame)[0]
            depth = np.where(frame["depth"] < TOO_FAR, frame["depth"] * 1e-3, np.inf)
            yield frame["rgb"][..., ::-1], colorize_depth(depth, max_depth)

    def save(self, path: str | Path, max_depth: float) -> None:
        """Writes the video (H.264 in MP4) atomically; `max_depth` as in `frames`."""
        height, width = self._frame["depth"].shape
        odd = height % 2  # Players need even sizes.
        with (
            written_atomically(path, self._check) as partial,
            av.open(str(partial), "w") as container,
        ):
            rate = Fraction(self._fps).limit_denominator(1000)
            stream = container.add_stream("libx264", rate, {"preset": "ultrafast", "crf": "20"})
            stream.width, stream.height, stream.pix_fmt = 2 * width, height + odd, "yuv420p"
            for pictures in self.frames(max_depth):
                picture = np.pad(np.hstack(pictures), ((0, odd), (0, 0), (0, 0)))
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "bgr24")))
            container.mux(stream.encode())

    def _check(self, path: Path) -> None:
        """Raises OSError if a video is incomplete: its writer ignores full disks."""
        with av.open(str(path)) as container:
            found = sum(packet.size > 0 for packet in container.demux(video=0))
        if found != self._count:
            raise OSError(f"only {found} of {self._count} images are written")


def colorize_depth(depth: np.ndarray, max_depth: float) -> np.ndarray:
    """Converts depth (H, W) [m] to an image (H, W, 3) uint8 in OpenCV's channel order.

    Near is bright and far dark, in inverse depth from 0.5 m to `max_depth`; out of range is black.
    """
    inverse = 1.0 / np.clip(depth, 0.5, max_depth)
    shade = (inverse - 1.0 / max_depth) / (2.0 - 1.0 / max_depth)
    picture = cv2.applyColorMap((np.sqrt(shade) * 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
    picture[(depth <= 0) | (depth > max_depth)] = 0
    return picture
