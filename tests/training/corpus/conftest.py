"""A small forest in place of the benchmark's, and a corpus of two of them."""

import pytest

from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.training.corpus import library, make
from splatpilot.training.corpus.config import CorpusConfig
from splatpilot.training.corpus.corpus import Corpus
from splatpilot.training.corpus.library import LibraryConfig
from splatpilot.training.policies.expert import ExpertConfig


@pytest.fixture(scope="session")
def small_forests():
    """Makes the worlds of P02 small ones, in this process."""
    with pytest.MonkeyPatch.context() as patch:
        small = ForestConfig(length=10.0, width=8.0, height=4.0)
        patch.setattr(library, "world_of", lambda kind: small)
        yield


@pytest.fixture(scope="session")
def small(small_forests) -> CorpusConfig:
    """Two short flights in each small forest."""
    return CorpusConfig(
        worlds=LibraryConfig(kinds=["P02"]),
        expert=ExpertConfig(period=0.5),
        flights=2,
        camera=OnboardCamera(width=32, height=24),
    )


@pytest.fixture(scope="session")
def gathered(small, tmp_path_factory) -> Corpus:
    """A corpus of two worlds; not to be written to."""
    return make.run(config=small, out=tmp_path_factory.mktemp("corpus"), worlds=2, jobs=1)
