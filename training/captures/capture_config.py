"""What a capture's files leave open."""

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from splatpilot.systems.common.config import load_config

CONFIG_FILE = "capture.yaml"
"""Name of the file in a capture's folder that may hold its `CaptureConfig`."""

UP_AXES = {sign + axis for sign in ("", "-") for axis in "xyz"}


@dataclass(kw_only=True)
class ScaleConfig:
    """Where metres come from when a capture has been registered from images alone; at most one."""

    factor: float = 0.0
    """[m] that one unit of length in the files is; 1 says that they are in metres."""
    between: list[str] = field(default_factory=list)
    """Two things `distance` apart: each an image, standing for its camera ("a.jpg"), or a pixel of
    an image, standing for the point seen there ("a.jpg@812,344")."""
    distance: float = 0.0
    """[m] between them."""
    camera_height: float = 0.0
    """[m], median height of the cameras above the ground, a plane fitted to the points."""
    depth_folder: str = ""
    """Folder, inside the capture or absolute, with the depth of some images: `a.npy` [m] or `a.png`
    (16 bits, `depth_unit` a metre) for `a.jpg`, in the same pixels."""

    def validate(self) -> None:
        """Raises ValueError for values that make no sense or more than one source of scale."""
        if bool(self.between) != (self.distance != 0):
            raise ValueError(
                "scale.between and scale.distance belong together: two images or pixels and the "
                "metres between them"
            )
        if self.between and len(self.between) != 2:
            raise ValueError(f"scale.between names {len(self.between)} things, 2 are needed")
        for name in ("factor", "distance", "camera_height"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(
                    f"scale.{name} is {getattr(self, name)}; more than 0 and finite is needed"
                )
        if len(given := self.given()) > 1:
            raise ValueError(
                f"scale is given {len(given)} times, by {' and '.join(given)}; keep one of them"
            )

    def given(self) -> list[str]:
        """The names of the fields that give a scale."""
        names = ("factor", "distance", "camera_height", "depth_folder")
        return [f"scale.{name}" for name in names if getattr(self, name)]


@dataclass(kw_only=True)
class CaptureConfig:
    """What a capture's files leave open; empty and zero fields take what its kind usually has."""

    kind: str = ""
    """A name in `splatpilot.training.captures.capture_registry.CAPTURES`, or `module:attribute` of
    a
    `CaptureKind`; empty: told from the files."""
    intrinsics: list[float] = field(default_factory=list)
    """fx, fy, cx, cy [px] of the colour camera."""
    depth_intrinsics: list[float] = field(default_factory=list)
    """fx, fy, cx, cy [px] of a depth camera that is not the colour camera."""
    p_DC: list[float] = field(default_factory=list)
    """[m], position of the colour camera in the depth camera's axes, which are parallel."""
    depth_unit: float = 0.0
    """How many units of the stored depth make a metre: 1000 for millimetres."""
    up: str = ""
    """Which way is up: x, y, z, -x, -y or -z of the files' world; `cameras`: where the cameras'
    images are level on average; `ground`: across the largest plane below the cameras."""
    scale: ScaleConfig = field(default_factory=ScaleConfig)
    """Where metres come from when images alone were registered."""
    origin: list[float] = field(default_factory=list)
    """[m] Where the origin of the capture is in the world of its files, once that is upright and in
    meters; empty: in the middle of cameras that are farther than 1 km from theirs, and there of
    others."""
    topics: list[str] = field(default_factory=list)
    """Topics of a ROS bag that has several of a kind: of colour, depth and poses, in this order."""
    refine_poses: bool = False
    """Moves poses to where depth and brightness of all frames agree, which mends the drift of
    trackers: of phones, of odometry; exact poses are best left as they are."""
    partners: int = 0
    """With how many others a photograph is compared: half of them next to it by name, half those
    that look most alike; 0: with all, of more than 60 photographs with 20."""
    video_rate: float = 2.0
    """[Hz] Of each so long part of a video the sharpest frame is taken."""
    cache: str = ""
    """Folder that keeps the registration of photographs and refined poses, which take minutes;
    empty: a folder of their own in the user's cache, `$XDG_CACHE_HOME` or `~/.cache`."""

    def validate(self) -> None:
        """Raises ValueError for values that make no sense."""
        for name, size in (("intrinsics", 4), ("depth_intrinsics", 4), ("p_DC", 3), ("origin", 3)):
            values = getattr(self, name)
            if values and (len(values) != size or not np.isfinite(values).all()):
                raise ValueError(f"capture.{name} is {values}; {size} finite numbers are needed")
            if size == 4 and values and min(values[:2]) <= 0:
                raise ValueError(f"capture.{name} is {values}; focal lengths must be positive")
        if not 0 <= self.depth_unit < np.inf:
            raise ValueError(
                f"capture.depth_unit is {self.depth_unit}; units a metre, more than 0, are needed"
            )
        if self.up and self.up not in UP_AXES | {"cameras", "ground"}:
            raise ValueError(
                f"capture.up is {self.up!r}; known are x, y, z, -x, -y, -z, cameras and ground"
            )
        if self.topics and len(self.topics) != 3:
            raise ValueError(
                f"capture.topics is {self.topics}; three names are needed, of colour, depth and "
                "poses, `/tf` being one of poses"
            )
        if self.partners < 0:
            raise ValueError(f"capture.partners is {self.partners}; it must be at least 0")
        if not 0 < self.video_rate <= 100:
            raise ValueError(
                f"capture.video_rate is {self.video_rate}; more than 0 and at most 100 Hz is needed"
            )
        self.scale.validate()

    def settings(self) -> list[str]:
        """Returns the fields that are not as they are by default, as `--set` takes them:
        "depth_unit=5000.0", "scale.camera_height=1.6"."""
        return [
            f"{prefix}{name}={json.dumps(getattr(own, name))}"
            for prefix, own, default in (
                ("", self, CaptureConfig()),
                ("scale.", self.scale, ScaleConfig()),
            )
            for name in (each.name for each in dataclasses.fields(default))
            if name != "scale" and getattr(own, name) != getattr(default, name)
        ]


def complete_config(path: Path, config: CaptureConfig | None) -> CaptureConfig:
    """Returns `config` with what it leaves open taken from the capture's own `capture.yaml`.

    Raises:
        ValueError: if either makes no sense.
    """
    file = path / CONFIG_FILE
    completed = CaptureConfig()
    if file.is_file():
        completed = load_config(completed, file)
        try:
            completed.validate()
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None
    for other, default, merged in (
        (config, CaptureConfig(), completed),
        (config and config.scale, ScaleConfig(), completed.scale),
    ):
        for name in (each.name for each in dataclasses.fields(default)):
            if other and name != "scale" and getattr(other, name) != getattr(default, name):
                setattr(merged, name, getattr(other, name))
    completed.validate()
    return completed
