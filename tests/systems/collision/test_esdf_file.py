"""The file format of distance fields."""

import numpy as np
import pytest

from splatpilot.systems.collision.esdf import Esdf


@pytest.fixture
def field() -> Esdf:
    random = np.random.default_rng(0)
    return Esdf(
        random.normal(size=(5, 4, 3)).astype(np.float32),
        random.integers(0, 3, (5, 4, 3)).astype(np.uint8),
        np.array([1.0, -2.0, 0.1]),
        0.05,
        occupied_outside=True,
    )


def test_a_saved_field_comes_back_the_same(field, tmp_path):
    """Every array and number survives the file bit for bit."""
    field.save(tmp_path / "esdf.npz")
    loaded = Esdf.load(tmp_path / "esdf.npz")
    np.testing.assert_array_equal(loaded.distances, field.distances)
    np.testing.assert_array_equal(loaded.states, field.states)
    np.testing.assert_array_equal(loaded.lower_W, field.lower_W)
    assert loaded.voxel_size == field.voxel_size
    assert loaded.occupied_outside
    assert [path.name for path in tmp_path.iterdir()] == ["esdf.npz"]


def test_a_failed_save_leaves_the_old_file_and_nothing_else(field, tmp_path, monkeypatch):
    """Writing that breaks off half way keeps the previous field and removes its own traces."""
    path = tmp_path / "esdf.npz"
    field.save(path)
    before = path.read_bytes()

    def breaks_off(file, **arrays):
        file.write(b"half a field")
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez_compressed", breaks_off)
    with pytest.raises(OSError, match="no space left"):
        field.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_reader_of_the_old_file_is_not_disturbed(field, tmp_path):
    """Saving over a field puts a new file in its place; who has the old one open reads on."""
    path = tmp_path / "esdf.npz"
    path.write_bytes(b"the old field")
    with path.open("rb") as reader:
        field.save(path)
        assert reader.read() == b"the old field"
    assert Esdf.load(path).shape == field.shape


def test_a_missing_folder_is_reported(field, tmp_path):
    """Saving into a folder that does not exist names the file and creates nothing."""
    with pytest.raises(OSError, match=r"esdf\.npz: cannot be written \(No such file"):
        field.save(tmp_path / "nowhere" / "esdf.npz")


def test_a_missing_file_is_reported(tmp_path):
    """Loading what is not there names the path."""
    with pytest.raises(FileNotFoundError, match=r"esdf\.npz"):
        Esdf.load(tmp_path / "esdf.npz")


@pytest.mark.parametrize("content", [b"", b"not an archive", b"PK\x03\x04 broken"])
def test_foreign_files_are_refused(tmp_path, content):
    """A file that is no numpy archive is named as such."""
    path = tmp_path / "esdf.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"esdf\.npz: not a readable numpy archive"):
        Esdf.load(path)


def test_truncated_and_damaged_files_are_refused(field, tmp_path):
    """A field cut short, or with damaged bytes inside, is not read."""
    path = tmp_path / "esdf.npz"
    field.save(path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match="not a readable numpy archive"):
        Esdf.load(path)
    damaged = bytearray(content)
    # Within the compressed bytes of the distances.
    for i in range(content.index(b"distances.npy") + 60, content.index(b"states.npy") - 60):
        damaged[i] ^= 0xFF
    path.write_bytes(damaged)
    with pytest.raises(ValueError, match=r"esdf\.npz"):
        Esdf.load(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"states": None}, r"\['states'\] are missing"),
        ({"version": np.int64(99)}, "format 99"),
        ({"distances": np.zeros((5, 4), np.float32)}, "'distances' is float32 of shape"),
        ({"distances": np.zeros((5, 4, 3), int)}, "'distances' is int64"),
        ({"distances": np.full((5, 4, 3), np.nan, np.float32)}, "60 of 60 distances are NaN"),
        ({"states": np.zeros((5, 4, 2), np.uint8)}, r"\(5, 4, 2\)"),
        ({"states": np.array([[["free"]]])}, "'states' is <U4"),
        ({"voxel_size": np.float64(-0.05)}, "-0.05 m; it must be positive"),
        ({"lower_W": np.zeros(2)}, "3 finite coordinates"),
        ({"states": np.array([[[{}]]], dtype=object)}, "not a readable numpy archive"),
    ],
)
def test_wrong_entries_are_refused(field, tmp_path, change, message):
    """Each missing or wrong entry is named with its value; the message names the file."""
    path = tmp_path / "esdf.npz"
    field.save(path)
    with np.load(path) as archive:
        entries = {**archive, **change}
    np.savez(path, **{name: value for name, value in entries.items() if value is not None})
    with pytest.raises(ValueError, match=message) as error:
        Esdf.load(path)
    assert str(path) in str(error.value)
