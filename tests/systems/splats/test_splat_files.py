import dataclasses
import gzip
import io
import json
import struct
import zipfile

import gsply
import numpy as np
import numpy.lib.recfunctions as rfn
import pytest
from baked_scenes import random_scene as small_scene
from PIL import Image
from plyfile import PlyData, PlyElement
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_files import read_ply, read_splats, write_ply, write_splats

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
    logits = np.log(scene.opacities / (1 - scene.opacities))
    shape = scene.means, np.log(scene.scales), scene.quats, logits
    higher = scene.sh[:, 1:] if scene.sh.shape[1] > 1 else None
    return gsply.GSData.from_arrays(*shape, scene.sh[:, 0], higher, format="ply")


def from_foreign(data: gsply.GSData) -> GaussianScene:
    opacities = 1 / (1 + np.exp(-data.opacities))
    sh = data.sh0[:, None]
    if data.shN is not None:
        sh = np.concatenate([sh, data.shN], axis=1)
    return GaussianScene(data.means, data.quats, np.exp(data.scales), opacities, sh)


def spz(version: int, count: int, zipped: bool = True) -> bytes:
    content = struct.pack("<4sII4B", b"NGSP", version, count, 0, 12, 0, 0) + bytes(16)
    return gzip.compress(content, mtime=0) if zipped else content


def assert_close(found: GaussianScene, scene: GaussianScene, mean, log_scale, quat, sh) -> None:
    # Chunks sort.
    order = np.linalg.norm(found.means[:, None] - scene.means[None], axis=2).argmin(axis=0)
    assert len(np.unique(order)) == len(scene.means)
    np.testing.assert_allclose(found.means[order], scene.means, atol=mean)
    np.testing.assert_allclose(np.log(found.scales[order] / scene.scales), 0, atol=log_scale)
    same = np.abs((found.quats[order] * scene.quats).sum(axis=1))
    assert np.arccos(np.minimum(same, 1)).max() < quat
    np.testing.assert_allclose(found.opacities[order], scene.opacities, atol=0.003)
    assert found.sh.shape == scene.sh.shape
    np.testing.assert_allclose(found.sh[order], scene.sh, atol=sh)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_files_of_and_for_other_tools(tmp_path, degree):
    scene = random_scene(degree)
    exact, chunks = (1e-6, 1e-5, 2e-3, 1e-6), (0.006, 0.006, 0.004, 0.02)
    spz = 0.0002, 0.032, 0.005, 0.015
    gsply.plywrite(tmp_path / "plain.ply", foreign(scene))
    assert_close(read_splats(tmp_path / "plain.ply"), scene, *exact)
    write_splats(scene, tmp_path / "ours.ply")
    assert_close(from_foreign(gsply.plyread(tmp_path / "ours.ply")), scene, *exact)
    gsply.plywrite(tmp_path / "packed.compressed.ply", foreign(scene), compressed=True)
    assert_close(read_splats(tmp_path / "packed.compressed.ply"), scene, *chunks)
    rotated = scene.transformed_by(RigidTransform(RotationMatrix.MakeXRotation(np.pi)))
    for version in (3, 4):
        gsply.write_spz(tmp_path / "scene.spz", foreign(rotated), version=version)
        assert_close(read_splats(tmp_path / "scene.spz"), scene, *spz)
    write_splats(scene, tmp_path / "ours.spz")
    assert_close(read_splats(tmp_path / "ours.spz"), scene, *spz)
    assert_close(from_foreign(gsply.read_spz(tmp_path / "ours.spz")), rotated, *spz)


def webp(rows: np.ndarray, width: int = 32) -> bytes:
    """Returns rows (N, 3 or 4) as a picture, opaque if of 3; its last pixels are unused."""
    picture = np.full((-(-len(rows) // width) * width, 4), 255, np.uint8)
    picture[: len(rows), : rows.shape[1]] = rows
    stream = io.BytesIO()
    Image.fromarray(picture.reshape(-1, width, 4)).save(stream, "WEBP", lossless=True, exact=True)
    return stream.getvalue()


def sog(scene: GaussianScene, version: int) -> dict[str, bytes]:
    """Returns the files of PlayCanvas's published format; harmonics of degree 1 repeat 64 times."""
    meta, files = {"version": 2, "count": N, "antialias": True} if version == 2 else {}, {}

    def add(part: str, *pictures: bytes, **about) -> None:
        names = [f"{part}_{i}.webp" for i in range(len(pictures))]
        files.update(zip(names, pictures, strict=True))
        meta[part] = about | {"files": names}

    logs = np.sign(scene.means) * np.log1p(np.abs(scene.means))
    lower, upper = logs.min(0), logs.max(0)
    words = np.round((logs - lower) / (upper - lower) * 65535).astype(int)
    bounds = {"mins": lower.tolist(), "maxs": upper.tolist(), "shape": [N, 3]}
    add("means", webp(words & 255), webp(words >> 8), **bounds)
    order = np.abs(scene.quats).argmax(1)
    quats = scene.quats * np.sign(np.take_along_axis(scene.quats, order[:, None], 1))
    small = np.stack([np.delete(q, k) for q, k in zip(quats, order, strict=True)])
    rotation = np.round((small * np.sqrt(2) + 1) * 127.5).clip(0, 255)
    add("quats", webp(np.column_stack([rotation, order + 252])))
    a = scene.opacities[:, None]
    last = a if version == 2 else np.log(a / (1 - a))
    for name, values in (
        ("scales", np.log(scene.scales)),
        ("sh0", np.hstack([scene.sh[:, 0], last])),
    ):
        low, high = values.min(0), values.max(0)
        about = {"mins": low.tolist(), "maxs": high.tolist()}
        if version == 2:
            low, high = (np.array([end] * 3 + [end > 0])[: len(low)] for end in (-7.0, 7.0))
            about = {"codebook": np.linspace(-7, 7, 256).tolist()}
        add(name, webp(np.round((values - low) / (high - low) * 255)), **about)
    centroids = np.round((scene.sh[:64, 1:4] + 1) * 127.5).reshape(-1, 3)
    labels = np.column_stack([np.arange(N) % 64, np.zeros((N, 2))])
    about = {"codebook": np.linspace(-1, 1, 256).tolist()} if version == 2 else {}
    add("shN", webp(centroids, width=192), webp(labels), mins=-1, maxs=1, **about)
    return files | {"meta.json": json.dumps(meta).encode()}


@pytest.mark.parametrize("version", [1, 2])
def test_sog_archives_and_folders(tmp_path, version):
    scene = random_scene(1)
    repeated = np.concatenate([scene.sh[:, :1], scene.sh[np.arange(N) % 64, 1:]], axis=1)
    scene = dataclasses.replace(scene, sh=repeated)
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        for name, content in sog(scene, version).items():
            archive.writestr(name, content)
            (tmp_path / name).write_bytes(content)
    for path in (tmp_path / "a.sog", tmp_path / "meta.json", tmp_path):
        found = read_splats(path)
        assert_close(found, scene, 0.001, 0.03, 0.02, 0.03)
        assert found.antialiased == (version == 2)


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".usda", ".usdc"])
@pytest.mark.parametrize("degree", [0, 3])
def test_gltf_and_usd_round_trip(tmp_path, suffix, degree):
    scene = dataclasses.replace(random_scene(degree), origin=(456789.0, 5412345.0, 283.0))
    write_splats(scene, tmp_path / f"a{suffix}")
    found = read_splats(tmp_path / f"a{suffix}")
    shift = np.array(found.origin) - scene.origin
    np.testing.assert_allclose(found.means + shift, scene.means, atol=2e-6)
    for name in ("scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(found, name), getattr(scene, name), atol=1e-6)
    np.testing.assert_allclose(np.abs((found.quats * scene.quats).sum(1)), 1, atol=1e-6)


def test_gltf_is_y_up_and_its_nodes_transform(tmp_path):
    scene, half = random_scene(1), np.sqrt(0.5)
    write_splats(scene, tmp_path / "a.gltf")
    document = json.loads((tmp_path / "a.gltf").read_text())
    low = document["accessors"][0]["min"]  # of POSITION
    np.testing.assert_allclose(low[:2], [scene.means[:, 0].min(), scene.means[:, 2].min()])
    inner = {"mesh": 0, "scale": [1, 1, 3]}
    document["nodes"] = [{"children": [1], "rotation": [0, half, 0, half], "scale": [2] * 3}, inner]
    (tmp_path / "b.gltf").write_text(json.dumps(document))
    found = read_splats(tmp_path / "b.gltf")
    # y of glTF is z of W, and its -z is y.
    M = RotationMatrix.MakeZRotation(np.pi / 2).matrix() @ np.diag([2.0, 6.0, 2.0])
    np.testing.assert_allclose(found.means, scene.means @ M.T, atol=1e-5)
    np.testing.assert_allclose(found.covariances, M @ scene.covariances @ M.T, atol=2e-5, rtol=1e-4)
    del document["scene"], document["scenes"]
    (tmp_path / "b.gltf").write_text(json.dumps(document))
    np.testing.assert_array_equal(read_splats(tmp_path / "b.gltf").means, found.means)


def test_gltf_of_linear_colors_is_refused(tmp_path):
    write_splats(random_scene(0), tmp_path / "a.gltf")
    text = (tmp_path / "a.gltf").read_text().replace("srgb_rec709_display", "lin_rec709_display")
    (tmp_path / "a.gltf").write_text(text)
    with pytest.raises(ValueError, match=r"colorSpace must be srgb_.*, got lin_rec709_display"):
        read_splats(tmp_path / "a.gltf")


def test_usd_of_other_units_axes_and_defaults(tmp_path):
    (tmp_path / "a.usda").write_text(
        """#usda 1.0
(
    metersPerUnit = 0.01
    upAxis = "Y"
)
def Xform "World" {
    double3 xformOp:translate = (0, 100, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def ParticleField3DGaussianSplat "Splats" {
        half3[] scalesh = [(1, 2, 4)]
        point3f[] positions = [(100, 200, 300)]
        quatf[] orientations = [(0.8, 0.6, 0, 0)]
    }
}"""
    )
    found = read_splats(tmp_path / "a.usda")
    np.testing.assert_allclose(found.means, [[1, -3, 3]], atol=1e-6)
    np.testing.assert_allclose(found.scales, [[0.01, 0.02, 0.04]], rtol=1e-5)
    R = RotationMatrix.MakeXRotation(np.pi / 2 + 2 * np.arctan2(0.6, 0.8)).matrix()
    np.testing.assert_allclose(found.rotations[0], R, atol=1e-6)


def test_antialiased_gaussians_of_ply_and_spz(tmp_path, caplog):
    scene = dataclasses.replace(random_scene(0), antialiased=True)
    for name in ("a.ply", "d.spz", "d.glb"):
        write_splats(scene, tmp_path / name)
    ply = PlyData.read(tmp_path / "a.ply")
    ply.comments = ["antialiased 1"]
    ply.write(tmp_path / "b.ply")
    gsply.write_spz(tmp_path / "c.spz", foreign(scene), version=3)
    for name, antialiased in (("a.ply", 1), ("b.ply", 1), ("c.spz", 0), ("d.spz", 1), ("d.glb", 0)):
        assert read_splats(tmp_path / name).scaled_by(2).antialiased == antialiased
    assert "d.glb: cannot record that Gaussians were trained antialiased" in caplog.text


def test_filter_of_mip_splatting_blurs_each_gaussian(tmp_path):
    scene = random_scene(0)
    table = vertices(scene, tmp_path / "a.ply")
    blur = np.full(N, 0.05, np.float32)
    write_table(rfn.append_fields(table, "filter_3D", blur, usemask=False), tmp_path / "b.ply")
    found = read_splats(tmp_path / "b.ply")
    scales = np.sqrt(scene.scales**2 + 0.05**2)
    np.testing.assert_allclose(found.scales, scales, rtol=1e-5)
    opacities = scene.opacities * (scene.scales / scales).prod(axis=1)
    np.testing.assert_allclose(found.opacities, opacities, rtol=1e-4)


def test_activated_values_are_reported(tmp_path, caplog):
    table = vertices(random_scene(0), tmp_path / "a.ply")
    read_splats(tmp_path / "a.ply")
    assert not caplog.text
    for name in ("scale_0", "scale_1", "scale_2"):
        table[name] = np.exp(table[name])
    table["opacity"] = 1 / (1 + np.exp(-table["opacity"]))
    write_table(table, tmp_path / "b.ply")
    read_splats(tmp_path / "b.ply")
    assert "b.ply: all opacities are in [0, 1] and all scales > 0" in caplog.text


def test_records(tmp_path):
    record = struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 51, 204, 128, 228, 128, 128)
    (tmp_path / "a.splat").write_bytes(2 * record)
    scene = read_splats(tmp_path / "a.splat")
    np.testing.assert_allclose(scene.means, [[1, 2, 3]] * 2)
    np.testing.assert_allclose(scene.scales, [[0.1, 0.2, 0.3]] * 2, rtol=1e-6)
    np.testing.assert_allclose(scene.base_colors, [[1, 0, 0.2]] * 2, atol=1e-6)
    np.testing.assert_allclose(scene.opacities, 0.8, rtol=1e-6)
    np.testing.assert_allclose(scene.quats, [[0, 1, 0, 0]] * 2)


COMPRESSED = b'{"extensionsUsed": ["KHR_gaussian_splatting", "KHR_meshopt_compression"]}'


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", b"version https://git-lfs.github.com/spec/v1\noid ", "the pointer of git-LFS"),
        ("a.ply", b"", "the size must be > 0 bytes"),
        ("a.dat", b"nothing that is known", "not PLY, SPZ, SOG, .splat, glTF or USD; convert"),
        ("a.glb", b"glTF\x02\x00\x00\x00", "not a readable glTF file"),
        ("a.gltf", b'{"asset": {"version": "2.0"}}', "a glTF without KHR_gaussian_splatting"),
        ("a.gltf", COMPRESSED, "compressed by KHR_meshopt_compression"),
        ("a.usda", b"#usda 1.0\n", "a USD file without ParticleField3DGaussianSplat"),
        ("a.sog", b"PK\x03\x04", "not a readable SOG archive"),
        ("a.zip", b"PK\x03\x04", "an archive; unpack it first"),
        ("a.ot", b"# Octomap OcTree file\n", "a full OctoMap; write it as .bt"),
        ("a.ksplat", bytes(64), "a KSPLAT; convert it to PLY"),
        ("a.splat", bytes(63), "the size must be a multiple of 32 bytes, got 63"),
        ("a.spz", spz(5, 9, False)[:16], r".*the version must be 4, got 5"),
        ("a.spz", spz(4, 9), r".*the version must be 2 or 3, got 4"),
        ("a.spz", spz(4, 9, False), "not a readable SPZ file"),
        ("a.spz", spz(2, 9), r".*must be of 171 bytes, got 16"),
        ("a.spz", spz(2, 0), "the number of Gaussians must be >= 1"),
        ("a.spz", gzip.compress(b"something else entirely", mtime=0), r".*of gzip must be SPZ"),
        ("a.spz", b"\x1f\x8b\x09\x00broken", "not a readable SPZ file"),
        ("a.spz", spz(3, 2**32 - 1), r"must take at most .* GB of memory"),
        ("a.spz", spz(4, 2**32 - 1, False), r"must take at most .* GB of memory"),
    ],
)
def test_other_files_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name}:? {message}"):
        read_splats(tmp_path / name)


def test_far_gaussians_are_read_about_an_origin(tmp_path, caplog):
    near, far = vertices(random_scene(1), tmp_path / "near.ply"), (456789.0, 5412345.0, 283.0)
    wide = near.astype([(name, "<f8") for name in near.dtype.names])
    for axis, offset in zip("xyz", far, strict=True):
        wide[axis] += offset
    write_table(wide, tmp_path / "far.ply")
    expected, found = read_splats(tmp_path / "near.ply"), read_splats(tmp_path / "far.ply")
    np.testing.assert_allclose(found.means + found.origin, expected.means + far, atol=1e-6)
    assert np.abs(found.means).max() < 10 and "far.ply: positions are relative to" in caplog.text
    assert expected.origin == (0, 0, 0)


def test_origin_moves_with_its_gaussians():
    scene = dataclasses.replace(random_scene(0), origin=(1000.0, 2000.0, 3000.0))
    X = RigidTransform(RotationMatrix.MakeXRotation(np.pi / 2), [1, 1, 1])
    moved = scene.transformed_by(X).scaled_by(2)
    np.testing.assert_allclose(moved.origin, [2000, -6000, 4000])
    whole = 2 * X.multiply((scene.means.astype(float) + scene.origin).T).T
    np.testing.assert_allclose(moved.means + moved.origin, whole, atol=1e-3)


def write_table(table: np.ndarray, path, **options) -> None:
    PlyData([PlyElement.describe(table, "vertex")], **options).write(str(path))


def test_extreme_opacities_are_written_and_read(tmp_path):
    opacities = np.array([1.0, np.nextafter(np.float32(1), 0), 0.5, 1e-30], dtype=np.float32)
    table = vertices(dataclasses.replace(small_scene(4), opacities=opacities), tmp_path / "a.ply")
    back = read_ply(tmp_path / "a.ply").opacities
    assert back[0] == 1
    np.testing.assert_allclose(back, opacities, rtol=1e-5)
    table["opacity"][:2] = [500, -500]
    write_table(table, tmp_path / "b.ply")
    back = read_ply(tmp_path / "b.ply").opacities
    assert back[0] == 1 and 0 < back[1] < 1e-30


def vertices(scene: GaussianScene, path, without: tuple[str, ...] = ()) -> np.ndarray:
    write_ply(scene, path)
    data = PlyData.read(str(path))["vertex"].data
    kept = [name for name in data.dtype.names if name not in without]
    return rfn.repack_fields(data[kept])


@pytest.mark.parametrize(
    ("text", "byte_order", "degree", "without"),
    [(True, "=", 0, ("nx", "ny", "nz")), (False, ">", 1, ("nx", "ny", "nz")), (False, "<", 2, ())],
)
def test_ply_is_read_in_every_encoding_as_written(tmp_path, text, byte_order, degree, without):
    scene = small_scene(7, sh_degree=degree)
    table = vertices(scene, tmp_path / "a.ply", without)
    write_table(table, tmp_path / "b.ply", text=text, byte_order=byte_order)
    found = read_ply(tmp_path / "b.ply")
    np.testing.assert_array_equal(found.means, scene.means)
    np.testing.assert_array_equal(found.sh, scene.sh)
    np.testing.assert_allclose(found.quats, scene.quats, atol=2e-7)
    for name in ("scales", "opacities"):
        np.testing.assert_allclose(getattr(found, name), getattr(scene, name), rtol=2e-6)


@pytest.mark.parametrize(
    ("elements", "without", "kept", "message"),
    [
        (["vertex"], (), slice(0), "the number of Gaussians must be >= 1, got 0"),
        (["vertex"], ("f_dc_0", "rot_3"), slice(7), "point cloud .*, missing f_dc_0, rot_3"),
        (["vertex", "face"], ("f_dc_0",), slice(7), "mesh without Gaussians"),
        (["face"], (), slice(7), "no element 'vertex'"),
        (["vertex"], ("f_rest_8",), slice(7), r"f_rest_\* must be 0, 9, .* got 8"),
        (["vertex"], ("f_rest_0",), slice(7), r"f_rest_\* must be 0, 9, .* got 8"),
        (["vertex"], ("f_rest_0", "f_rest_1"), slice(7), r"f_rest_\* must be 0, 9, .* got 7"),
    ],
)
def test_ply_without_gaussians_is_refused(tmp_path, elements, without, kept, message):
    table = vertices(small_scene(7, sh_degree=1), tmp_path / "a.ply", without)[kept]
    content = [PlyElement.describe(table, name) for name in elements]
    PlyData(content).write(str(tmp_path / "b.ply"))
    with pytest.raises(ValueError, match=rf"b\.ply: .*{message}"):
        read_ply(tmp_path / "b.ply")


def test_missing_and_truncated_files_and_unknown_suffixes_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"No such file: .*nowhere\.ply"):
        read_ply(tmp_path / "nowhere.ply")
    write_ply(small_scene(7, sh_degree=1), tmp_path / "a.ply")
    for size in (0, 100, -60, -1):
        (tmp_path / "b.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:size])
        with pytest.raises(ValueError, match=r"b\.ply: not a readable PLY file"):
            read_ply(tmp_path / "b.ply")
    with pytest.raises(ValueError, match=r"a\.sog: the suffix must be one of \.ply, .*\.usdc"):
        write_splats(small_scene(7), tmp_path / "a.sog")


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
