"""Worlds of a corpus: generated ones, and scenes with inserted obstacles."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios, scenario_file
from splatpilot.diagrams.worlds.file_worlds import OCTOMAP
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.inserted import InsertedConfig
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
from splatpilot.systems.common.config import dump_config, load_config, registry_field
from splatpilot.systems.common.files import folder_written_atomically
from splatpilot.systems.common.provenance import (
    SEEDS_PER_RUN,
    VALIDATION_SEEDS,
    first_training_seed,
)
from splatpilot.systems.common.readers import require_file
from splatpilot.systems.common.validation import Config, bounded, require

WORLD = "world.yaml"
_ESDF = "esdf.npz"

# Scenarios whose worlds are generated from seeds.
PROCEDURAL = tuple(name for name in benchmark_scenarios() if name.startswith("P"))

ROUNDABOUT = ("P06", "P07", "P08", "P09", "P10", "P12")
"""Those with paths that are far from straight: learned slowest, so they have twice the share."""


@dataclass
class WorldSource:
    """Content of `world.yaml`, from which a world is made."""

    name: str = ""
    world: WorldConfig = registry_field(WORLDS, ForestConfig)
    seed: int = 0
    # [m] Distance from recorded poses within which images can be trusted; infinite if exact.
    perturbation_bound: float = inf
    # Of a scene, that of `scene.yaml`; empty for generated worlds.
    source_digest: list[str] = field(default_factory=list)


class WorldRecord:
    """The folder of a world in a corpus."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.source = load_config(WorldSource(), path / WORLD)
        require_file(path / _ESDF)

    @property
    def name(self) -> str:
        return self.source.name

    @cached_property
    def esdf(self) -> Esdf:
        """The distance field, read from disk."""
        return Esdf.load(self.path / _ESDF)

    def has_same_distances(self, other: "WorldRecord") -> bool:
        """Tells whether another record has the same distances."""
        files = self.path / _ESDF, other.path / _ESDF
        return files[0].samefile(files[1]) or _equal(*map(Esdf.load, files))

    def make(self) -> World:
        """Makes the world again, to render and fly in."""
        world = make_world(self.source.world, self.source.seed)
        if not _equal(world.esdf, self.esdf):
            raise ValueError(
                f"the world {self.name} is no longer what {self.path} recorded: its scene or the "
                "program has changed; restore it, or collect into another folder"
            )
        return world


def _equal(a: Esdf, b: Esdf) -> bool:
    names = "lower_W", "distances", "states"
    same = all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)
    return same and a.voxel_size == b.voxel_size


def record_world(path: Path, source: WorldSource, esdf: Esdf) -> None:
    """Writes the folder of a world atomically; an existing one stays."""
    with folder_written_atomically(path) as folder:
        (folder / WORLD).write_text(dump_config(source))
        esdf.save(folder / _ESDF)


def scenario_world(kind: str) -> WorldConfig:
    """Returns the configuration of the world of a scenario, the benchmark's or a file."""
    return load_config(Scenario(), scenario_file(kind)).world


def check_library(kinds: Sequence[str], scenes: Sequence[str]) -> None:
    """Checks that there are kinds or scenes, and that the worlds of the kinds are generated."""
    require(kinds or scenes, "worlds.kinds", "one kind or more without worlds.scenes", kinds)
    remedy = f"choose from {', '.join(PROCEDURAL)} and files, and put captured scenes into "
    for kind in kinds:
        generated = is_procedural(scenario_world(kind))
        require(generated, "worlds.kinds", "of generated worlds", kind, f"{remedy}worlds.scenes")


def training_scene(scene: str, split: str = "train") -> Path:
    """Finds a scene folder of `split`, or an OctoMap, and checks that it may be learned from."""
    found = find_scene(SceneConfig(path=scene))
    if found.suffix.lower() == OCTOMAP:
        require_untested(part_digests([found.read_bytes()]), str(found))
        return found
    remedy = "`splatpilot reconstruct` makes one"
    require(found.is_dir(), "scenes", "scene folders or OctoMaps", found, remedy)
    metadata = read_scene_metadata(found)
    require_untested(metadata.source_digest, str(found))
    remedy = f"use another scene, or reconstruct one with --set split={split}"
    require(metadata.split == split, f"split of {found}", split, repr(metadata.split), remedy)
    return found


def require_untested(digests: Collection[str], what: str) -> None:
    """Raises ValueError if the benchmark tests in a source with one of these digests, by the
    committed table or as a test scene on this machine; or if there are no digests."""
    if not digests:
        raise ValueError(
            f"{what} is missing source_digest, which identifies its source; reconstruct the scene "
            "again"
        )
    name = find_test_source(digests)
    for file in () if name else benchmark_scenarios().values():
        world = load_config(Scenario(), file).world
        if not isinstance(world, SceneSource):
            continue
        try:
            scene = read_scene_metadata(find_scene(world))
        except (OSError, ValueError):  # a scene that is missing or cannot be flown in
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
    # Uses the seeds of validation instead of training.
    held_out: bool = False

    def check(self) -> None:
        check_library(self.kinds, self.scenes)
        for scene in self.scenes:
            self.measured_scene(scene)

    def measured_scene(self, scene: str) -> tuple[float, list[str]]:
        """Returns the perturbation bound [m] of a scene folder, and its `source_digest`."""
        folder = training_scene(scene, "validation" if self.held_out else "train")
        metadata = read_scene_metadata(folder)
        if metadata.perturbation_bound is None:
            raise ValueError(
                f"{folder / 'scene.yaml'} is missing perturbation_bound, the distance from the "
                f"capture within which images can be trusted; measure it with `splatpilot scene "
                f"fidelity {folder}`"
            )
        return metadata.perturbation_bound, metadata.source_digest


def world_source(library: LibraryConfig, seed: int, index: int) -> WorldSource:
    """Returns the world `index`, 0 to 999, of a library whose kinds take turns and whose seeds
    count up. Corpora of different seeds to train with have no generated world in common; held-out
    ones have the same."""
    if not 0 <= index < SEEDS_PER_RUN:
        raise ValueError(
            f"a corpus has at most {SEEDS_PER_RUN} worlds; collect more with another seed"
        )
    first = VALIDATION_SEEDS if library.held_out else first_training_seed(seed)
    kinds = [*library.kinds, *library.scenes]
    kind, seed = kinds[index % len(kinds)], first + index
    name = f"{Path(kind).stem}-{seed}"
    if kind in library.scenes:
        world = InsertedConfig(path=kind, draw_ends=True)
        return WorldSource(name, world, seed, *library.measured_scene(kind))
    return WorldSource(name, scenario_world(kind), seed)


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


def perturb_pose(
    X_WB: RigidTransform, config: PerturbationConfig, reach: float, rng: np.random.Generator
) -> RigidTransform:
    """Draws a pose near X_WB, displaced within `config.distance` and `reach` [m], uniformly."""
    direction = rng.normal(size=3)
    radius = max(0.0, min(config.distance, reach)) * rng.uniform() ** (1 / 3)
    p_BP_W = radius * direction / np.linalg.norm(direction)
    roll, pitch, yaw = rng.uniform(-1, 1, 3) * (config.tilt, config.tilt, config.yaw)
    R_WP = RollPitchYaw(0, 0, yaw).ToRotationMatrix() @ X_WB.rotation()
    R_WP = R_WP @ RollPitchYaw(roll, pitch, 0).ToRotationMatrix()
    return RigidTransform(R_WP, X_WB.translation() + p_BP_W)
