"""Files of Gaussians that other tools write, and what is taken for one."""

import dataclasses
import gzip
import struct

import gsply
import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.splats.scene import C0, GaussianScene
from splatpilot.systems.splats.splat_files import read_splats, write_ply

N = 600  # more than two chunks of compressed PLY


def random_scene(degree: int) -> GaussianScene:
    """Gaussians whose colours and harmonics no format has to clamp."""
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
    """PLY, compressed PLY and SPZ of gsply hold what was given to it, to their steps; SPZ in other
    axes, which gsply leaves to its caller."""
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
    """gsply reads what we write."""
    scene = random_scene(degree)
    write_ply(scene, tmp_path / "ours.ply")
    data = gsply.plyread(tmp_path / "ours.ply")
    np.testing.assert_allclose(data.means, scene.means)
    np.testing.assert_allclose(np.exp(data.scales), scene.scales, rtol=1e-5)
    np.testing.assert_allclose(data.sh0, scene.sh[:, 0])


def test_records(tmp_path):
    """A `.splat` of 32 bytes a Gaussian: positions, sizes, colour, opacity and rotation."""
    record = struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 51, 204, 128, 228, 128, 128)
    (tmp_path / "a.splat").write_bytes(2 * record)
    scene = read_splats(tmp_path / "a.splat")
    np.testing.assert_allclose(scene.means, [[1, 2, 3]] * 2)
    np.testing.assert_allclose(scene.scales, [[0.1, 0.2, 0.3]] * 2, rtol=1e-6)
    np.testing.assert_allclose(0.5 + C0 * scene.sh[:, 0], [[1, 0, 0.2]] * 2, atol=1e-6)
    np.testing.assert_allclose(scene.opacities, 0.8, rtol=1e-6)
    np.testing.assert_allclose(scene.quats, [[0, 1, 0, 0]] * 2)
    (tmp_path / "a.splat").write_bytes(record + record[:-1])
    with pytest.raises(ValueError, match=r"a\.splat: 63 bytes are no multiple of the 32"):
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
        ("a.spz", b"NGSP\x04\x00\x00\x00", "the header is cut short"),
        ("a.spz", spz(5, 9)[:16], "SPZ of version 5; 2 to 4"),
        ("a.spz", spz(2, 9), "says that it is SPZ of version 2, whose files are compressed as one"),
        ("a.spz", gzip.compress(spz(4, 9)), "says that it is SPZ of version 4, .* are no gzip"),
        ("a.spz", spz(4, 9)[:16], "not readable SPZ"),
        ("a.spz", spz(4, 9), "0 bytes stand where 81 belong"),
        ("a.spz", gzip.compress(b"something else entirely"), "gzip of something that is not SPZ"),
        ("a.spz", gzip.compress(spz(0, 9)), "SPZ of version 0; 2 to 4"),
        ("a.spz", gzip.compress(spz(2, 9)), "16 bytes stand where 171 belong"),
        ("a.spz", b"\x1f\x8b\x09\x00broken", "not readable gzip"),
        ("a.ply", b"<!DOCTYPE html>", "a page"),
        ("a.dat", b"nothing that is known", "neither PLY, SPZ nor .splat"),
    ],
)
def test_what_is_none(tmp_path, name, content, message):
    """What is no file of Gaussians that we read is called what it is."""
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name}: {message}"):
        read_splats(tmp_path / name)


def test_claims_of_size(tmp_path):
    """A file of a hundred bytes that claims four thousand million Gaussians costs no memory."""
    for content in (gzip.compress(spz(3, 2**32 - 1)), spz(4, 2**32 - 1)):
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
