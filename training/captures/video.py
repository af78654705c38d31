"""Videos: of each short interval the sharpest frame, registered as photographs are."""

from pathlib import Path

import cv2
from numpy.typing import NDArray

from splatpilot.systems.files import folder_written_atomically
from splatpilot.systems.progress import Progress
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_cache import cache_folder, cache_key, prepare_cache
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.photographs import read_photographs

_SUFFIXES = {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm"}
_FEWEST = 3
_SHARPNESS_WIDTH = 480
"""[px], at which frames are compared."""
_QUALITY = 97


def is_video(path: Path) -> bool:
    """Tells whether a path is a video, by its suffix."""
    return path.is_file() and path.suffix.lower() in _SUFFIXES


def read_video(path: Path, config: CaptureConfig) -> Capture:
    """Opens a video as photographs, see `read_photographs`. Its frames are kept in the cache.

    Raises:
        ValueError: if it cannot be read or is too short, and see `read_photographs`.
        OSError: if the cache cannot be written.
    """
    frames = cache_folder(config, "videos", cache_key([path], config.video_rate)) / "frames"
    if not frames.is_dir():
        prepare_cache(frames.parent)
        with folder_written_atomically(frames) as written:
            _extract(path, config.video_rate, written)
    return read_photographs(frames, config)


def _extract(path: Path, rate: float, folder: Path) -> None:
    """Writes the sharpest frame of each 1 / `rate` [s] as `00000.jpg` and so on."""
    video = cv2.VideoCapture(str(path))
    try:
        fps = video.get(cv2.CAP_PROP_FPS)
        if not video.isOpened() or not 0 < fps < 10_000:
            raise ValueError(f"{path}: not a readable video; convert it to H.264 in MP4")
        best: NDArray | None = None
        sharpest, interval, index = -1.0, 0, 0
        total = max(int(video.get(cv2.CAP_PROP_FRAME_COUNT)), 0) or None
        with Progress(total=total, desc="video", unit="frame") as progress:
            while True:
                there, frame = video.read()
                if best is not None and (not there or int(index * rate / fps) > interval):
                    file = folder / f"{interval:05d}.jpg"
                    cv2.imwrite(str(file), best, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
                    best, sharpest = None, -1.0
                if not there:
                    break
                interval = int(index * rate / fps)
                if (sharpness := _sharpness(frame)) > sharpest:
                    best, sharpest = frame, sharpness
                index += 1
                progress.update()
    finally:
        video.release()
    if (count := len(list(folder.iterdir()))) < _FEWEST:
        raise ValueError(
            f"{path}: {index} frames in {index / fps:.1f} s give {count} of {rate:g} a second, at "
            f"least {_FEWEST} are needed; film longer, or set capture.video_rate to more"
        )


def _sharpness(frame: NDArray) -> float:
    """The variance of the Laplacian of a frame in small."""
    width = min(_SHARPNESS_WIDTH, frame.shape[1])
    size = width, max(1, frame.shape[0] * width // frame.shape[1])
    small = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), size, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_32F).var())
