"""Where policies train: in generated worlds of the benchmark's kinds, of seeds it never uses, and
in scenes that it does not test in."""

from collections.abc import Collection
from pathlib import Path

from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.scenario_files import benchmark_scenarios, scenario_file
from splatpilot.diagrams.worlds.make_world import WorldConfig, is_procedural
from splatpilot.diagrams.worlds.octomap_world import OCTOMAP
from splatpilot.diagrams.worlds.scene import SceneConfig, SceneSource, find_scene
from splatpilot.diagrams.worlds.scene_metadata import read_scene_metadata
from splatpilot.diagrams.worlds.splits import find_test_source, part_digests
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


def place_to_learn_in(scene: str, split: str = "train") -> Path:
    """Finds a scene that may be learned from: a scene folder, or an OctoMap.

    Args:
        scene: path of it.
        split: that it must be of; an OctoMap states none and counts as "train".

    Raises:
        FileNotFoundError: if there is no such scene.
        ValueError: if it is neither, shows what the benchmark tests in, whatever it is called, or
            is of another split.
    """
    place = find_scene(SceneConfig(path=scene))
    if place.suffix.lower() == OCTOMAP:
        require_untested(part_digests([place.read_bytes()]), str(place))
        return place
    if not place.is_dir():
        raise ValueError(f"{place} is no scene folder; `splatpilot reconstruct` makes one")
    metadata = read_scene_metadata(place)
    require_untested(metadata.source_digest, str(place))
    if metadata.split != split:
        raise ValueError(
            f"split of {place} must be {split}, got {metadata.split!r}; use another scene, or "
            f"reconstruct one with --set split={split}"
        )
    return place


def require_untested(digests: Collection[str], what: str) -> None:
    """
    Raises:
        ValueError: if the benchmark tests in a source with these digests of its parts, by the
            committed table or as a test scene on this machine; or if there are none.
    """
    if not digests:
        raise ValueError(
            f"{what} is missing source_digest, which tells what it shows; reconstruct the scene "
            "again"
        )
    name = find_test_source(digests)
    for file in () if name else benchmark_scenarios().values():
        world = load_config(Scenario(), file).world
        if not isinstance(world, SceneSource):
            continue
        try:
            scene = read_scene_metadata(find_scene(world))
        except (OSError, ValueError):  # a scene that is not there, or cannot be flown in
            continue
        if scene.split == "test" and not set(scene.source_digest).isdisjoint(digests):
            name = world.path
    if name:
        raise ValueError(
            f"{what} shows {name}, in which the benchmark tests, so nothing may be learned from "
            "it; use another"
        )
