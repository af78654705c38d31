"""Arrays in files whose claims are not true."""

import io
import zipfile

import numpy as np
import pytest

from splatpilot.systems.common.readers import LIMIT, array_layout, read_archive, read_array


def header(shape: str, descr: str = "'<f4'") -> bytes:
    """The beginning of an `.npy` file."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00v\x00" + text.encode()


def archive(path, **entries: bytes):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in entries.items():
            file.writestr(f"{name}.npy", content)
    return path


def test_what_numpy_writes_is_read(tmp_path):
    """Arrays of any shape and type, compressed and not, come back as they were."""
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.array("text"),
        "c": np.zeros((0, 4), np.uint8),
        "d": np.asfortranarray(np.arange(6).reshape(2, 3)),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        read = read_archive(tmp_path / "a.npz")
        assert read.keys() == arrays.keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(read[name], array)
            assert read[name].dtype == array.dtype
    np.save(tmp_path / "a.npy", arrays["a"])
    assert array_layout(tmp_path / "a.npy") == ((2, 3), np.dtype(float))
    np.testing.assert_array_equal(read_array(tmp_path / "a.npy"), arrays["a"])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            header("(100000, 100000, 10)") + bytes(40),
            r"claims float32 of shape .* bytes of 40",
        ),
        (header(f"({2**62}, 4)") + bytes(40), "claims float32"),
        (header("(-1, -10)") + bytes(40), "claims float32"),
        (header(f"({2**70},)", "'<U0'") + b"", "claims <U0"),
        (header("(3,)", "'|O'") + b"cos\nsystem\n", "Python objects"),
        (header("(__import__('os'),)") + bytes(40), "."),
        (header("(1,)", "'<U100000000'") + bytes(40), "claims <U100000000"),
        (b"\x93NUMPY\x01\x00\xff\xff nonsense", "."),
        (b"", "."),
    ],
)
def test_headers_are_not_believed(tmp_path, content, message):
    """A header that claims other than there is, in a file of its own or in an archive, is refused
    by file before anything is allocated."""
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(ValueError, match=rf"a\.npy: not a readable array \(.*{message}"):
        read_array(tmp_path / "a.npy")
    with pytest.raises(ValueError, match=rf"a\.npz: not a readable numpy archive \(.*{message}"):
        read_archive(archive(tmp_path / "a.npz", a=content))


def test_size_has_a_limit_that_can_be_raised(tmp_path, monkeypatch):
    """A bomb is refused by its size with the variable that raises the limit, and read with it."""
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(10**6))
    path = archive(tmp_path / "a.npz", a=buffer.getvalue())
    assert path.stat().st_size < 10**5
    monkeypatch.setenv(LIMIT, "0.001")
    with pytest.raises(ValueError, match=rf"a\.npz would take 0\.008 GB .*set {LIMIT} to more"):
        read_archive(path)
    monkeypatch.setenv(LIMIT, "0.01")
    assert len(read_archive(path)["a"]) == 10**6
    monkeypatch.setenv(LIMIT, "lots")
    with pytest.raises(ValueError, match=rf"{LIMIT} is 'lots'; it must be a positive number"):
        read_archive(path)
