from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpilot.diagrams.worlds.scene_folder import (
    read_scene_metadata,
    write_scene_folder,
    write_scene_metadata,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Capsule, HalfSpace
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.corpus import collect
from splatpilot.training.corpus.corpus import Corpus, CorpusConfig
from splatpilot.training.corpus.expert import ExpertConfig
from splatpilot.training.corpus.library import LibraryConfig


@pytest.fixture(scope="session")
def write_scene() -> Callable[..., str]:
    """Writes a yard of 12 x 7 x 4 m with a post, named as a test scene is; returns its path."""
    shapes = [HalfSpace([0, 0, 1], 0.0), Capsule([6.0, 3.5, 0.0], [6.0, 3.5, 5.0], 0.5)]
    field = AnalyticDistanceField(shapes, np.zeros(3), np.array([12.0, 7.0, 4.0]))
    esdf, one = esdf_from_distance_field(field, 0.2), np.ones((1, 3))
    gaussians = GaussianScene.from_colors(one, [[1, 0, 0, 0]], one, [0.5], one)
    world = World("hospital", gaussians, esdf, esdf, (0.0, 0.0, 0.0), one[0], 2 * one[0])

    def write(path: Path, bound=None, split="train", digest=("0123456789abcdef",)) -> str:
        write_scene_folder(path, world, provenance="", split=split, source_digest=digest)
        write_scene_metadata(path, replace(read_scene_metadata(path), perturbation_bound=bound))
        return str(path)

    return write


@pytest.fixture(scope="session")
def small(tmp_path_factory) -> CorpusConfig:
    """Two short flights in each small forest."""
    grove = tmp_path_factory.mktemp("kinds") / "grove.yaml"
    grove.write_text("world: !ForestConfig {length: 10, width: 8, height: 4}\n")
    return CorpusConfig(
        worlds=LibraryConfig(kinds=[str(grove)]),
        expert=ExpertConfig(period=0.5),
        flights=2,
        camera=OnboardCamera(width=32, height=24),
    )


@pytest.fixture(scope="session")
def collected(small, tmp_path_factory) -> Corpus:
    """A corpus of two worlds; not to be written to."""
    return collect.run(config=small, out=tmp_path_factory.mktemp("corpus"), worlds=2, jobs=1)


@pytest.fixture(scope="session")
def student_corpus(small, tmp_path_factory) -> Path:
    """The folder of a corpus of three worlds; not to be written to."""
    out = tmp_path_factory.mktemp("student_corpus")
    return collect.run(config=small, out=out, worlds=3, jobs=1).folder


@pytest.fixture(scope="session")
def wide_corpus(small, tmp_path_factory) -> Path:
    """The same with images of 160x120."""
    config, out = replace(small, camera=OnboardCamera(160, 120)), tmp_path_factory.mktemp("wide")
    return collect.run(config=config, out=out, worlds=3, jobs=1).folder
