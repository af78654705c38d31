"""Files of Gaussians in meters and upright."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.reconstruction.rescale import UP_AXES, run
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.splat_files import read_ply, write_ply

SHRUNK = 0.25
"""Units of the file a meter."""


@pytest.mark.parametrize("up", UP_AXES)
def test_file_of_gaussians_in_meters_and_upright(seen_room, tmp_path, up):
    gaussians, capture = seen_room
    along = "xyz".index(up[-1])
    up_F = np.eye(3)[along] * (-1 if up.startswith("-") else 1)
    x_F = np.roll(np.eye(3)[along], 1)
    R_FW = RotationMatrix(np.column_stack([x_F, np.cross(up_F, x_F), up_F]))
    file, out = tmp_path / "file.ply", tmp_path / "upright.ply"
    write_ply(gaussians.scaled_by(SHRUNK).transformed_by(RigidTransform(R_FW)), file)
    command = [
        "scene",
        "scale",
        str(file),
        "--out",
        str(out),
        "--up",
        up,
        "--factor",
        str(1 / SHRUNK),
    ]
    assert main(command) == 0
    found = read_ply(out)
    np.testing.assert_allclose(found.means[:, 2], gaussians.means[:, 2], atol=1e-5)
    X_WV = RigidTransform(RotationMatrix.MakeZRotation(_turn(gaussians.means, found.means)))
    # Askew, for Gaussians of a wall seen squarely have one depth, and may change places.
    X_WC = capture.X_WCs[3] @ RigidTransform(RollPitchYaw(0.11, 0.23, 0.37), np.zeros(3))
    before = BakedScene(gaussians).render(capture.K, 64, 48, X_WC)
    after = BakedScene(found).render(capture.K, 64, 48, X_WV @ X_WC)
    assert np.abs(after.color - before.color).mean() < 1e-3
    assert np.quantile(np.abs(after.depth / before.depth - 1), 0.95) < 1e-3


def test_a_tilted_file_becomes_level(seen_room, tmp_path):
    gaussians, _ = seen_room
    X_FW = RigidTransform(RollPitchYaw(0.3, -0.2, 0.5), [1.0, 2.0, 3.0])
    file = tmp_path / "file.ply"
    write_ply(gaussians.transformed_by(X_FW), file)
    lowest = gaussians.means[:, 2].min()
    corners = [X_FW @ np.array([x, y, lowest]) for x, y in ((0, 0), (3, 0.5), (0.5, 2))]
    for k, points in enumerate((corners, corners[::-1])):
        words = [",".join(str(x) for x in point) for point in points]
        out = tmp_path / f"{k}.ply"
        assert (
            main(
                ["scene", "scale", str(file), "--out", str(out), "--floor", *words, "--factor", "2"]
            )
            == 0
        )
        heights = read_ply(out).means[:, 2]
        np.testing.assert_allclose(heights, 2 * (gaussians.means[:, 2] - lowest), atol=2e-5)


def _turn(before, after) -> float:
    """[rad], about z, from points to the same points turned."""
    a, b = (points[:, 0] + 1j * points[:, 1] for points in (before, after))
    return float(np.angle(np.vdot(a, b)))


def test_length_in_a_file_of_gaussians(seen_room, tmp_path, capsys):
    gaussians, _ = seen_room
    file = tmp_path / "file.ply"
    write_ply(gaussians, file)
    summary = run(
        scene=file, out=tmp_path / "b.ply", between=[[0, 0, 0], [0, 2, 0]], distance=3.0, up="z"
    )
    assert summary.factor == 1.5
    np.testing.assert_allclose(read_ply(tmp_path / "b.ply").means, 1.5 * gaussians.means, rtol=1e-6)
    assert run(scene=file, out=tmp_path / "c.ply", up="-z").factor == 1.0
    assert f"Gaussians          {len(gaussians)}\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["room.ply", "--out", "out.ply"], "what is its size? Give --factor"),
        (["room.ply", "--out", "out.spz", "--factor", "2"], "written as PLY; name it so, out.ply"),
        (["room.ply", "--out", "room.ply", "--factor", "2"], "room.ply: exists already"),
        (["room.ply", "--out", "out.ply", "--height", "2"], "a file has no cameras"),
        (
            ["room.ply", "--out", "out.ply", "--factor", "0"],
            "factor must be finite and > 0, got 0",
        ),
        (["unscaled", "--out", "out", "--up", "-y"], "z is up in scene folders; leave --up"),
        (["room.ply", "--out", "out.ply", "--floor", "0,0,0", "1,0,0", "2,0,0"], "lie in a line"),
        (["room.ply", "--out", "out.ply", "--floor", "0,0,0", "1,0,0", "0,0,1"], "at 90 degrees"),
        (["room.ply", "--out", "out.ply", "--floor", "0,0,0", "1,0", "0,0,1"], "--floor '1,0': a"),
        (["a.ksplat", "--out", "out.ply", "--up", "y"], "a.ksplat: a KSPLAT"),
    ],
)
def test_files_that_cannot_be_scaled(place, monkeypatch, capsys, words, message):
    scene, folder = place.scene("unscaled"), place.folder
    monkeypatch.chdir(folder)
    (folder / "room.ply").write_bytes((scene / "gaussians.ply").read_bytes())
    (folder / "a.ksplat").write_bytes(bytes(64))
    there = sorted(folder.iterdir())
    assert main(["scene", "scale", *words]) == 1
    assert message in capsys.readouterr().err
    assert sorted(folder.iterdir()) == there
