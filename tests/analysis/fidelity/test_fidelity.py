import csv
from dataclasses import replace

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.reconstruction import fidelity
from splatpilot.analysis.reconstruction.fidelity import FidelityConfig, study_scene
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.training.captures import capture_registry
from splatpilot.training.captures.capture import CaptureFrame, no_depth


@pytest.fixture
def find_camera(room):
    """Makes the room a world that can be rendered from anywhere."""
    baked, capture = BakedScene(room.gaussians), room.capture

    def camera(X_WC: RigidTransform) -> CaptureFrame:
        view = baked.render(capture.K, capture.width, capture.height, X_WC)
        image = np.round(255 * np.clip(view.color, 0, 1)).astype(np.uint8)
        return CaptureFrame(image, view.depth, X_WC, capture.K)

    return lambda folder: camera


def read_rows(folder) -> list[dict]:
    with open(folder / "fidelity.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_studies_write_bounds_and_are_not_mixed(room, find_camera, capsys):
    scene, out = room.scene("perfect"), room.folder / "out"
    narrow, wide = (FidelityConfig(offsets=[0.0, offset]) for offset in (0.1, 0.2))
    fidelity.run([scene], out, narrow, find_camera)
    assert "perturbation bound 0.10 m" in capsys.readouterr().out
    # Both held-out poses, on the path and to both sides.
    rows = read_rows(out)
    assert sorted(float(row["offset"]) for row in rows) == [0, 0, 0.1, 0.1, 0.1, 0.1]
    assert all(float(row["depth_mae_m"]) == 0 for row in rows)
    assert len(read_scene_metadata(scene).pose_perturbation_bounds) == 16
    for name in ("fidelity.png", "perfect_views.png"):
        assert cv2.imread(str(out / name)) is not None
    for folder, error, message in (
        (out, ValueError, r"fidelity.yaml holds another configuration"),
        (room.folder / "other", FileExistsError, r"scene.yaml has the bounds of another study"),
    ):
        with pytest.raises(error, match=message):
            fidelity.run([scene], folder, wide, find_camera)
    assert not (room.folder / "other").exists()
    assert read_scene_metadata(scene).perturbation_bound == pytest.approx(0.1)
    fidelity.run([scene], out, wide, find_camera, overwrite=True)
    assert {row["offset"] for row in read_rows(out)} == {"0.0", "0.2"}
    assert read_scene_metadata(scene).perturbation_bound == pytest.approx(0.2)


def test_a_wrong_scene_is_not_trusted(room, find_camera):
    gaussians = room.gaussians
    kept = ~((gaussians.means[:, 1] > 2.9) & (gaussians.means[:, 0] > 3.0))
    names = ("means", "quats", "scales", "opacities", "sh")
    part = replace(gaussians, **{name: getattr(gaussians, name)[kept] for name in names})
    scene = room.scene("part", part, held_out=[0])
    config = FidelityConfig(offsets=[0.0, 0.3], max_depth_error=0.02)
    found = study_scene(scene, room.folder / "out", config, find_camera)
    assert found.column("depth_relative").min() > 0.02 and found.reach == 0


def test_cameras_stay_inside_walls(room, find_camera):
    scene = room.scene("room_with_walls", held_out=[0])
    # The walls are 1.5 m to either side; the field knows nothing beyond them.
    config = FidelityConfig(offsets=[0.0, 1.0, 1.4])
    found = study_scene(scene, room.folder / "out", config, find_camera)
    assert set(found.column("offset")) == {0.0, 1.0}


def test_held_out_stretches(room, set_fields):
    scene, out = room.scene("real", held_out=[0]), room.folder / "out"
    fields = set_fields(
        "stretches=[1, 3]",
        "kept=3",
        "reconstruct.iterations=10",
        "reconstruct.threads=1",
        "reconstruct.initial_gaussians=2000",
        "reconstruct.voxel_size=0.2",
        "max_depth_error=0.5",
        "max_psnr_drop=30",
    )
    command = ["scene", "fidelity", str(scene), "--out", str(out), *fields]
    assert main(command) == 0
    rows = read_rows(out)
    assert [int(row["frame"]) for row in rows] == [3, 7, 8, 9]
    expected = [0.15, 0.15, 0.3, 0.15]
    np.testing.assert_allclose([float(row["offset"]) for row in rows], expected, atol=1e-9)
    part = read_scene_metadata(out / "real")
    assert len(part.gains) == 12 and part.held_out == []
    metadata = read_scene_metadata(scene)
    middle = np.median(metadata.pose_perturbation_bounds)
    assert 0 < middle < 0.31 and metadata.perturbation_bound == middle

    made = (out / "real" / "gaussians.ply").stat().st_mtime_ns
    assert main(command) == 0
    assert (out / "real" / "gaussians.ply").stat().st_mtime_ns == made


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("offsets=[0.5, 0.1]", "offsets must be at least one, rising, got [0.5, 0.1]"),
        ("stretches=[]", "stretches must be at least one, got []"),
    ],
)
def test_invalid_settings(room, capsys, setting, message):
    scene, out = room.scene("scene"), room.folder / "out"
    assert main(["scene", "fidelity", str(scene), "--out", str(out), "--set", setting]) == 1
    assert message in capsys.readouterr().err


def test_capture_without_depth(room, monkeypatch, capsys):
    blind = replace(room.capture, load_depth=no_depth)
    monkeypatch.setattr(capture_registry, "read_capture", lambda path, config: blind)
    scene = room.scene("blind")
    assert main(["scene", "fidelity", str(scene), "--out", str(room.folder / "out")]) == 1
    assert "has no metric depth" in capsys.readouterr().err
