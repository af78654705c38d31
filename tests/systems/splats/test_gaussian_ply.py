import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_files import read_ply, write_ply


def random_scene(N: int = 7, K: int = 4, seed: int = 0) -> GaussianScene:
    rng = np.random.default_rng(seed)
    return GaussianScene(
        means=rng.normal(size=(N, 3)).astype(np.float32),
        quats=rng.normal(size=(N, 4)).astype(np.float32),
        scales=np.exp(rng.normal(size=(N, 3))).astype(np.float32),
        opacities=rng.uniform(1e-3, 1, size=N).astype(np.float32),
        sh=rng.normal(size=(N, K, 3)).astype(np.float32),
    )


def assert_same(a: GaussianScene, b: GaussianScene) -> None:
    np.testing.assert_array_equal(a.means, b.means)
    np.testing.assert_array_equal(a.sh, b.sh)
    np.testing.assert_allclose(a.quats, b.quats, atol=2e-7)
    np.testing.assert_allclose(a.scales, b.scales, rtol=2e-6)
    np.testing.assert_allclose(a.opacities, b.opacities, rtol=2e-6)


@settings(max_examples=25, deadline=None)
@given(N=st.integers(1, 20), K=st.sampled_from([1, 4, 9, 16]), seed=st.integers(0, 2**16))
def test_round_trip(tmp_path_factory, N, K, seed):
    """Writing and reading gives the scene back within float32 rounding."""
    scene = random_scene(N, K, seed)
    path = tmp_path_factory.mktemp("ply") / "scene.ply"
    write_ply(scene, path)
    assert_same(read_ply(path), scene)


def test_layout_is_that_of_the_original_code(tmp_path):
    """Properties, order, channel-major f_rest, logit and logarithm are as other tools expect."""
    scene = random_scene(N=3, K=4)
    write_ply(scene, tmp_path / "scene.ply")
    ply = PlyData.read(str(tmp_path / "scene.ply"))
    assert (ply.text, ply.byte_order) == (False, "<")
    vertex = ply["vertex"]
    assert [p.name for p in vertex.properties] == (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(9)]
        + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )
    assert {p.val_dtype for p in vertex.properties} == {"f4"}
    np.testing.assert_array_equal(vertex["f_dc_1"], scene.sh[:, 0, 1])
    np.testing.assert_array_equal(vertex["f_rest_5"], scene.sh[:, 3, 1])  # green, third of three
    np.testing.assert_allclose(np.exp(vertex["scale_2"]), scene.scales[:, 2], rtol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-vertex["opacity"])), scene.opacities, rtol=1e-5)
    np.testing.assert_array_equal(vertex["rot_0"], scene.quats[:, 0])


def test_opaque_and_nearly_invisible_gaussians_survive(tmp_path):
    """An opacity of exactly 1 comes back as 1, and tiny ones stay positive."""
    below_one = np.nextafter(np.float32(1), np.float32(0))
    opacities = np.array([1.0, below_one, 0.5, 1e-30], dtype=np.float32)
    scene = random_scene(N=4)
    scene = GaussianScene(scene.means, scene.quats, scene.scales, opacities, scene.sh)
    write_ply(scene, tmp_path / "scene.ply")
    back = read_ply(tmp_path / "scene.ply").opacities
    assert back[0] == 1
    np.testing.assert_allclose(back, scene.opacities, rtol=1e-5)


def vertices(scene: GaussianScene, path, without: tuple[str, ...] = ()) -> np.ndarray:
    """The written table of `scene`, less some columns."""
    write_ply(scene, path)
    data = PlyData.read(str(path))["vertex"].data
    kept = [name for name in data.dtype.names if name not in without]
    table = np.empty(len(data), dtype=[(name, "f4") for name in kept])
    for name in kept:
        table[name] = data[name]
    return table


@pytest.mark.parametrize(("text", "byte_order"), [(True, "="), (False, ">"), (False, "<")])
def test_reads_every_encoding_without_normals(tmp_path, text, byte_order):
    """ASCII and both byte orders are read, and normals may be missing."""
    scene = random_scene(K=9)
    table = vertices(scene, tmp_path / "a.ply", without=("nx", "ny", "nz"))
    element = PlyElement.describe(table, "vertex")
    PlyData([element], text=text, byte_order=byte_order).write(str(tmp_path / "b.ply"))
    assert_same(read_ply(tmp_path / "b.ply"), scene)


def test_extreme_logits_are_read(tmp_path):
    """Logits beyond float32's reach are opaque or invisible Gaussians, not errors."""
    table = vertices(random_scene(N=2), tmp_path / "a.ply")
    table["opacity"] = [500, -500]
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    opacities = read_ply(tmp_path / "b.ply").opacities
    assert opacities[0] == 1
    assert 0 < opacities[1] < 1e-30


def test_missing_file(tmp_path):
    """A file that is not there is named."""
    with pytest.raises(FileNotFoundError, match=r"nowhere\.ply: no such file"):
        read_ply(tmp_path / "nowhere.ply")


@pytest.mark.parametrize("missing", [1, 60, 300])
def test_truncated_file(tmp_path, missing):
    """A file that ends too early is called truncated."""
    write_ply(random_scene(), tmp_path / "a.ply")
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(content[:-missing])
    with pytest.raises(ValueError, match=r"b\.ply: .*truncated"):
        read_ply(tmp_path / "b.ply")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x89PNG\r\n\x1a\n" + bytes(range(256)),
        b"solid cube\nfacet\n",
        b"ply\n",
        b"ply\nx y\n",
    ],
)
def test_foreign_file(tmp_path, content):
    """A file that is no PLY is said to be none."""
    (tmp_path / "b.ply").write_bytes(content)
    with pytest.raises(ValueError, match=r"b\.ply: not a readable PLY file"):
        read_ply(tmp_path / "b.ply")


def test_mesh(tmp_path):
    """Points and meshes are told from Gaussians by what their vertices lack."""
    table = np.zeros(3, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("nx", "f4")])
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "mesh.ply"))
    with pytest.raises(ValueError, match=r"mesh\.ply: a point cloud, no Gaussians: .*lack f_dc_0"):
        read_ply(tmp_path / "mesh.ply")
    face = PlyElement.describe(np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))]), "face")
    PlyData([PlyElement.describe(table, "vertex"), face]).write(str(tmp_path / "mesh.ply"))
    with pytest.raises(ValueError, match=r"mesh\.ply: a mesh, no Gaussians"):
        read_ply(tmp_path / "mesh.ply")
    PlyData([PlyElement.describe(table, "face")]).write(str(tmp_path / "faces.ply"))
    with pytest.raises(ValueError, match=r"faces\.ply: no element 'vertex'"):
        read_ply(tmp_path / "faces.ply")


def test_no_gaussians_at_all(tmp_path):
    """A PLY with zero Gaussians is no scene."""
    table = vertices(random_scene(), tmp_path / "a.ply")[:0]
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    with pytest.raises(ValueError, match=r"b\.ply: holds no Gaussians"):
        read_ply(tmp_path / "b.ply")


@pytest.mark.parametrize("without", [("f_rest_8",), ("f_rest_0",), ("f_rest_0", "f_rest_1")])
def test_odd_number_of_coefficients(tmp_path, without):
    """A number of f_rest that belongs to no degree is refused."""
    table = vertices(random_scene(), tmp_path / "a.ply", without)
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    with pytest.raises(ValueError, match=rf"{9 - len(without)} properties f_rest.*0, 9, 24 or 45"):
        read_ply(tmp_path / "b.ply")


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("y", np.nan, r"means\[4, .*finite"),
        ("scale_1", np.inf, r"scales\[4, .*finite"),
        ("scale_1", -1e4, r"scales\[4, .*> 0"),
        ("opacity", np.nan, r"opacities\[4\] .*finite"),
        ("f_rest_3", np.nan, r"sh\[4, .*finite"),
    ],
)
def test_damaged_gaussians(tmp_path, caplog, column, value, message):
    """One of seven that is damaged is left out and counted; of two the file is refused, with array
    and index of the first."""
    table = vertices(random_scene(), tmp_path / "a.ply")
    table[column][4] = value
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    others = [0, 1, 2, 3, 5, 6]
    scene = read_ply(tmp_path / "b.ply")
    np.testing.assert_array_equal(scene.means, read_ply(tmp_path / "a.ply").means[others])
    assert "b.ply: 1 of 7 Gaussians are damaged and left out" in caplog.text
    table[column][5] = value
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    with pytest.raises(ValueError, match=r"b\.ply: 2 of 7 Gaussians are damaged; " + message):
        read_ply(tmp_path / "b.ply")


def test_surfels(tmp_path):
    """A file of surfels, which has two scales, gives Gaussians that are next to flat."""
    table = vertices(random_scene(), tmp_path / "a.ply", without=("scale_2",))
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    scene, flat = read_ply(tmp_path / "a.ply"), read_ply(tmp_path / "b.ply")
    np.testing.assert_array_equal(flat.scales[:, :2], scene.scales[:, :2])
    np.testing.assert_allclose(flat.scales[:, 2], 0.01 * scene.scales[:, :2].min(1), rtol=1e-6)


def test_failed_write_leaves_the_old_file_alone(tmp_path, monkeypatch):
    """A write that fails half-way leaves the old file whole and nothing beside it."""
    path = tmp_path / "scene.ply"
    write_ply(random_scene(), path)
    before = path.read_bytes()

    def write_half(self, stream):
        with open(stream, "wb") as file:
            file.write(b"ply\n")
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(PlyData, "write", write_half)
    with pytest.raises(OSError, match=r"scene\.ply: cannot be written \(No space left"):
        write_ply(random_scene(seed=1), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_unwritable_folder(tmp_path):
    """A folder that is not there is an error that names the file."""
    with pytest.raises(OSError, match=r"scene\.ply: cannot be written .*the folder writable"):
        write_ply(random_scene(), tmp_path / "nowhere" / "scene.ply")
