"""The places of the photorealistic scenarios, made from captures, meshes and generated worlds."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from splatpilot.analysis.tour import TourConfig, make_scene
from splatpilot.training.captures import render_capture
from splatpilot.training.reconstruction.config import ReconstructConfig

DATA = "SPLATPILOT_DATA"
"""Environment variable that names the folder of captures and meshes."""


@dataclass(frozen=True)
class Place:
    """What a scene is made of: a capture or a mesh, below the folder of data, or a scenario."""

    source: str
    apart: float = 4.0  # [m] between visited places, of what is rendered
    heights: tuple[float, float] = (1.0, 2.2)  # [m] of the camera, of what is rendered
    seed: int = 0  # of a scenario


PLACES = {
    "hospital": Place("tartanair/hospital"),
    "bookstore": Place("worlds/bookstore.gltf", apart=3.0),
    "warehouse": Place("worlds/warehouse.gltf"),
    "hospital_building": Place("worlds/hospital_building.gltf", apart=3.0, heights=(1.0, 2.0)),
    "forest_splat": Place("P02"),
    "alley_splat": Place("P09"),
}
"""The scenes that scenarios fly in, by name."""

BENCHMARK_PLACES = tuple(name for name in PLACES if name != "alley_splat")


@dataclass
class PlacesConfig:
    """How scenes are made."""

    tour: TourConfig = field(default_factory=TourConfig)  # of what is rendered
    captured: ReconstructConfig = field(default_factory=ReconstructConfig)  # of captures


def run(*, names: Sequence[str], data: Path | None, scenes: Path, config: PlacesConfig) -> None:
    """Makes the scene folders `scenes/NAME`, one after the other.

    What is rendered is kept in `scenes/captures/NAME`. What is there from a run before is used
    again: run after an interruption, it goes on, and ends in the same scenes.

    Args:
        names: of `PLACES`; the benchmark's if empty.
        data: folder of captures and meshes; None will do for generated worlds.
        scenes: where scenes are looked for by scenarios.
        config: how.

    Raises:
        ValueError: if a name is unknown, or data are needed and None is given.
        FileNotFoundError, ValueError, OSError: see `render_capture.run` and `tour.make_scene`.
    """
    names = list(names) or list(BENCHMARK_PLACES)
    for name in names:
        if name not in PLACES:
            raise ValueError(f"there is no place {name!r}; there are {', '.join(PLACES)}")
    sources = {name: _source(PLACES[name], data) for name in names}
    for name, source in sources.items():
        print(f"== {name}, from {source}")
        place, scene = PLACES[name], scenes / name
        if isinstance(source, Path) and source.is_dir():
            make_scene(source, scene, config.captured)
            continue
        render = config.tour.render
        render.up, render.apart = "z", place.apart
        render.lowest, render.highest = place.heights
        capture = scenes / "captures" / name
        render_capture.run(world=source, out=capture, config=render, seed=place.seed)
        make_scene(capture, scene, config.tour.reconstruct)


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
