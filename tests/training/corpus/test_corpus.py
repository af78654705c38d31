import shutil

import numpy as np
import pytest

from splatpilot.training.corpus.corpus import Corpus
from splatpilot.training.corpus.samples import EXPERT


@pytest.fixture
def folder(collected, tmp_path):
    """A copy of the corpus, to be damaged."""
    return shutil.copytree(collected.folder, tmp_path / "corpus")


def test_samples_are_in_the_order_of_their_indices(collected):
    first, second = collected.shards
    assert len(collected) == len(first) + len(second)
    indices = np.array([len(first) + 1, 0, len(first) - 1, 0, len(first)])
    found = collected.samples(indices)
    rows = [(second, 1), (first, 0), (first, len(first) - 1), (first, 0), (second, 0)]
    for name in ("color", "depth", "X_WB", "v_B", "goal_B", "trajectories_B"):
        expected = np.stack([shard.arrays[name][row] for shard, row in rows])
        np.testing.assert_array_equal(getattr(found, name), expected)
        assert getattr(found, name).flags.c_contiguous
    assert [collected.worlds[k].name for k in found.world] == [shard.world for shard, _ in rows]
    assert (found.source == EXPERT).all()
    assert len(collected.samples(np.array([], int))) == 0
    for index in (-1, len(collected)):
        with pytest.raises(IndexError, match=r"in \[0, "):
            collected.samples(np.array([0, index]))


def test_missing_and_changed_parts_are_named(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no corpus.*splatpilot corpus make"):
        Corpus(tmp_path)
    corpus = Corpus(folder)
    corpus.verify()
    record = corpus.worlds[1]
    record.source.seed += 1
    with pytest.raises(ValueError, match="no longer what"):
        record.make()
    config = (folder / "corpus.yaml").read_text()
    (folder / "corpus.yaml").write_text(config.replace("width: 32", "width: 80"))
    with pytest.raises(ValueError, match=r"images of .* must be \(24, 80, 3\) as in .*corpus"):
        Corpus(folder).verify()
    (folder / "corpus.yaml").write_text(config)
    [first, *others] = sorted((folder / "shards").iterdir())
    shutil.rmtree(first)
    with pytest.raises(ValueError, match=rf"No such folder: .*{first.name}"):
        Corpus(folder).verify()
    world = folder / "worlds" / record.name
    (world / "esdf.npz").unlink()
    with pytest.raises(FileNotFoundError, match=f"{world.name}/esdf.npz"):
        Corpus(folder)
    shutil.rmtree(world)
    with pytest.raises(ValueError, match=f"No such folder: .*{world.name}"):
        Corpus(folder)
    for shard in others:
        shutil.rmtree(shard)
    with pytest.raises(ValueError, match="corpus with samples, got none"):
        Corpus(folder)
