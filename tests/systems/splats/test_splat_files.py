import dataclasses
import gzip
import struct

import gsply
import numpy as np
import numpy.lib.recfunctions as rfn
import pytest
from baked_scenes import random_scene as small_scene
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.splats.scene import C0, GaussianScene
from splatpilot.systems.splats.splat_files import read_ply, read_splats, write_ply

N = 600  # more than two chunks of compressed PLY


def random_scene(degree: int) -> GaussianScene:
    # Colors and harmonics that no format clamps.
    rng = np.random.default_rng(degree)
    return GaussianScene(
        means=rng.uniform(-5, 5, (N, 3)).astype(np.float32),
        quats=rng.normal(size=(N, 4)).astype(np.float32),
        scales=np.exp(rng.uniform(-5, 0, (N, 3))).astype(np.float32),
        opacities=rng.uniform(0.05, 0.95, N).astype(np.float32),
        sh=rng.uniform(-0.9, 0.9, (N, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def foreign(scene: GaussianScene) -> gsply.GSData:
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
    return struct.pack("<4sII4B", b"NGSP", version, count, 0, 12, 0, 0) + bytes(16)


def assert_close(found: GaussianScene, scene: GaussianScene, mean, log_scale, quat, sh) -> None:
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
def test_files_of_other_tools(tmp_path, degree):
    scene = random_scene(degree)
    gsply.plywrite(tmp_path / "plain.ply", foreign(scene))
    assert_close(read_splats(tmp_path / "plain.ply"), scene, 1e-6, 1e-5, 2e-3, 1e-6)
    gsply.plywrite(tmp_path / "packed.compressed.ply", foreign(scene), compressed=True)
    assert_close(read_splats(tmp_path / "packed.compressed.ply"), scene, 0.006, 0.006, 0.004, 0.02)
    for version in (3, 4):
        turned = scene.transformed_by(RigidTransform(RotationMatrix.MakeXRotation(np.pi)))
        gsply.write_spz(tmp_path / "scene.spz", foreign(turned), version=version)
        assert_close(read_splats(tmp_path / "scene.spz"), scene, 0.0002, 0.032, 0.005, 0.015)


def test_records(tmp_path):
    record = struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 51, 204, 128, 228, 128, 128)
    (tmp_path / "a.splat").write_bytes(2 * record)
    scene = read_splats(tmp_path / "a.splat")
    np.testing.assert_allclose(scene.means, [[1, 2, 3]] * 2)
    np.testing.assert_allclose(scene.scales, [[0.1, 0.2, 0.3]] * 2, rtol=1e-6)
    np.testing.assert_allclose(0.5 + C0 * scene.sh[:, 0], [[1, 0, 0.2]] * 2, atol=1e-6)
    np.testing.assert_allclose(scene.opacities, 0.8, rtol=1e-6)
    np.testing.assert_allclose(scene.quats, [[0, 1, 0, 0]] * 2)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", b"version https://git-lfs.github.com/spec/v1\noid ", "the pointer of git-LFS"),
        ("a.ply", b"", "the size must be > 0 bytes"),
        ("a.dat", b"nothing that is known", "not PLY, SPZ or .splat"),
        ("a.glb", b"glTF\x02\x00\x00\x00", "a binary glTF; convert it to PLY"),
        ("a.sog", b"PK\x03\x04", "a SOG; convert it to PLY"),
        ("a.zip", b"PK\x03\x04", "an archive; if it is SOG"),
        ("a.ksplat", bytes(64), "a KSPLAT; convert it to PLY"),
        ("a.splat", bytes(63), "the size must be a multiple of 32 bytes, got 63"),
        ("a.spz", spz(5, 9)[:16], r".*the version must be 4, got 5"),
        ("a.spz", gzip.compress(spz(4, 9), mtime=0), r".*the version must be 2 or 3, got 4"),
        ("a.spz", spz(4, 9), "not a readable SPZ file"),
        ("a.spz", gzip.compress(spz(2, 9), mtime=0), r".*must be of 171 bytes, got 16"),
        ("a.spz", gzip.compress(spz(2, 0), mtime=0), "the number of Gaussians must be >= 1"),
        ("a.spz", gzip.compress(b"something else entirely", mtime=0), r".*of gzip must be SPZ"),
        ("a.spz", b"\x1f\x8b\x09\x00broken", "not a readable SPZ file"),
    ],
)
def test_other_files_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name}: {message}"):
        read_splats(tmp_path / name)


def test_declared_sizes_beyond_the_limit_are_refused(tmp_path):
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


def test_origin_moves_with_its_gaussians():
    scene = dataclasses.replace(random_scene(0), origin=(1000.0, 2000.0, 3000.0))
    X = RigidTransform(RotationMatrix.MakeXRotation(np.pi / 2), [1, 1, 1])
    moved = scene.transformed_by(X).scaled_by(2)
    np.testing.assert_allclose(moved.origin, [2000, -6000, 4000])
    whole = 2 * X.multiply((scene.means.astype(float) + scene.origin).T).T
    np.testing.assert_allclose(moved.means + moved.origin, whole, atol=1e-3)


def write_table(table: np.ndarray, path, name: str = "vertex", **options) -> None:
    PlyData([PlyElement.describe(table, name)], **options).write(str(path))


def assert_same(a: GaussianScene, b: GaussianScene) -> None:
    np.testing.assert_array_equal(a.means, b.means)
    np.testing.assert_array_equal(a.sh, b.sh)
    np.testing.assert_allclose(a.quats, b.quats, atol=2e-7)
    np.testing.assert_allclose(a.scales, b.scales, rtol=2e-6)
    np.testing.assert_allclose(a.opacities, b.opacities, rtol=2e-6)


@settings(max_examples=25, deadline=None)
@given(count=st.integers(1, 20), degree=st.integers(0, 3), seed=st.integers(0, 2**16))
def test_round_trip(tmp_path_factory, count, degree, seed):
    scene = small_scene(count, seed, degree)
    path = tmp_path_factory.mktemp("ply") / "scene.ply"
    write_ply(scene, path)
    assert_same(read_ply(path), scene)


def test_layout_is_that_of_the_original_code(tmp_path):
    scene = small_scene(3, sh_degree=1)
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


def test_extreme_opacities_are_written_and_read(tmp_path):
    below_one = np.nextafter(np.float32(1), np.float32(0))
    opacities = np.array([1.0, below_one, 0.5, 1e-30], dtype=np.float32)
    scene = dataclasses.replace(small_scene(4), opacities=opacities)
    table = vertices(scene, tmp_path / "scene.ply")
    back = read_ply(tmp_path / "scene.ply").opacities
    assert back[0] == 1
    np.testing.assert_allclose(back, scene.opacities, rtol=1e-5)
    table["opacity"][:2] = [500, -500]
    write_table(table, tmp_path / "b.ply")
    back = read_ply(tmp_path / "b.ply").opacities
    assert back[0] == 1 and 0 < back[1] < 1e-30


def vertices(scene: GaussianScene, path, without: tuple[str, ...] = ()) -> np.ndarray:
    write_ply(scene, path)
    data = PlyData.read(str(path))["vertex"].data
    kept = [name for name in data.dtype.names if name not in without]
    return rfn.repack_fields(data[kept])


@pytest.mark.parametrize(("text", "byte_order"), [(True, "="), (False, ">"), (False, "<")])
def test_reads_every_encoding_without_normals(tmp_path, text, byte_order):
    scene = small_scene(7, sh_degree=2)
    table = vertices(scene, tmp_path / "a.ply", without=("nx", "ny", "nz"))
    write_table(table, tmp_path / "b.ply", text=text, byte_order=byte_order)
    assert_same(read_ply(tmp_path / "b.ply"), scene)


@pytest.mark.parametrize("size", [0, 100, -60, -1])
def test_truncated_file(tmp_path, size):
    write_ply(small_scene(7, sh_degree=1), tmp_path / "a.ply")
    (tmp_path / "b.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:size])
    with pytest.raises(ValueError, match=r"b\.ply: not a readable PLY file"):
        read_ply(tmp_path / "b.ply")
    with pytest.raises(FileNotFoundError, match=r"No such file: .*nowhere\.ply"):
        read_ply(tmp_path / "nowhere.ply")


def test_mesh_or_points_or_nothing(tmp_path):
    points = np.zeros(3, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("nx", "f4")])
    vertex, face = (PlyElement.describe(points, name) for name in ("vertex", "face"))
    nothing = vertices(small_scene(7), tmp_path / "a.ply")[:0]
    for elements, message in (
        ([vertex], "point cloud without Gaussians, missing f_dc_0"),
        ([vertex, face], "mesh without Gaussians"),
        ([face], "no element 'vertex'"),
        ([PlyElement.describe(nothing, "vertex")], "number of Gaussians must be >= 1, got 0"),
    ):
        PlyData(elements).write(str(tmp_path / "b.ply"))
        with pytest.raises(ValueError, match=rf"b\.ply: .*{message}"):
            read_ply(tmp_path / "b.ply")


@pytest.mark.parametrize("without", [("f_rest_8",), ("f_rest_0",), ("f_rest_0", "f_rest_1")])
def test_odd_number_of_coefficients(tmp_path, without):
    table = vertices(small_scene(7, sh_degree=1), tmp_path / "a.ply", without)
    write_table(table, tmp_path / "b.ply")
    message = rf"f_rest_\* must be 0, 9, 24 or 45, from 0, got {9 - len(without)}"
    with pytest.raises(ValueError, match=message):
        read_ply(tmp_path / "b.ply")


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("y", np.nan, r"means\[4, .*finite"),
        ("scale_1", -1e4, r"scales\[4, .*> 0"),
        ("opacity", np.nan, r"opacities\[4\] .*finite"),
    ],
)
def test_damaged_gaussians(tmp_path, caplog, column, value, message):
    table = vertices(small_scene(7, sh_degree=1), tmp_path / "a.ply")
    table[column][4] = value
    write_table(table, tmp_path / "b.ply")
    others = [0, 1, 2, 3, 5, 6]
    scene = read_ply(tmp_path / "b.ply")
    np.testing.assert_array_equal(scene.means, read_ply(tmp_path / "a.ply").means[others])
    assert "b.ply: 1 of 7 Gaussians are invalid and dropped" in caplog.text
    table[column][5] = value
    write_table(table, tmp_path / "b.ply")
    with pytest.raises(ValueError, match=r"b\.ply: 2 of 7 Gaussians are invalid; " + message):
        read_ply(tmp_path / "b.ply")


def test_surfels(tmp_path):
    table = vertices(small_scene(7, sh_degree=1), tmp_path / "a.ply", without=("scale_2",))
    write_table(table, tmp_path / "b.ply")
    scene, flat = read_ply(tmp_path / "a.ply"), read_ply(tmp_path / "b.ply")
    np.testing.assert_array_equal(flat.scales[:, :2], scene.scales[:, :2])
    np.testing.assert_allclose(flat.scales[:, 2], 0.01 * scene.scales[:, :2].min(1), rtol=1e-6)
