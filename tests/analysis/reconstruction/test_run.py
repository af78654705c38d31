import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from pydrake.math import RigidTransform

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.reconstruction.run import run
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_scene_capture
from splatpilot.training.captures.render import true_camera
from splatpilot.training.reconstruction.config import ReconstructConfig

SMALL = ReconstructConfig(
    iterations=60, image_width=0, voxel_size=0.2, initial_gaussians=20_000, threads=1
)


@pytest.fixture
def folder(seen_room, write_nerfstudio, tmp_path):
    """The room in nerfstudio's format, overexposed, with twice the right focal length and depth in
    units of 1 / 500 m, which the file does not state."""
    _, capture = seen_room
    path = tmp_path / "capture"
    content = write_nerfstudio(path, capture, brightness=1.5)
    for i, frame in enumerate(content["frames"]):
        depth = np.round(500 * capture.load_depth(i)).astype(np.uint16)
        frame["depth_file_path"] = f"{i}.depth.png"
        cv2.imwrite(str(path / frame["depth_file_path"]), depth)
    (path / "transforms.json").write_text(json.dumps(content | {"fl_x": 64.0}))
    return path


@pytest.fixture
def config() -> ReconstructConfig:
    """The settings that the capture needs."""
    settings = CaptureConfig(intrinsics=[32.0, 32.0, 32.0, 24.0], depth_unit=500.0)
    return replace(SMALL, capture=settings)


def test_settings_of_a_capture_stay_with_its_scene(folder, config, tmp_path, capsys):
    scene = tmp_path / "scene"
    summary, metrics = run(capture=folder, out=scene, config=config)
    assert summary.held_out is not None
    assert summary.held_out.means()["psnr_db"] == pytest.approx(metrics.mean("psnr_db"), abs=0.01)
    written = (scene / "metrics.json").read_bytes()
    assert json.loads(written) == metrics.as_json()
    assert (metrics.mean("depth_relative") or 1) < 0.15
    metadata = read_scene_metadata(scene)
    assert metadata.capture_settings == ["intrinsics=[32.0, 32.0, 32.0, 24.0]", "depth_unit=500.0"]
    assert read_scene_capture(scene, metadata).K[0, 0] == 32

    with pytest.raises(FileExistsError, match=f"{scene} is there already"):
        run(capture=folder, out=scene, config=config)
    (scene / "views.png").unlink()  # as a kill while it is measured leaves it
    run(capture=folder, out=scene, config=config)
    assert (scene / "metrics.json").read_bytes() == written

    capsys.readouterr()
    assert main(["scene", "measure", str(scene), "--overwrite"]) == 0
    assert (scene / "metrics.json").read_bytes() == written
    printed = capsys.readouterr().out
    assert f"made from              nerfstudio capture {folder}, 16 frames" in printed
    assert "image gains" in printed and "seen free [m^3]" in printed

    text = (scene / "scene.yaml").read_text()
    (scene / "scene.yaml").write_text(text.replace("depth_unit", "depth_units"))
    assert main(["scene", "measure", str(scene), "--overwrite"]) == 1
    message = capsys.readouterr().err
    assert "scene.yaml: capture_settings: " in message and "did you mean depth_unit" in message


def test_doubts_about_a_capture_are_printed_first_and_last(folder, config, tmp_path, capsys):
    config.capture.depth_unit = 2500.0
    summary, _ = run(capture=folder, out=tmp_path / "scene", config=replace(config, iterations=2))
    doubt = summary.warnings[0]
    assert "most likely depth is 5 times too small" in doubt and "`splatpilot capture" in doubt
    printed = capsys.readouterr().out
    assert printed.startswith(f"warning: {doubt}\n") and printed.count(doubt) == 2


def test_invalid_captures_are_refused(tmp_path, config):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="must be new, empty or a scene"):
        run(capture=tmp_path / "nowhere", out=tmp_path, config=config)
    with pytest.raises(ValueError, match="unknown capture format; known are TartanAir V1"):
        run(capture=tmp_path, out=tmp_path / "scene", config=config)
    with pytest.raises(FileNotFoundError, match=r"No such file or folder: .*nowhere"):
        run(capture=tmp_path / "nowhere", out=tmp_path / "scene", config=config)


def test_a_mesh_is_rendered_and_reconstructed(opengl, tmp_path, capsys, set_fields):
    mesh = trimesh.creation.box((7.0, 4.0, 3.0))
    mesh.invert()
    mesh.export(tmp_path / "room.obj", include_normals=True)
    out = tmp_path / "scene"
    fields = set_fields(
        "render.width=64",
        "render.height=48",
        "render.path=[[-2, 0, 0], [2, 0, 0]]",
        "render.yaws=[0, 180]",
        "iterations=5",
        "image_width=0",
        "initial_gaussians=2000",
    )
    command = ["reconstruct", str(tmp_path / "room.obj"), "--up", "z", "--out", str(out), *fields]
    assert main(command) == 0
    written = (out / "gaussians.ply").read_bytes()
    assert (out / "metrics.json").is_file()
    camera = true_camera(out / "capture")
    assert camera is not None
    np.testing.assert_array_equal(camera(RigidTransform()).depth.shape, (48, 64))

    assert main(command) == 1
    assert "is there already" in capsys.readouterr().err
    assert main([*command, "--overwrite"]) == 0
    assert "is complete already" in capsys.readouterr().out
    assert (out / "gaussians.ply").read_bytes() == written
