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
    samples = random_samples(5)
    path = write(tmp_path / "a", samples, flights=[{"flight": 0}])
    shard = Shard(path)
    shard.verify()
    assert (len(shard), shard.world, shard.flights) == (5, "w", [{"flight": 0}])
    assert shard.arrays.keys() == {f.name for f in fields(samples)} - {"world", "source"}
    for name, array in shard.arrays.items():
        np.testing.assert_array_equal(array, getattr(samples, name))
        assert array.dtype == getattr(samples, name).dtype
    assert isinstance(shard.arrays["color"], np.memmap)
    with pytest.raises(ValueError, match="read-only"):
        shard.arrays["color"][0] = 0
    write(path, random_samples(3, seed=2))  # which does not overwrite it
    assert len(Shard(path)) == 5
    assert list(tmp_path.iterdir()) == [path]
    empty = Shard(write(tmp_path / "b"))
    empty.verify()
    assert len(empty) == 0 and empty.arrays == {}


def test_parts_are_written_one_after_the_other(tmp_path):
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
