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
    assert list(tmp_path.iterdir()) == [path]


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


def test_images_are_mapped_and_cannot_be_written(tmp_path):
    color = Shard(write(tmp_path / "a", random_samples(2))).arrays["color"]
    assert isinstance(color, np.memmap)
    with pytest.raises(ValueError, match="read-only"):
        color[0] = 0


def test_empty_shard(tmp_path):
    shard = Shard(write(tmp_path / "a"))
    shard.verify()
    assert len(shard) == 0
    assert shard.arrays == {}


def test_existing_shard_is_not_overwritten(tmp_path):
    path = write(tmp_path / "a", random_samples(2, seed=1))
    before = (path / "color.npy").read_bytes()
    write(path, random_samples(3, seed=2))
    assert (path / "color.npy").read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["color.npy", "depth.npy", "labels.npy"])
def test_a_truncated_file_is_named(tmp_path, name):
    path = write(tmp_path / "a", random_samples(3))
    whole = (path / name).read_bytes()
    (path / name).write_bytes(whole[:-7])
    message = rf"{name} must be {len(whole)} bytes, got {len(whole) - 7}; delete that folder"
    with pytest.raises(ValueError, match=message):
        Shard(path)
    (path / name).unlink()
    with pytest.raises(ValueError, match=rf"{name} must be .* got 0"):
        Shard(path)


def test_a_changed_byte_is_found(tmp_path):
    path = write(tmp_path / "a", random_samples(3))
    content = bytearray((path / "depth.npy").read_bytes())
    content[-1] ^= 1
    (path / "depth.npy").write_bytes(content)
    with pytest.raises(ValueError, match=r"depth\.npy is damaged"):
        Shard(path).verify()


def test_other_versions_are_refused(tmp_path):
    path = write(tmp_path / "a", random_samples(1))
    about = json.loads((path / "shard.json").read_text())
    (path / "shard.json").write_text(json.dumps(about | {"format_version": 7}))
    with pytest.raises(ValueError, match="must be 2, got 7"):
        Shard(path)
    (path / "shard.json").write_text(json.dumps(about)[:40])
    with pytest.raises(ValueError, match="describes no shard"):
        Shard(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"world": None}, "missing 'world'"),
        ({"files": {}}, r"missing 'color\.npy'"),
        ({"source": 17}, "source must be .* got 17"),
        ({"samples": -1}, "samples must be at least 0, got -1"),
        ({"flights": [{"states": "x"}]}, "states must be whole numbers"),
    ],
)
def test_invalid_descriptions_are_refused(tmp_path, change, message):
    path = write(tmp_path / "a", random_samples(1))
    about = json.loads((path / "shard.json").read_text()) | change
    about = {name: value for name, value in about.items() if value is not None}
    (path / "shard.json").write_text(json.dumps(about))
    with pytest.raises(ValueError, match=rf"describes no shard \(.*{message}.*; delete"):
        Shard(path)


def test_description_of_more_samples_than_the_arrays_have(tmp_path):
    path = write(tmp_path / "a", random_samples(3))
    about = json.loads((path / "shard.json").read_text())
    (path / "shard.json").write_text(json.dumps(about | {"samples": 5}))
    with pytest.raises(ValueError, match=r"must be 3 as in color, got 5"):
        Shard(path).verify()
