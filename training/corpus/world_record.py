"""A world that a corpus was gathered in: what it takes to make it again, and its distances."""

from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from pathlib import Path

import numpy as np

from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.make_world import WORLDS, WorldConfig, make_world
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.configuration import dump_config, load_config, open_field
from splatpilot.systems.files import folder_written_atomically

_ABOUT, _ESDF = "world.yaml", "esdf.npz"


@dataclass
class WorldSource:
    """What makes a world."""

    name: str = ""
    world: WorldConfig = open_field(WORLDS, ForestConfig)
    seed: int = 0
    # [m] How far from recorded poses its images can be trusted; infinite where they are exact.
    perturbation_bound: float = inf
    # Of a scene, that of `scene.yaml`; empty for generated worlds.
    source_digest: list[str] = field(default_factory=list)


class WorldRecord:
    """The folder of a world in a corpus.

    Raises:
        FileNotFoundError, ValueError: if there is none, or a damaged one.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.source = load_config(WorldSource(), path / _ABOUT)
        if not (path / _ESDF).is_file():
            raise FileNotFoundError(f"{path / _ESDF}: there is no such file; gather it again")

    @property
    def name(self) -> str:
        """Of the world."""
        return self.source.name

    def esdf(self) -> Esdf:
        """The distances, read from disk.

        Raises:
            FileNotFoundError, ValueError: see `Esdf.load`.
        """
        return self._esdf

    def has_distances_of(self, other: "WorldRecord") -> bool:
        """Tells whether another record has the same distances."""
        if (self.path / _ESDF).samefile(other.path / _ESDF):
            return True
        own, others = Esdf.load(self.path / _ESDF), Esdf.load(other.path / _ESDF)
        return _are_same(own, others)

    def make(self) -> World:
        """Makes the world again, to see and fly in.

        Raises:
            FileNotFoundError, ValueError: see `make_world`; or if it is not what it was.
        """
        world = make_world(self.source.world, self.source.seed)
        if not _are_same(world.esdf, self.esdf()):
            raise ValueError(
                f"the world {self.name} is no longer what {self.path} recorded: its scene or the "
                "program has changed; restore it, or gather anew in another folder"
            )
        return world

    @cached_property
    def _esdf(self) -> Esdf:
        return Esdf.load(self.path / _ESDF)


def _are_same(a: Esdf, b: Esdf) -> bool:
    return (
        a.voxel_size == b.voxel_size
        and np.array_equal(a.lower_W, b.lower_W)
        and np.array_equal(a.distances, b.distances)
        and np.array_equal(a.states, b.states)
    )


def record_world(path: Path, source: WorldSource, esdf: Esdf) -> WorldRecord:
    """Writes the folder of a world, whole or not at all; one that is there stays.

    Raises:
        OSError: if it cannot be written.
    """
    with folder_written_atomically(path) as folder:
        (folder / _ABOUT).write_text(dump_config(source))
        esdf.save(folder / _ESDF)
    return WorldRecord(path)
