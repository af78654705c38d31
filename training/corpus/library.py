"""The worlds that a corpus is gathered in: generated ones, and scenes with obstacles put in."""

from dataclasses import dataclass, field
from math import inf
from pathlib import Path

from splatpilot.diagrams.worlds.inserted import InsertedConfig
from splatpilot.diagrams.worlds.scene_metadata import read_scene_metadata
from splatpilot.systems.seeds import SEEDS_PER_RUN, VALIDATION_SEEDS, first_training_seed
from splatpilot.training.corpus.world_record import WorldSource
from splatpilot.training.world_kinds import (
    PROCEDURAL,
    ROUNDABOUT,
    check_generated,
    place_to_learn_in,
    world_of,
)


@dataclass
class LibraryConfig:
    """Which worlds; a corpus is gathered in so many of them, in turn."""

    # Scenarios whose worlds are generated, the benchmark's or files; naming one twice doubles its
    # part.
    kinds: list[str] = field(default_factory=lambda: [*PROCEDURAL, *ROUNDABOUT])
    # Scene folders, each with other obstacles, start and goal every time its turn comes. Of split
    # train, or validation if held out; each with its fidelity bound (`splatpilot fidelity`).
    scenes: list[str] = field(default_factory=list)
    # Whether the seeds are those of validation instead of training.
    held_out: bool = False

    def validate(self) -> None:
        """
        Raises:
            FileNotFoundError: for a scene that is not there.
            ValueError: on a value out of range, naming it, its limit and the remedy.
        """
        if not self.kinds and not self.scenes:
            raise ValueError("worlds has neither kinds nor scenes; name some")
        for kind in self.kinds:
            check_generated(kind)
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
            f"trusted (perturbation_bound); measure it with `splatpilot fidelity {folder}`"
        )
    return metadata.perturbation_bound, metadata.source_digest
