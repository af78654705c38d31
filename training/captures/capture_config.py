"""Configuration of captures, and the cache of computed results."""

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path

from splatpilot.systems.common import files
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.validation import (
    Config,
    bounded,
    errors_about,
    require,
    require_field,
)

_UPS = ("x", "y", "z", "-x", "-y", "-z", "cameras", "ground")
CONFIG_FILE = "capture.yaml"
"""Name of the file in a capture's folder that may hold its `CaptureConfig`."""


@dataclass(kw_only=True)
class ScaleConfig(Config):
    """Metric scale of a capture that was registered from images alone; at most one source."""

    factor: float = bounded(0.0, "[0, inf) m")
    """[m] Length of one unit in the files; 1 if they are in meters."""
    between: list[str] = field(default_factory=list)
    """Two things `distance` apart: each an image, for its camera ("a.jpg"), or a pixel of an image,
    for the point seen there ("a.jpg@812,344")."""
    distance: float = bounded(0.0, "[0, inf) m")
    """[m] between them."""
    camera_height: float = bounded(0.0, "[0, inf) m")
    """[m], median height of the cameras above the ground, a plane fitted to the points."""
    depth_folder: str = ""
    """Folder, inside the capture or absolute, with the depth of some images: `a.npy` [m] or `a.png`
    (16 bits, `depth_unit` per meter) for `a.jpg`, in the same pixels."""

    def check(self) -> None:
        require(
            len(self.between) == (2 if self.distance else 0),
            "scale.between and scale.distance",
            "two images or pixels and the meters between them",
            f"{self.between} and {self.distance}",
        )
        sources = self.sources()
        require(len(sources) < 2, "scale", "given once", " and ".join(sources), "keep one of them")

    def sources(self) -> list[str]:
        """Returns the names of the fields that give a scale."""
        names = ("factor", "distance", "camera_height", "depth_folder")
        return [f"scale.{name}" for name in names if getattr(self, name)]


@dataclass(kw_only=True)
class CaptureConfig(Config):
    """Settings of a capture; empty and zero fields take the format's defaults."""

    kind: str = ""
    """Capture format: a name in `splatpilot.training.captures.capture_registry.CAPTURES`, or
    `module:attribute` of a `CaptureFormat`; empty: recognized by the files."""
    intrinsics: list[float] = bounded(list, "(-inf, inf) px")
    """fx, fy, cx, cy [px] of the color camera, which the registration of photographs keeps. The
    distortion stays that of the files."""
    depth_intrinsics: list[float] = bounded(list, "(-inf, inf) px")
    """fx, fy, cx, cy [px] of a depth camera other than the color camera."""
    p_DC: list[float] = bounded(list, "(-inf, inf) m")
    """[m], position of the color camera in the depth camera's axes, which are parallel."""
    depth_unit: float = bounded(0.0, "[0, inf) per m")
    """Units of the stored depth per meter: 1000 for millimeters."""
    up: str = ""
    """Up direction: x, y, z, -x, -y or -z of the files' world; `cameras`: level images on average;
    `ground`: normal of the largest plane below the cameras."""
    scale: ScaleConfig = field(default_factory=ScaleConfig)
    """Metric scale where images alone were registered."""
    origin: list[float] = bounded(list, "(-inf, inf) m")
    """[m] Origin of the capture in the world of its files, once upright and in meters; empty: the
    middle of the cameras if they are farther than 1 km from the files' origin, else that."""
    topics: list[str] = field(default_factory=list)
    """Topics of color, depth and poses, in this order, of a ROS bag that has several."""
    refine_poses: bool = False
    """Moves poses to where depth and brightness of all frames agree, which removes the drift of
    phones and odometry; leave exact poses as they are."""
    partners: int = bounded(0, "[0, inf)")
    """Number of photographs that each is matched with: half of them its neighbors by name, half the
    most similar; 0: all, or 20 of more than 60 photographs."""
    video_rate: float = bounded(2.0, "(0, 100] Hz")
    """[Hz] Rate at which frames of a video are taken, the sharpest of each interval."""
    cache: str = ""
    """Folder that keeps registered photographs and refined poses; empty: one in the user's cache,
    `$XDG_CACHE_HOME` or `~/.cache`."""

    def check(self) -> None:
        for name, size in (("intrinsics", 4), ("depth_intrinsics", 4), ("p_DC", 3), ("origin", 3)):
            values = getattr(self, name)
            require_field(self, name, len(values) in (0, size), f"{size} numbers")
            if size == 4 and values:
                require_field(self, name, min(values[:2]) > 0, "of focal lengths > 0")
        require_field(self, "up", self.up in ("", *_UPS), f"one of {', '.join(_UPS)}")
        valid = len(self.topics) in (0, 3)
        require_field(self, "topics", valid, "three names, of color, depth and poses")

    def settings(self) -> list[str]:
        """Returns the fields other than the defaults, as `--set` takes them: "depth_unit=5.0"."""
        default = CaptureConfig()
        return [
            f"{prefix}{each.name}={json.dumps(value)}"
            for prefix, part, usual in (("", self, default), ("scale.", self.scale, default.scale))
            for each in fields(usual)
            if each.name != "scale"
            and (value := getattr(part, each.name)) != getattr(usual, each.name)
        ]


def complete_config(path: Path, config: CaptureConfig) -> CaptureConfig:
    """Returns `config`, its open fields taken from the capture's own `capture.yaml`."""
    file = path / CONFIG_FILE
    completed = CaptureConfig()
    if file.is_file():
        completed = load_config(completed, file)
        with errors_about(file):
            completed.validate()
    completed = load_config(completed, overrides=config.settings())
    completed.validate()
    return completed


def cache_folder(config: CaptureConfig, *parts: str) -> Path:
    """Returns a folder in `config.cache` or, without it, in the user's cache."""
    return Path(config.cache, *parts) if config.cache else files.cache_folder(*parts)


def cache_key(paths: Iterable[Path], *others: object) -> str:
    """Returns a key of files, by their paths, sizes and times, and of all else that decides."""
    key = hashlib.sha256(repr(others).encode())
    for path in paths:
        status = path.stat()
        key.update(f"{path.resolve()} {status.st_size} {status.st_mtime_ns}".encode())
    return key.hexdigest()[:16]


def cached_folder(folder: Path, write: Callable[[Path], None]) -> Path:
    """Returns a folder of the cache, written atomically by `write` if it is missing."""
    if not folder.is_dir():
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OSError(
                f"{folder.parent}: cannot be written ({error.strerror}); set capture.cache to "
                "another folder"
            ) from None
        files.remove_leftovers(folder.parent)
        with files.folder_written_atomically(folder) as written:
            write(written)
    return folder
