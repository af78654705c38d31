import zipfile

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from splatpilot.systems.common.readers import (
    LIMIT,
    array_layout,
    read_archive,
    read_array,
    read_ply_file,
    read_text,
)


def header(shape: str, descr: str = "'<f4'") -> bytes:
    """The beginning of an `.npy` file."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00v\x00" + text.encode()


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_are_read_as_numpy_wrote_them(tmp_path, save):
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.array("text"),
        "c": np.zeros((0, 4), np.uint8),
        "d": np.asfortranarray(np.arange(6).reshape(2, 3)),
    }
    save(tmp_path / "a.npz", **arrays)
    read = read_archive(tmp_path / "a.npz")
    assert read.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype
        np.save(tmp_path / "a.npy", array)
        assert array_layout(tmp_path / "a.npy") == (array.shape, array.dtype)
        np.testing.assert_array_equal(read_array(tmp_path / "a.npy"), array)


@pytest.mark.parametrize(
    "content",
    [
        header("(100000, 100000, 10)") + bytes(40),
        header(f"({2**62}, 4)") + bytes(40),
        header("(-1, -10)") + bytes(40),
        header("(3,)", "'|O'") + b"cos\nsystem\n",
        header("(__import__('os'),)") + bytes(40),
        header("(1,)", "'<U100000000'") + bytes(40),
        b"\x93NUMPY\x01\x00\xff\xff nonsense",
        b"",
    ],
)
def test_damaged_arrays_are_refused(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.npy: not a readable array \(.+\); .* copy it again"):
        read_array(tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("a.npy", content)
    with pytest.raises(ValueError, match=r"a\.npz: not a readable numpy archive \(.+\)"):
        read_archive(tmp_path / "a.npz")


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_ply_files_are_read_as_plyfile_wrote_them(tmp_path, text, byte_order):
    vertices = np.array([(1.0, 2), (3.0, 4)], dtype=[("x", "f4"), ("n", "u1")])
    faces = np.array([([0, 1, 1],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, text=text, byte_order=byte_order).write(str(tmp_path / "a.ply"))
    read = read_ply_file(tmp_path / "a.ply")
    assert read["vertex"]["x"].tolist() == [1.0, 3.0]
    assert read["face"]["vertex_indices"][0].tolist() == [0, 1, 1]


@pytest.mark.parametrize(
    "content",
    [
        *(
            f"ply\nformat {kind} 1.0\nelement vertex {count}\nproperty float x\nend_header\n1 2\n"
            for kind in ("ascii", "binary_little_endian")
            for count in (10**30, 100, -1)
        ),
        "ply\nformat ascii 1.0\nproperty float x\nend_header\n",
        "ply\nformat ascii 1.0\nelement vertex 1\n",
        "plyend_header",
        "",
    ],
)
def test_damaged_ply_files_are_refused(tmp_path, content):
    path = tmp_path / "a.ply"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"a\.ply: not a readable PLY file \("):
        read_ply_file(path)


def test_size_has_a_limit(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.zeros(10**6))
    assert path.stat().st_size < 10**5
    monkeypatch.setenv(LIMIT, "0.001")
    with pytest.raises(ValueError, match=rf"a\.npz must .* got 0\.008 GB; .*set {LIMIT} to more"):
        read_archive(path)
    monkeypatch.setenv(LIMIT, "0.01")
    assert len(read_archive(path)["a"]) == 10**6
    monkeypatch.setenv(LIMIT, "lots")
    with pytest.raises(ValueError, match=f"{LIMIT} must be a positive number of GB, got 'lots'"):
        read_archive(path)


@pytest.mark.parametrize("read", [read_text, read_array, read_archive, read_ply_file])
def test_missing_files_are_named(tmp_path, read):
    with pytest.raises(FileNotFoundError, match=r"No such file: .*nowhere"):
        read(tmp_path / "nowhere")
