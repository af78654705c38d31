from dataclasses import replace
from pathlib import Path

import pytest

from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.training.corpus import collect
from splatpilot.training.corpus.corpus import Corpus, CorpusConfig
from splatpilot.training.corpus.expert import ExpertConfig
from splatpilot.training.corpus.library import LibraryConfig


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
