"""Files of Gaussians that other tools write, and what is taken for one."""

import dataclasses
import gzip
import os
import struct

import gsply
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.splats.scene import C0, GaussianScene
from splatpilot.systems.splats.splat_files import read_ply, read_splats, write_ply

N = 600  # more than two chunks of compressed PLY


def random_scene(degree: int) -> GaussianScene:
    """Gaussians whose colors and harmonics no format has to clamp."""
    rng = np.random.default_rng(degree)
    return GaussianScene(
        means=rng.uniform(-5, 5, (N, 3)).astype(np.float32),
        quats=rng.normal(size=(N, 4)).astype(np.float32),
        scales=np.exp(rng.uniform(-5, 0, (N, 3))).astype(np.float32),
        opacities=rng.uniform(0.05, 0.95, N).astype(np.float32),
        sh=rng.uniform(-0.9, 0.9, (N, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def foreign(scene: GaussianScene) -> gsply.GSData:
    """The same in gsply's form, of logarithms and logits."""
    a = scene.opacities
    return gsply.GSData.from_arrays(
        scene.means,
        np.log(scene.scales),
        scene.quats,
        np.log(a / (1 - a)),
        scene.sh[:, 0],
        scene.sh[:, 1:] if scene.sh.shape[1] > 1 else None,
        format="ply",
    )


def spz(version: int, count: int) -> bytes:
    """The header of an SPZ file, without harmonics, and 16 bytes of zeros."""
    return struct.pack("<4sII4B", b"NGSP", version, count, 0, 12, 0, 0) + bytes(16)


def assert_close(found: GaussianScene, scene: GaussianScene, mean, log_scale, quat, sh) -> None:
    """Equal but for the steps of a format, in any order."""
    order = np.argmin(
        np.linalg.norm(found.means[:, None] - scene.means[None], axis=2), axis=0
    )  # chunks sort
    assert len(np.unique(order)) == len(scene.means)
    np.testing.assert_allclose(found.means[order], scene.means, atol=mean)
    np.testing.assert_allclose(np.log(found.scales[order] / scene.scales), 0, atol=log_scale)
    same = np.abs((found.quats[order] * scene.quats).sum(axis=1))
    assert np.arccos(np.minimum(same, 1)).max() < quat
    np.testing.assert_allclose(found.opacities[order], scene.opacities, atol=0.003)
    assert found.sh.shape == scene.sh.shape
    np.testing.assert_allclose(found.sh[order], scene.sh, atol=sh)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_what_others_write(tmp_path, degree):
    scene = random_scene(degree)
    gsply.plywrite(tmp_path / "plain.ply", foreign(scene))
    assert_close(read_splats(tmp_path / "plain.ply"), scene, 1e-6, 1e-5, 2e-3, 1e-6)
    gsply.plywrite(tmp_path / "packed.compressed.ply", foreign(scene), compressed=True)
    assert_close(read_splats(tmp_path / "packed.compressed.ply"), scene, 0.006, 0.006, 0.004, 0.02)
    for version in (3, 4):
        turned = scene.transformed_by(RigidTransform(RotationMatrix.MakeXRotation(np.pi)))
        gsply.write_spz(tmp_path / "scene.spz", foreign(turned), version=version)
        assert_close(read_splats(tmp_path / "scene.spz"), scene, 0.0002, 0.032, 0.005, 0.015)


@pytest.mark.parametrize("degree", [0, 2])
def test_what_we_write(tmp_path, degree):
    scene = random_scene(degree)
    write_ply(scene, tmp_path / "ours.ply")
    data = gsply.plyread(tmp_path / "ours.ply")
    np.testing.assert_allclose(data.means, scene.means)
    np.testing.assert_allclose(np.exp(data.scales), scene.scales, rtol=1e-5)
    np.testing.assert_allclose(data.sh0, scene.sh[:, 0])


def test_records(tmp_path):
    record = struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 51, 204, 128, 228, 128, 128)
    (tmp_path / "a.splat").write_bytes(2 * record)
    scene = read_splats(tmp_path / "a.splat")
    np.testing.assert_allclose(scene.means, [[1, 2, 3]] * 2)
    np.testing.assert_allclose(scene.scales, [[0.1, 0.2, 0.3]] * 2, rtol=1e-6)
    np.testing.assert_allclose(0.5 + C0 * scene.sh[:, 0], [[1, 0, 0.2]] * 2, atol=1e-6)
    np.testing.assert_allclose(scene.opacities, 0.8, rtol=1e-6)
    np.testing.assert_allclose(scene.quats, [[0, 1, 0, 0]] * 2)
    (tmp_path / "a.splat").write_bytes(record + record[:-1])
    with pytest.raises(
        ValueError, match=r"a\.splat: the size must be a multiple of 32 bytes, got 63"
    ):
        read_splats(tmp_path / "a.splat")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", b"version https://git-lfs.github.com/spec/v1\noid ", "the pointer of git-LFS"),
        ("a.ply", b"", "the file is empty"),
        ("a.glb", b"glTF\x02\x00\x00\x00", "a binary glTF; convert it to PLY"),
        ("a.sog", b"PK\x03\x04", "a SOG; convert it to PLY"),
        ("a.zip", b"PK\x03\x04", "an archive; if it is SOG"),
        ("a.ksplat", bytes(64), "a KSPLAT; convert it to PLY"),
        ("a.spz", b"NGSP\x04\x00\x00\x00", "the header is truncated"),
        ("a.spz", spz(5, 9)[:16], "the version of SPZ must be 4 so compressed, got 5"),
        ("a.spz", spz(2, 9), "the version of SPZ must be 4 so compressed, got 2"),
        (
            "a.spz",
            gzip.compress(spz(4, 9), mtime=0),
            "the version of SPZ must be 2 or 3 so compressed, got 4",
        ),
        ("a.spz", spz(4, 9)[:16], "SPZ is not readable"),
        ("a.spz", spz(4, 9), "the section must be of 81 bytes, got 0"),
        ("a.spz", gzip.compress(b"something else entirely", mtime=0), "gzip of something"),
        (
            "a.spz",
            gzip.compress(spz(0, 9), mtime=0),
            "the version of SPZ must be 2 or 3 so compressed, got 0",
        ),
        ("a.spz", gzip.compress(spz(2, 9), mtime=0), "the section must be of 171 bytes, got 16"),
        ("a.spz", b"\x1f\x8b\x09\x00broken", "gzip is not readable"),
        ("a.ply", b"<!DOCTYPE html>", "a web page"),
        ("a.dat", b"nothing that is known", "not PLY, SPZ or .splat"),
    ],
)
def test_what_is_none(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name}: {message}"):
        read_splats(tmp_path / name)


def test_claims_of_size(tmp_path):
    for content in (gzip.compress(spz(3, 2**32 - 1), mtime=0), spz(4, 2**32 - 1)):
        (tmp_path / "a.spz").write_bytes(content)
        with pytest.raises(ValueError, match=r"a\.spz must take at most .* GB of memory"):
            read_splats(tmp_path / "a.spz")


def test_far_gaussians_are_read_about_an_origin(tmp_path, caplog):
    near = random_scene(1)
    write_ply(near, tmp_path / "near.ply")
    vertices = PlyData.read(tmp_path / "near.ply")["vertex"].data
    wide = vertices.astype([(name, "<f8") for name in vertices.dtype.names])
    far = np.array([456789.0, 5412345.0, 283.0])
    for axis, offset in zip("xyz", far, strict=True):
        wide[axis] += offset
    PlyData([PlyElement.describe(wide, "vertex")]).write(tmp_path / "far.ply")
    found = read_splats(tmp_path / "far.ply")
    np.testing.assert_allclose(found.means + found.origin, near.means + far, atol=1e-6)
    assert np.abs(found.means).max() < 10 and "far.ply: positions are relative to" in caplog.text
    assert read_splats(tmp_path / "near.ply").origin == (0, 0, 0)


def test_origin_turns_and_grows_with_its_gaussians():
    scene = dataclasses.replace(random_scene(0), origin=(1000.0, 2000.0, 3000.0))
    X = RigidTransform(RotationMatrix.MakeXRotation(np.pi / 2), [1, 1, 1])
    moved = scene.transformed_by(X).scaled_by(2)
    np.testing.assert_allclose(moved.origin, [2000, -6000, 4000])
    whole = 2 * X.multiply((scene.means.astype(float) + scene.origin).T).T
    np.testing.assert_allclose(moved.means + moved.origin, whole, atol=1e-3)


def small_scene(N: int = 7, K: int = 4, seed: int = 0) -> GaussianScene:
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
    scene = small_scene(N, K, seed)
    path = tmp_path_factory.mktemp("ply") / "scene.ply"
    write_ply(scene, path)
    assert_same(read_ply(path), scene)


def test_layout_is_that_of_the_original_code(tmp_path):
    scene = small_scene(N=3, K=4)
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
    below_one = np.nextafter(np.float32(1), np.float32(0))
    opacities = np.array([1.0, below_one, 0.5, 1e-30], dtype=np.float32)
    scene = small_scene(N=4)
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
    scene = small_scene(K=9)
    table = vertices(scene, tmp_path / "a.ply", without=("nx", "ny", "nz"))
    element = PlyElement.describe(table, "vertex")
    PlyData([element], text=text, byte_order=byte_order).write(str(tmp_path / "b.ply"))
    assert_same(read_ply(tmp_path / "b.ply"), scene)


def test_extreme_logits_are_read(tmp_path):
    table = vertices(small_scene(N=2), tmp_path / "a.ply")
    table["opacity"] = [500, -500]
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    opacities = read_ply(tmp_path / "b.ply").opacities
    assert opacities[0] == 1
    assert 0 < opacities[1] < 1e-30


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"No such file: .*nowhere\.ply"):
        read_ply(tmp_path / "nowhere.ply")


@pytest.mark.parametrize("missing", [1, 60, 300])
def test_truncated_file(tmp_path, missing):
    write_ply(small_scene(), tmp_path / "a.ply")
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
    (tmp_path / "b.ply").write_bytes(content)
    with pytest.raises(ValueError, match=r"b\.ply: not a readable PLY file"):
        read_ply(tmp_path / "b.ply")


def test_mesh(tmp_path):
    table = np.zeros(3, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("nx", "f4")])
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "mesh.ply"))
    with pytest.raises(
        ValueError, match=r"mesh\.ply: point cloud without Gaussians, missing f_dc_0"
    ):
        read_ply(tmp_path / "mesh.ply")
    face = PlyElement.describe(np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))]), "face")
    PlyData([PlyElement.describe(table, "vertex"), face]).write(str(tmp_path / "mesh.ply"))
    with pytest.raises(ValueError, match=r"mesh\.ply: mesh without Gaussians"):
        read_ply(tmp_path / "mesh.ply")
    PlyData([PlyElement.describe(table, "face")]).write(str(tmp_path / "faces.ply"))
    with pytest.raises(ValueError, match=r"faces\.ply: no element 'vertex'"):
        read_ply(tmp_path / "faces.ply")


def test_no_gaussians_at_all(tmp_path):
    table = vertices(small_scene(), tmp_path / "a.ply")[:0]
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    with pytest.raises(ValueError, match=r"b\.ply: the number of Gaussians must be >= 1, got 0"):
        read_ply(tmp_path / "b.ply")


@pytest.mark.parametrize("without", [("f_rest_8",), ("f_rest_0",), ("f_rest_0", "f_rest_1")])
def test_odd_number_of_coefficients(tmp_path, without):
    table = vertices(small_scene(), tmp_path / "a.ply", without)
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    with pytest.raises(
        ValueError, match=rf"f_rest_\* must be 0, 9, 24 or 45, from 0, got {9 - len(without)}"
    ):
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
    table = vertices(small_scene(), tmp_path / "a.ply")
    table[column][4] = value
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    others = [0, 1, 2, 3, 5, 6]
    scene = read_ply(tmp_path / "b.ply")
    np.testing.assert_array_equal(scene.means, read_ply(tmp_path / "a.ply").means[others])
    assert "b.ply: 1 of 7 Gaussians are invalid and dropped" in caplog.text
    table[column][5] = value
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    with pytest.raises(ValueError, match=r"b\.ply: 2 of 7 Gaussians are invalid; " + message):
        read_ply(tmp_path / "b.ply")


def test_surfels(tmp_path):
    table = vertices(small_scene(), tmp_path / "a.ply", without=("scale_2",))
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    scene, flat = read_ply(tmp_path / "a.ply"), read_ply(tmp_path / "b.ply")
    np.testing.assert_array_equal(flat.scales[:, :2], scene.scales[:, :2])
    np.testing.assert_allclose(flat.scales[:, 2], 0.01 * scene.scales[:, :2].min(1), rtol=1e-6)


def test_failed_write_leaves_the_old_file_alone(tmp_path, monkeypatch):
    path = tmp_path / "scene.ply"
    write_ply(small_scene(), path)
    before = path.read_bytes()

    def write_half(self, stream):
        with open(stream, "wb") as file:
            file.write(b"ply\n")
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(PlyData, "write", write_half)
    with pytest.raises(OSError, match=r"scene\.ply: cannot be written \(No space left"):
        write_ply(small_scene(seed=1), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_unwritable_folder(tmp_path):
    with pytest.raises(OSError, match=r"scene\.ply: cannot be written .*the folder writable"):
        write_ply(small_scene(), tmp_path / "nowhere" / "scene.ply")
