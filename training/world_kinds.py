"""Where policies train: in generated worlds of the benchmark's kinds, of seeds it never uses, and
in captured places that it does not fly in."""

from pathlib import Path

from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.scenario_files import benchmark_scenarios, scenario_file
from splatpilot.diagrams.worlds.make_world import WorldConfig, is_procedural
from splatpilot.diagrams.worlds.octomap_world import OCTOMAP
from splatpilot.diagrams.worlds.scene import SceneConfig, SceneSource, find_scene
from splatpilot.diagrams.worlds.scene_metadata import read_scene_metadata
from splatpilot.systems.configuration import load_config

PROCEDURAL = tuple(name for name in benchmark_scenarios() if name.startswith("P"))
"""The scenarios whose worlds are made from seeds."""

ROUNDABOUT = ("P06", "P07", "P08", "P09", "P10", "P12")
"""Those of them whose ways are far from straight: learned slowest, so trained in twice as often."""


def world_of(kind: str) -> WorldConfig:
    """The configuration of the world of a scenario: the benchmark's, or a file.

    Raises:
        FileNotFoundError, ValueError: if there is no such scenario.
    """
    return load_config(Scenario(), scenario_file(kind)).world


def check_generated(kind: str) -> None:
    """Raises ValueError unless the world of a scenario is generated; FileNotFoundError, ValueError
    if there is no such scenario."""
    if not is_procedural(world_of(kind)):
        raise ValueError(
            f"worlds.kinds has {kind}, whose world is not generated; choose kinds from "
            f"{', '.join(PROCEDURAL)} and files, and put captured places into worlds.scenes"
        )


def place_to_learn_in(scene: str) -> Path:
    """Where a captured place is: a scene folder, or an OctoMap.

    Raises:
        FileNotFoundError: if there is no such place.
        ValueError: if it is neither, or the benchmark flies there.
    """
    place = find_scene(SceneConfig(path=scene))
    if place.suffix.lower() == OCTOMAP:
        return place
    if not place.is_dir():
        raise ValueError(f"{place} is no scene folder; `splatpilot reconstruct` makes one")
    worlds = [load_config(Scenario(), file).world for file in benchmark_scenarios().values()]
    flown = {Path(world.path).name for world in worlds if isinstance(world, SceneSource)}
    flown &= {place.name, read_scene_metadata(place).name}
    if flown:
        raise ValueError(
            f"{place}: the benchmark flies in {min(flown)}, so nothing may be learned there; "
            "leave it out of worlds.scenes"
        )
    return place
