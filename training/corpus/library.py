"""The worlds that a corpus is gathered in: generated ones, and scenes with obstacles put in."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios, scenario_file
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.inserted import InsertedConfig
from splatpilot.diagrams.worlds.octomap_world import OCTOMAP
from splatpilot.diagrams.worlds.scene_folder import (
    SceneConfig,
    SceneSource,
    find_scene,
    read_scene_metadata,
)
from splatpilot.diagrams.worlds.splits import find_test_source, part_digests
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import WORLDS, WorldConfig, is_procedural, make_world
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.config import dump_config, load_config, open_field
from splatpilot.systems.common.files import folder_written_atomically
from splatpilot.systems.common.seeds import SEEDS_PER_RUN, VALIDATION_SEEDS, first_training_seed
from splatpilot.systems.common.validation import Config, bounded

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


# Where policies train: in generated worlds of the benchmark's kinds, of seeds it never uses, and
# in scenes that it does not test in.


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


def check_library(kinds: Sequence[str], scenes: Sequence[str]) -> None:
    """Checks that there are kinds or scenes, and that the worlds of the kinds are generated."""
    if not kinds and not scenes:
        raise ValueError("worlds must have kinds or scenes, got neither")
    for kind in kinds:
        if not is_procedural(world_of(kind)):
            raise ValueError(
                f"worlds.kinds must be of generated worlds, got {kind}; choose from "
                f"{', '.join(PROCEDURAL)} and files, and put captured scenes into worlds.scenes"
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


@dataclass
class LibraryConfig(Config):
    """Worlds of a corpus, which take turns."""

    # Scenarios whose worlds are generated, the benchmark's or files; naming one twice doubles its
    # part.
    kinds: list[str] = field(default_factory=lambda: [*PROCEDURAL, *ROUNDABOUT])
    # Scene folders, each with other obstacles, start and goal every time its turn comes. Of split
    # train, or validation if held out; each with its fidelity bound (`splatpilot scene fidelity`).
    scenes: list[str] = field(default_factory=list)
    # Whether the seeds are those of validation instead of training.
    held_out: bool = False

    def check(self) -> None:
        check_library(self.kinds, self.scenes)
        for scene in self.scenes:
            _measured_scene(self, scene)


def world_source(library: LibraryConfig, seed: int, index: int) -> WorldSource:
    """
    The world `index` of a library, whose kinds come in turn and whose seeds count on.

    Args:
        seed: of the corpus: two of different seeds have no generated world in common.
        index: 0 to 999.

    Raises:
        FileNotFoundError, ValueError: see `LibraryConfig.validate`; or if the seed or the index is
            out of range.
    """
    if not 0 <= index < SEEDS_PER_RUN:
        raise ValueError(
            f"a corpus has at most {SEEDS_PER_RUN} worlds; gather more with another seed"
        )
    first = VALIDATION_SEEDS if library.held_out else first_training_seed(seed)
    kinds = [*library.kinds, *library.scenes]
    kind, seed = kinds[index % len(kinds)], first + index
    name = f"{Path(kind).stem}-{seed}"
    if kind in library.scenes:
        world = InsertedConfig(path=kind, draw_ends=True)
        bound, digest = _measured_scene(library, kind)
        return WorldSource(name, world, seed, bound, digest)
    return WorldSource(name, world_of(kind), seed, inf)


def _measured_scene(library: LibraryConfig, scene: str) -> tuple[float, list[str]]:
    """Returns how far from its capture's poses the images of a scene folder can be trusted [m], and
    its `source_digest`.

    Raises:
        FileNotFoundError: if there is no such scene.
        ValueError: if it was not measured, or is not of the library's split.
    """
    folder = place_to_learn_in(scene, "validation" if library.held_out else "train")
    metadata = read_scene_metadata(folder)
    if metadata.perturbation_bound is None:
        raise ValueError(
            f"{folder / 'scene.yaml'} does not say how far from the capture its images can be "
            f"trusted (perturbation_bound); measure it with `splatpilot scene fidelity {folder}`"
        )
    return metadata.perturbation_bound, metadata.source_digest


@dataclass
class PerturbationConfig(Config):
    """Maximum perturbations of poses."""

    # [-] Number of perturbed poses of each labeled state, besides its own.
    copies: int = bounded(1, "[0, 100]")
    # [m] Displacement, at most the world's fidelity bound.
    distance: float = bounded(0.3, "[0, 5] m")
    # [rad] Rotation about the vertical.
    yaw: float = bounded(0.2, "[0, 3.1416] rad")
    # [rad] Rotation about each of the other axes.
    tilt: float = bounded(0.1, "[0, 1] rad")


def perturbed(
    X_WB: RigidTransform, config: PerturbationConfig, reach: float, rng: np.random.Generator
) -> RigidTransform:
    """A pose near X_WB, displaced by at most `config.distance` and at most `reach` [m].

    The displacement is uniform in that ball. With the clearance at X_WB within `reach`, the
    vehicle touches nothing there either: distances change by no more than one moves.
    """
    direction = rng.normal(size=3)
    radius = max(0.0, min(config.distance, reach)) * rng.uniform() ** (1 / 3)
    p_BP_W = radius * direction / np.linalg.norm(direction)
    roll, pitch, yaw = rng.uniform(-1, 1, 3) * (config.tilt, config.tilt, config.yaw)
    R_WP = RollPitchYaw(0, 0, yaw).ToRotationMatrix() @ X_WB.rotation()
    R_WP = R_WP @ RollPitchYaw(roll, pitch, 0).ToRotationMatrix()
    return RigidTransform(R_WP, X_WB.translation() + p_BP_W)
