import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

import splatpilot as sp
from splatpilot.analysis.commands.main import main
from splatpilot.analysis.reconstruction.rescale import rescale, run
from splatpilot.diagrams.worlds import scene_folder
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.training.captures.capture_registry import read_scene_capture

SHRUNK = 0.25  # units of files per meter


@pytest.fixture
def photographs(seen_room, write_nerfstudio, tmp_path):
    """The room in nerfstudio's format without depth, in units of unknown length, with points."""
    _, capture = seen_room
    path = tmp_path / "photographs"
    content = write_nerfstudio(path, capture, scale=SHRUNK)
    cloud = trimesh.PointCloud(SHRUNK * capture.points.p_WQ, colors=(90, 90, 90))
    cloud.export(path / "points.ply")
    content["ply_file_path"] = "points.ply"
    (path / "transforms.json").write_text(json.dumps(content))
    return path


@pytest.fixture
def unscaled(seen_room, photographs, tmp_path):
    """The room as a scene of photographs; space behind the cameras is unknown."""
    occupied, unknown = np.zeros((2, 60, 30, 25), bool)
    occupied[5:, :, 0] = True
    unknown[:5] = True
    field = esdf_from_occupancy(occupied, unknown, np.zeros(3), 0.1 * SHRUNK)
    gaussians, end = seen_room[0].scaled_by(SHRUNK), np.full(3, SHRUNK)
    world = sp.World("room", gaussians, field, field, (0.1, 0.2, 0.3), end, end)
    source = {"capture": str(photographs), "gains": [1.0] * 16, "held_out": [0, 8]}
    source |= {"split": "validation", "source_digest": ["0123456789abcdef"], "metric": False}
    path = tmp_path / "unscaled"
    scene_folder.write_scene_folder(path, world, provenance="photographs", **source)
    return path


def scale(*words) -> int:
    return main(["scene", "scale", *map(str, words)])


def test_scene_of_photographs_can_be_flown_in_at_its_scale(unscaled, seen_room, tmp_path, capsys):
    with pytest.raises(ValueError, match=r"splatpilot view .* `splatpilot scene scale`"):
        scene_folder.read_scene(unscaled)
    before = {file.name: file.read_bytes() for file in unscaled.iterdir()}
    out = tmp_path / "scaled"
    points = "-0.1,0.2,0.3", "1.4,.2,.3"
    assert scale(unscaled, "--out", out, "--between", *points, "--distance", "6") == 0
    assert "6 x 3 x 2.5 m" in capsys.readouterr().out
    assert {file.name: file.read_bytes() for file in unscaled.iterdir()} == before

    old, new = scene_folder.read_scene_folder(unscaled, metric=False), scene_folder.read_scene(out)
    gaussians, capture = seen_room
    np.testing.assert_allclose(new.gaussians.means[: len(gaussians)], gaussians.means, atol=1e-5)
    metadata = scene_folder.read_scene_metadata(out)
    assert (metadata.split, metadata.source_digest) == ("validation", ["0123456789abcdef"])
    assert (metadata.held_out, metadata.gains) == ([0, 8], [1.0] * 16)
    assert "scaled by 4" in metadata.provenance
    again = read_scene_capture(out, metadata)
    assert again.metric
    for i in (0, 15):
        assert again.X_WCs[i].IsNearlyEqualTo(capture.X_WCs[i], 1e-9)
    # The near end is closed.
    assert metadata.frontier and (new.esdf.states == old.esdf.states).mean() > 0.9
    free = old.esdf.states == sp.FieldState.FREE
    assert (new.esdf.distances <= old.esdf.distances / SHRUNK + 1e-5)[free].all()
    occupied = (np.sum(world.esdf.states == sp.FieldState.OCCUPIED) for world in (old, new))
    assert next(occupied) < next(occupied)
    assert np.linalg.norm(new.p_WG - new.p_WS) > 1.0


def test_factors_multiply(unscaled, tmp_path):
    metadata = scene_folder.read_scene_metadata(unscaled)
    metadata = replace(metadata, origin=[100.0, 200.0, -30.0])
    scene_folder.write_scene_metadata(unscaled, metadata)
    poses = read_scene_capture(unscaled, metadata).X_WCs
    rescale(unscaled, tmp_path / "once", 4.0)
    summary = rescale(tmp_path / "once", tmp_path / "twice", 0.5)
    once, twice = (scene_folder.read_scene(tmp_path / name) for name in ("once", "twice"))
    np.testing.assert_array_equal(twice.esdf.distances, 0.5 * once.esdf.distances)
    np.testing.assert_array_equal(twice.esdf.states, once.esdf.states)
    np.testing.assert_allclose(twice.gaussians.scales, 0.5 * once.gaussians.scales, rtol=1e-6)
    np.testing.assert_allclose(summary.size, [3, 1.5, 1.25])
    metadata = scene_folder.read_scene_metadata(tmp_path / "twice")
    assert metadata.capture_settings == ["scale.factor=2.0"]
    assert metadata.origin == [200.0, 400.0, -60.0]
    for X, Y in zip(poses, read_scene_capture(tmp_path / "twice", metadata).X_WCs, strict=True):
        np.testing.assert_allclose(Y.translation(), 2 * X.translation(), atol=1e-9)


def test_height_of_the_cameras_gives_the_scale(unscaled, tmp_path):
    summary = run(scene=unscaled, out=tmp_path / "scaled", height=1.2)
    assert summary.factor == pytest.approx(1 / SHRUNK, rel=0.02)


def test_scene_of_metric_depth_forgets_its_capture(room, tmp_path):
    summary = rescale(room.scene("metric"), tmp_path / "scaled", 2.0)
    assert "has metric depth" in str(summary)
    metadata = scene_folder.read_scene_metadata(tmp_path / "scaled")
    assert (metadata.capture, metadata.held_out, metadata.gains) == ("", [], [])


@pytest.mark.parametrize("up", ["z", "-z", "y", "-y", "x", "-x"])
def test_file_in_meters_and_upright(seen_room, tmp_path, up):
    gaussians, capture = seen_room
    along = "xyz".index(up[-1])
    up_F = np.eye(3)[along] * (-1 if up.startswith("-") else 1)
    x_F = np.roll(np.eye(3)[along], 1)
    R_FW = RotationMatrix(np.column_stack([x_F, np.cross(up_F, x_F), up_F]))
    file, out = tmp_path / "file.ply", tmp_path / "upright.ply"
    sp.write_ply(gaussians.scaled_by(SHRUNK).transformed_by(RigidTransform(R_FW)), file)
    assert scale(file, "--out", out, "--up", up, "--factor", 1 / SHRUNK) == 0
    found = sp.read_ply(out)
    np.testing.assert_allclose(found.means[:, 2], gaussians.means[:, 2], atol=1e-5)
    a, b = (means[:, 0] + 1j * means[:, 1] for means in (gaussians.means, found.means))
    X_WV = RigidTransform(RotationMatrix.MakeZRotation(float(np.angle(np.vdot(a, b)))))
    # Askew, for Gaussians of a wall seen squarely have one depth, and may change their order.
    X_WC = capture.X_WCs[3] @ RigidTransform(RollPitchYaw(0.11, 0.23, 0.37), np.zeros(3))
    before = sp.BakedScene(gaussians).render(capture.K, 64, 48, X_WC)
    after = sp.BakedScene(found).render(capture.K, 64, 48, X_WV @ X_WC)
    assert np.abs(after.color - before.color).mean() < 1e-3
    assert np.quantile(np.abs(after.depth / before.depth - 1), 0.95) < 1e-3


def test_tilted_file_becomes_level(seen_room, tmp_path):
    gaussians, _ = seen_room
    X_FW = RigidTransform(RollPitchYaw(0.3, -0.2, 0.5), [1.0, 2.0, 3.0])
    file = tmp_path / "file.ply"
    sp.write_ply(gaussians.transformed_by(X_FW), file)
    lowest = gaussians.means[:, 2].min()
    corners = [X_FW @ np.array([x, y, lowest]) for x, y in ((0, 0), (3, 0.5), (0.5, 2))]
    for k, points in enumerate((corners, corners[::-1])):
        words = [",".join(str(x) for x in point) for point in points]
        assert scale(file, "--out", tmp_path / f"{k}.ply", "--floor", *words, "--factor", 2) == 0
        heights = sp.read_ply(tmp_path / f"{k}.ply").means[:, 2]
        np.testing.assert_allclose(heights, 2 * (gaussians.means[:, 2] - lowest), atol=2e-5)


def test_length_in_a_file(seen_room, tmp_path, capsys):
    file, out = tmp_path / "file.ply", tmp_path / "b.ply"
    sp.write_ply(seen_room[0], file)
    summary = run(scene=file, out=out, between=[[0, 0, 0], [0, 2, 0]], distance=3.0, up="z")
    assert summary.factor == 1.5
    np.testing.assert_allclose(sp.read_ply(out).means, 1.5 * seen_room[0].means, rtol=1e-6)
    assert run(scene=file, out=tmp_path / "c.ply", up="-z").factor == 1.0
    assert f"Gaussians          {len(seen_room[0])}\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("room.ply --out out.ply", "what is its size? Give --factor"),
        ("room.ply --out out.sog --factor 2", "out.sog: the suffix must be one of .ply, "),
        ("room.ply --out out.ply --height 2", "a file has no cameras"),
        ("room.ply --out out.ply --factor 0", "factor must be finite and > 0, got 0"),
        ("room.ply --out out.ply --floor 0,0,0 1,0,0 2,0,0", "lie in a line"),
        ("room.ply --out out.ply --floor 0,0,0 1,0,0 0,0,1", "at 90 degrees"),
        ("room.ply --out out.ply --floor 0,0,0 1,0 0,0,1", "X,Y,Z, got '1,0'"),
        ("a.ksplat --out out.ply --up y", "a.ksplat: a KSPLAT"),
        ("unscaled --out unscaled --factor 2", "unscaled: exists already"),
        ("unscaled --out out --up -y", "z is up in scene folders; leave --up"),
        ("unscaled --out out --height nan", "height must be finite and > 0, got nan"),
        ("unscaled --out out --between 0,0,0 0,0,0 --distance 1", "--between must differ"),
        ("unscaled --out out --between 0,0,1 0,0,0", "--between and --distance belong together"),
    ],
)
def test_invalid_scales_are_refused(room, unscaled, monkeypatch, capsys, words, message):
    folder = room.folder
    monkeypatch.chdir(folder)
    (folder / "room.ply").write_bytes((unscaled / "gaussians.ply").read_bytes())
    (folder / "a.ksplat").write_bytes(bytes(64))
    before = sorted(folder.iterdir())
    assert scale(*words.split()) == 1
    assert message in capsys.readouterr().err
    assert sorted(folder.iterdir()) == before
