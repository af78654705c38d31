import json
import shutil
from dataclasses import fields

import numpy as np
import pytest

from splatpilot.training.corpus.corpus import (
    EXPERT,
    Corpus,
    Samples,
    SampleSize,
    Shard,
    write_shard,
)

SIZE = SampleSize(height=4, width=6, trajectories=2)


def random_samples(count: int, seed: int = 0) -> Samples:
    rng = np.random.default_rng(seed)
    samples = Samples.zeros(count, SIZE)
    for field in fields(samples):
        array = getattr(samples, field.name)
        array[:] = rng.integers(0, 200, array.shape)
    return samples


def write(path, *parts):
    about = {"world": "w", "source": EXPERT, "flights": [{"flight": 0}], "revision": "r"}
    write_shard(path, parts, SIZE, about)
    return path


def test_parts_of_a_shard_are_read_as_they_were_written(tmp_path):
    parts = [random_samples(count, seed=count) for count in (3, 0, 2)]
    path = write(tmp_path / "a", *parts)
    shard = Shard(path)
    shard.verify()
    assert (len(shard), shard.world, shard.flights) == (5, "w", [{"flight": 0}])
    assert shard.arrays.keys() == {f.name for f in fields(Samples)} - {"world", "source"}
    for name, array in shard.arrays.items():
        expected = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(array, expected)
        assert array.dtype == expected.dtype
    assert isinstance(shard.arrays["color"], np.memmap)
    with pytest.raises(ValueError, match="read-only"):
        shard.arrays["color"][0] = 0
    write(path, random_samples(3, seed=2))  # which does not overwrite it
    assert len(Shard(path)) == 5
    assert list(tmp_path.iterdir()) == [path]
    empty = Shard(write(tmp_path / "b"))
    empty.verify()
    assert len(empty) == 0 and empty.arrays == {}


@pytest.mark.parametrize("name", ["color.npy", "depth.npy", "labels.npy"])
def test_a_damaged_file_is_named(tmp_path, name):
    file = write(tmp_path / "a", random_samples(3)) / name
    whole = file.read_bytes()
    file.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(ValueError, match=f"{name} is damaged"):
        Shard(file.parent).verify()
    file.write_bytes(whole[:-7])
    message = rf"{name} must be {len(whole)} bytes, got {len(whole) - 7}; delete that folder"
    with pytest.raises(ValueError, match=message):
        Shard(file.parent)
    file.unlink()
    with pytest.raises(ValueError, match=rf"{name} must be .* got 0"):
        Shard(file.parent)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"world": None}, r"describes no shard \(.*missing 'world'.*; delete"),
        ({"files": {}}, r"describes no shard \(.*missing 'color\.npy'.*; delete"),
        ({"source": 17}, r"describes no shard \(.*source must be .* got 17.*; delete"),
        ({"samples": -1}, r"describes no shard \(.*samples must be at least 0, got -1.*; delete"),
        ({"flights": [{"states": "x"}]}, r"describes no shard \(.*states must be whole numbers"),
        ({"samples": 5}, "must be 3 as in color, got 5"),
        ({"format_version": 7}, "must be 2, got 7"),
        (40, "describes no shard"),
    ],
)
def test_invalid_descriptions_are_refused(tmp_path, change, message):
    path = write(tmp_path / "a", random_samples(3))
    text = (path / "shard.json").read_text()
    if isinstance(change, dict):
        about = json.loads(text) | change
        text = json.dumps({name: value for name, value in about.items() if value is not None})
    else:
        text = text[:change]
    (path / "shard.json").write_text(text)
    with pytest.raises(ValueError, match=message):
        Shard(path).verify()


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


def test_missing_and_changed_parts_are_named(collected, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no corpus.*splatpilot corpus make"):
        Corpus(tmp_path)
    folder = shutil.copytree(collected.folder, tmp_path / "corpus")
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
