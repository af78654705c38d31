"""Shards on disk."""

import json
from dataclasses import fields

import numpy as np
import pytest

from splatpilot.training.corpus.samples import EXPERT, Samples, SampleSize, Shard, write_shard

SIZE = SampleSize(height=4, width=6, trajectories=2)


def random_samples(count: int, seed: int = 0) -> Samples:
    rng = np.random.default_rng(seed)
    samples = Samples.zeros(count, SIZE)
    for field in fields(samples):
        array = getattr(samples, field.name)
        array[:] = rng.integers(0, 200, array.shape)
    return samples


def write(path, *parts, **said):
    write_shard(
        path, parts, SIZE, **{"world": "w", "source": EXPERT, "flights": [], "revision": "r"} | said
    )
    return path


def test_round_trip(tmp_path):
    """What was written is read, field by field, in the types that samples have, and nothing else
    is left in the folder."""
    samples = random_samples(5)
    path = write(tmp_path / "a", samples, flights=[{"flight": 0}])
    shard = Shard(path)
    shard.verify()
    assert (len(shard), shard.world, shard.flights) == (5, "w", [{"flight": 0}])
    assert shard.arrays.keys() == {f.name for f in fields(samples)} - {"world", "source"}
    for name, array in shard.arrays.items():
        np.testing.assert_array_equal(array, getattr(samples, name))
        assert array.dtype == getattr(samples, name).dtype
    assert list(tmp_path.iterdir()) == [path]


def test_parts_are_written_one_after_the_other(tmp_path):
    """Files are those that NumPy writes of the whole, however many parts it comes in."""
    parts = [random_samples(count, seed=count) for count in (3, 0, 2)]
    path = write(tmp_path / "a", *parts)
    Shard(path).verify()
    for name in ("color", "depth"):
        whole = tmp_path / f"{name}.npy"
        np.save(whole, np.concatenate([getattr(part, name) for part in parts]))
        assert (path / f"{name}.npy").read_bytes() == whole.read_bytes()
    labels = [Shard(write(tmp_path / str(n), part)).arrays for n, part in enumerate(parts)]
    for name in ("X_WB", "trajectories_B"):
        expected = np.concatenate([part[name] for part in labels if part])
        np.testing.assert_array_equal(Shard(path).arrays[name], expected)


def test_images_are_mapped_and_cannot_be_written(tmp_path):
    """Images come as read-only maps of the file."""
    color = Shard(write(tmp_path / "a", random_samples(2))).arrays["color"]
    assert isinstance(color, np.memmap)
    with pytest.raises(ValueError, match="read-only"):
        color[0] = 0


def test_a_shard_of_nothing_is_one(tmp_path):
    """A world in which no flight succeeded has a shard too, of length zero."""
    shard = Shard(write(tmp_path / "a"))
    shard.verify()
    assert len(shard) == 0
    assert shard.arrays == {}


def test_one_that_is_there_stays(tmp_path):
    """Writing over a shard changes nothing: whoever wrote it first wrote the same."""
    path = write(tmp_path / "a", random_samples(2, seed=1))
    before = (path / "color.npy").read_bytes()
    write(path, random_samples(3, seed=2))
    assert (path / "color.npy").read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["color.npy", "depth.npy", "labels.npy"])
def test_a_truncated_file_is_named(tmp_path, name):
    """A file cut short is found when the shard is opened, and named with the remedy."""
    path = write(tmp_path / "a", random_samples(3))
    whole = (path / name).read_bytes()
    (path / name).write_bytes(whole[:-7])
    message = rf"{name} has {len(whole) - 7} bytes instead of {len(whole)}; delete that folder"
    with pytest.raises(ValueError, match=message):
        Shard(path)
    (path / name).unlink()
    with pytest.raises(ValueError, match=rf"{name} has 0 bytes"):
        Shard(path)


def test_a_changed_byte_is_found(tmp_path):
    """A file of the right size and other content is found by its checksum."""
    path = write(tmp_path / "a", random_samples(3))
    content = bytearray((path / "depth.npy").read_bytes())
    content[-1] ^= 1
    (path / "depth.npy").write_bytes(content)
    with pytest.raises(ValueError, match=r"depth\.npy is damaged"):
        Shard(path).verify()


def test_other_versions_are_refused(tmp_path):
    """A shard of another format version is named with both versions; half a description is none."""
    path = write(tmp_path / "a", random_samples(1))
    about = json.loads((path / "shard.json").read_text())
    (path / "shard.json").write_text(json.dumps(about | {"format_version": 7}))
    with pytest.raises(ValueError, match="format version 7, this program knows 2"):
        Shard(path)
    (path / "shard.json").write_text(json.dumps(about)[:40])
    with pytest.raises(ValueError, match="describes no shard"):
        Shard(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"world": None}, "it lacks 'world'"),
        ({"files": {}}, r"it lacks 'color\.npy'"),
        ({"source": 17}, "source is 17"),
        ({"samples": -1}, "samples is -1"),
        ({"flights": [{"states": "x"}]}, "number of states"),
    ],
)
def test_descriptions_that_cannot_be(tmp_path, change, message):
    """A description without a part, or with one that cannot be, is named with the remedy."""
    path = write(tmp_path / "a", random_samples(1))
    about = json.loads((path / "shard.json").read_text()) | change
    about = {name: value for name, value in about.items() if value is not None}
    (path / "shard.json").write_text(json.dumps(about))
    with pytest.raises(ValueError, match=rf"describes no shard \(.*{message}.*; delete"):
        Shard(path)


def test_a_description_of_more_than_there_is(tmp_path):
    path = write(tmp_path / "a", random_samples(3))
    about = json.loads((path / "shard.json").read_text())
    (path / "shard.json").write_text(json.dumps(about | {"samples": 5}))
    with pytest.raises(ValueError, match=r"says that there are 5 samples, where color has 3"):
        Shard(path).verify()
