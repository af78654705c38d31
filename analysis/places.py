"""The places of the photorealistic scenarios, made from captures, meshes and generated worlds."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from splatpilot.analysis.tour import TourConfig, make_scene
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.files import DATA
from splatpilot.systems.common.validation import unknown
from splatpilot.training.captures import render as render_capture
from splatpilot.training.captures.render import RenderConfig
from splatpilot.training.reconstruction.config import ReconstructConfig


@dataclass
class PlaceConfig:
    """How a scene to test in is made: rendered, unless it was captured, and reconstructed, as on a
    tour."""

    render: RenderConfig = field(default_factory=lambda: replace(TourConfig().render, split="test"))
    reconstruct: ReconstructConfig = field(
        default_factory=lambda: replace(TourConfig().reconstruct, split="test")
    )


@dataclass(frozen=True)
class Place:
    """What a scene is made of, and how."""

    source: str  # a capture or a mesh, below the folder of data, or a scenario
    settings: tuple[str, ...] = ()  # of `PlaceConfig`, as --set takes them


PLACES = {
    "hospital": Place(
        "tartanair/hospital",
        ("reconstruct.voxel_size=0.05",),
    ),
    "bookstore": Place(
        "worlds/bookstore.gltf", ("render.up=z", "reconstruct.initial_gaussians=160000")
    ),
    # Halls and buildings: colours push Gaussians about in steps that grow with the cameras' extent,
    # and those that start from exact depth have hardly to move.
    "warehouse": Place(
        "worlds/warehouse.gltf",
        (
            "render.up=z",
            "reconstruct.initial_gaussians=430000",
            "reconstruct.means_rate=4e-5",
        ),
    ),
    "hospital_building": Place(
        "worlds/hospital_building.gltf",
        (
            "render.up=z",
            "render.highest=2.0",
            "render.apart=6",
            "render.spacing=1.4",
            "reconstruct.initial_gaussians=1000000",
            "reconstruct.iterations=10000",
            "reconstruct.means_rate=4e-5",
        ),
    ),
    "forest_splat": Place("P02"),
    "alley_splat": Place("P09"),
}
"""The scenes that scenarios fly in, by name."""

BENCHMARK_PLACES = tuple(name for name in PLACES if name != "alley_splat")


def run(
    *, names: Sequence[str], data: Path | None, scenes: Path, overrides: Sequence[str] = ()
) -> None:
    """Makes the scene folders `scenes/NAME`, one after the other.

    What is rendered is kept in `scenes/captures/NAME`. What is there from a run before is used
    again: run after an interruption, it goes on, and ends in the same scenes.

    Args:
        names: of `PLACES`; the benchmark's if empty.
        data: folder of captures and meshes; None will do for generated worlds.
        scenes: where scenarios look for scenes.
        overrides: FIELD=VALUE of `PlaceConfig`, for all of them.

    Raises:
        ValueError: if a name or a setting is unknown, or data are needed and None is given.
        FileNotFoundError, ValueError, OSError: see `render_capture.run` and `tour.make_scene`.
    """
    names = list(names) or list(BENCHMARK_PLACES)
    for name in names:
        if name not in PLACES:
            raise ValueError(unknown("place", name, PLACES))
    sources = [_source(PLACES[name], data) for name in names]
    configs = [
        load_config(PlaceConfig(), overrides=[*PLACES[name].settings, *overrides]) for name in names
    ]
    for name, source, config in zip(names, sources, configs, strict=True):
        print(f"== {name}, from {source}", flush=True)
        if isinstance(source, Path) and source.is_dir():
            capture = source
        else:
            capture = scenes / "captures" / name
            render_capture.run(world=source, out=capture, config=config.render)
        make_scene(capture, scenes / name, config.reconstruct)


def _source(place: Place, data: Path | None) -> str | Path:
    """A scenario's name, or the path of a capture or a mesh, which is there."""
    if "/" not in place.source:
        return place.source
    if data is None:
        raise ValueError(
            f"{place.source} is needed; name the folder that holds it with --data or the "
            f"environment variable {DATA}"
        )
    path = data / place.source
    if not path.exists():
        raise FileNotFoundError(f"{path}: does not exist; a place is made of it")
    return path
