"""PLY files whose headers are not true."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from splatpilot.systems.common.readers import LIMIT, read_ply_file


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_what_plyfile_writes_is_read(tmp_path, text, byte_order):
    """Binary of either order and ASCII, with lists and without."""
    vertices = np.array([(1.0, 2), (3.0, 4)], dtype=[("x", "f4"), ("n", "u1")])
    faces = np.array([([0, 1, 1],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, text=text, byte_order=byte_order).write(str(tmp_path / "a.ply"))
    read = read_ply_file(tmp_path / "a.ply")
    assert read["vertex"]["x"].tolist() == [1.0, 3.0]
    assert read["face"]["vertex_indices"][0].tolist() == [0, 1, 1]


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("count", [2**31, 2**63, 10**30, 100])
def test_counts_are_compared_with_the_file(tmp_path, kind, count):
    """More rows than the file has room for are refused before any is made."""
    path = tmp_path / "a.ply"
    path.write_text(
        f"ply\nformat {kind} 1.0\nelement vertex {count}\nproperty float x\nend_header\n1 2 3\n"
    )
    with pytest.raises(ValueError, match=r"a\.ply: the data do not match the header, which claims"):
        read_ply_file(path)


@pytest.mark.parametrize(
    "header",
    [
        "ply\nformat ascii 1.0\nelement vertex -1\nproperty float x\nend_header\n",
        "ply\nformat ascii 1.0\nelement vertex 1e3\nproperty float x\nend_header\n",
        "ply\nformat ascii 1.0\nelement vertex 1000000000\nend_header\n",
        "ply\nformat ascii 1.0\nproperty float x\nend_header\n",
        "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty huge x\nend_header\n",
        "ply\nformat ascii 1.0\nelement vertex 1\n",
        "ply\nformat ascii 1.0\nelement v\u00e9rtex 1\nproperty float x\nend_header\n1\n",
        "plyend_header",
        "",
    ],
)
def test_headers_that_are_none_are_refused(tmp_path, header):
    """Whatever a header says, the answer is one sentence with the file."""
    path = tmp_path / "a.ply"
    path.write_text(header)
    with pytest.raises(ValueError, match=r"a\.ply: not a PLY file \("):
        read_ply_file(path)


def test_size_has_a_limit_that_can_be_raised(tmp_path, monkeypatch):
    """A file larger than the limit is refused with the variable that raises it."""
    path = tmp_path / "a.ply"
    vertices = PlyElement.describe(np.zeros(1000, dtype=[("x", "f4")]), "vertex")
    PlyData([vertices]).write(str(path))
    monkeypatch.setenv(LIMIT, "1e-6")
    with pytest.raises(ValueError, match=rf"a\.ply would take .*set {LIMIT} to more"):
        read_ply_file(path)
