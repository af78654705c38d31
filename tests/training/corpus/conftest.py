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
