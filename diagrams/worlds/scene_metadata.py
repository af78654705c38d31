"""What `scene.yaml` says of a scene folder: where the scene comes from and how it is to be used."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed

from splatpilot.diagrams.worlds.splits import check_split
from splatpilot.systems.array_files import reason_of
from splatpilot.systems.configuration import yaml_problem
from splatpilot.systems.files import written_atomically
from splatpilot.systems.read_limit import read_text, require_shallow

FORMAT_VERSION = 2
ENVIRONMENT = "environment.png"
FRONTIER = "frontier.ply"
WORLD_FRAME = "z up"
REPRESENTATIONS = ("3dgs", "2dgs")


@dataclass(kw_only=True)
class SceneMetadata:
    """The content of `scene.yaml`. Fields that a file lacks have the defaults given here, except
    for the vectors, which it must give."""

    format_version: int = FORMAT_VERSION
    name: str = ""
    provenance: str = ""
    """What the scene was made from, and how."""
    split: str = ""
    """What the scene is for: "train", "validation" or "test"; empty if unknown."""
    source_digest: list[str] = field(default_factory=list)
    """Digest of what the scene was made from, see `splits.source_digest`: of the images that it was
    fitted to, or of the mesh or generated world that they were rendered of. Empty if unknown."""
    world_frame: str = WORLD_FRAME
    metric: bool = True
    """Whether the unit of length is the metre."""
    origin: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """[m], position of the scene's origin in the world of the capture's files, upright and in
    meters; all positions of the scene are relative to it."""
    lower_W: list[float] = field(default_factory=list)
    """[m], lower corner of the distance field."""
    upper_W: list[float] = field(default_factory=list)
    """[m], upper corner of the distance field."""
    observed_free_volume: float = 0.0
    """[m^3], space seen to be free."""
    gains: list[float] = field(default_factory=list)
    """Brightness of each image of the capture relative to the scene, in frame order."""
    vignetting: float = 0.0
    """Logarithm of the brightness of the capture's image corners relative to their centres; it
    falls with the square of the distance from the centre. The scene is free of it."""
    background: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Colour where no Gaussian is seen; red, green, blue in 0 to 1."""
    environment: bool = False
    """Whether `environment.png` has that colour for each direction; `background` is their mean."""
    frontier: bool = False
    """Whether `frontier.ply` stands where the distance field has obstacles that nobody saw."""
    p_WS: list[float] = field(default_factory=list)
    """[m], default start."""
    p_WG: list[float] = field(default_factory=list)
    """[m], default goal."""
    representation: str = "3dgs"
    """"3dgs": Gaussians; "2dgs": surfels, kept as Gaussians that are as flat as allowed."""
    capture: str = ""
    """Folder of the capture that the scene was made from; empty if unknown."""
    capture_settings: list[str] = field(default_factory=list)
    """What was set about the capture when it was read, "depth_unit=5000.0" for example; without it
    the folder would be read otherwise."""
    capture_notes: list[str] = field(default_factory=list)
    """What was assumed or not used when the capture was read, and where intrinsics come from."""
    held_out: list[int] = field(default_factory=list)
    """Frames of the capture that had no part in making the scene."""
    image_width: int = 0
    """[px], to which images were scaled down for the making; 0 if they were not."""
    perturbation_bound: float | None = None
    """[m], how far from the poses of the capture images of the scene can be trusted, as
    `splatpilot fidelity` measured it; None before."""
    pose_perturbation_bounds: list[float] = field(default_factory=list)
    """[m], the same for each pose of the capture, in frame order; empty before."""


def read_scene_metadata(path: str | Path) -> SceneMetadata:
    """Reads `scene.yaml` of the scene folder `path`.

    Raises:
        ValueError: for unknown or missing fields, values of the wrong kind, vectors that have not
            three finite components and a format version that is not known.
    """
    file = Path(path) / "scene.yaml"
    text = read_text(file)
    require_shallow(text, str(file))
    try:
        metadata = yaml_load_typed(schema=SceneMetadata, data=text)
    except Exception as error:  # Drake's reader raises anything of values of other types
        wrong = yaml_problem(error) if isinstance(error, yaml.YAMLError) else reason_of(error)
        raise ValueError(f"{file}: {wrong}; reconstruct the scene again or repair it") from None
    if metadata.format_version < FORMAT_VERSION:
        raise ValueError(
            f"{file}: format version {metadata.format_version}, from when scenes had no background "
            "of their own and translucent surfaces; reconstruct the scene again"
        )
    if metadata.format_version > FORMAT_VERSION:
        raise ValueError(
            f"{file}: format version {metadata.format_version}, this program knows "
            f"{FORMAT_VERSION}; use the version of the program that wrote the scene"
        )
    for name in ("origin", "lower_W", "upper_W", "background", "p_WS", "p_WG"):
        value = getattr(metadata, name)
        if len(value) != 3 or not np.isfinite(value).all():
            raise ValueError(f"{file}: {name} is {value}, three finite numbers are needed")
    if metadata.world_frame != WORLD_FRAME:
        raise ValueError(
            f"{file}: world_frame is {metadata.world_frame!r}, it must be {WORLD_FRAME!r}; "
            "turn the scene and reconstruct it again"
        )
    if not all(0 <= value <= 1 for value in metadata.background):
        raise ValueError(f"{file}: background is {metadata.background}, 0 to 1 is needed")
    if metadata.representation not in REPRESENTATIONS:
        raise ValueError(
            f"{file}: representation is {metadata.representation!r}, it must be one of "
            f"{REPRESENTATIONS}"
        )
    if metadata.image_width < 0 or any(frame < 0 for frame in metadata.held_out):
        raise ValueError(
            f"{file}: image_width is {metadata.image_width} and held_out {metadata.held_out}; "
            "neither may be negative"
        )
    try:
        check_split(metadata.split)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    bounds = np.array([metadata.perturbation_bound or 0.0, *metadata.pose_perturbation_bounds])
    if not (np.isfinite(bounds) & (bounds >= 0)).all():
        raise ValueError(
            f"{file}: perturbation_bound is {metadata.perturbation_bound} and "
            f"pose_perturbation_bounds {metadata.pose_perturbation_bounds}; finite lengths [m] of "
            "at least 0 are needed, run `splatpilot fidelity` again"
        )
    return metadata


def write_scene_metadata(path: str | Path, metadata: SceneMetadata) -> None:
    """Replaces `scene.yaml` of the scene folder `path`, whole or not at all.

    Raises:
        OSError: if it cannot be written.
    """
    with written_atomically(Path(path) / "scene.yaml") as partial:
        yaml_dump_typed(metadata, filename=str(partial))
