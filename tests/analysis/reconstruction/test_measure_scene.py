import json
import re
from dataclasses import replace
from itertools import product
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import trimesh
from pydrake.math import RigidTransform

import splatpilot as sp
from splatpilot.analysis.commands.main import main
from splatpilot.analysis.reconstruction import measure_scene as measure
from splatpilot.analysis.reconstruction.measure_scene import (
    SceneMetrics,
    SceneViews,
    make_scene,
    measure_scene,
    read_metrics,
    unseen_fraction,
)
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata, write_scene_folder
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_scene_capture
from splatpilot.training.captures.render import true_camera
from splatpilot.training.reconstruction.config import ReconstructConfig


def make_wall(x: float, y: np.ndarray, z: np.ndarray, size: float, gray: float) -> sp.GaussianScene:
    """An opaque wall across x of Gaussians of this size [m] at all y and z."""
    y, z = (grid.ravel() for grid in np.meshgrid(y, z))
    rows = np.tile([x, 1.0, 0, 0, 0, 0.001, size, size, gray, gray, gray], (len(y), 1))
    means = np.column_stack([rows[:, 0], y, z])
    opacities = np.full(len(y), 0.99)
    return sp.GaussianScene.from_colors(means, rows[:, 1:5], rows[:, 5:8], opacities, rows[:, 8:])


def with_curtain(gaussians: sp.GaussianScene, x: float) -> sp.GaussianScene:
    """The scene with a gray sheet across the room at x."""
    sheet = make_wall(x, np.arange(-1, 4, 0.08), np.arange(-1, 3.5, 0.08), 0.06, 0.5)
    return gaussians.merged_with(sheet)


def test_a_curtain_is_a_floater(room):
    scene = room.scene("curtain", with_curtain(room.gaussians, x=2.0), held_out=[8])
    found = measure_scene(scene).frames[8]
    truth = room.capture.load_depth(8)
    to_curtain = 2.0 - room.capture.X_WCs[8].translation()[0]
    behind = truth > to_curtain
    assert found.depth_mae_m == pytest.approx((truth - to_curtain)[behind].sum() / truth.size, 0.05)
    far = truth - to_curtain > 0.1 * np.maximum(1, truth)
    assert found.floater_fraction == pytest.approx(far.mean(), abs=0.05)
    assert far.mean() > 0.4
    assert found.psnr_db is not None and found.psnr_db < 20


def test_metrics_file(room, capsys):
    scene = room.scene("same", with_curtain(room.gaussians, 3.0))
    assert main(["scene", "measure", str(scene)]) == 0
    printed = capsys.readouterr().out
    content = json.loads((scene / "metrics.json").read_text())
    strict, frames = content["strict"] | {"frames": content["strict_frames"]}, content["frames"]
    assert list(frames) == list(strict["frames"]) == ["0", "8"]
    for name, means in product(("psnr_db", "ssim", "depth_mae_m"), (content, strict)):
        assert means[name] == pytest.approx(np.mean([f[name] for f in means["frames"].values()]))
    assert (content["counts"]["psnr_db"], content["counts"]["lpips"]) == (2, 0)
    row = f"PSNR [dB]              {content['psnr_db']:<26.2f} {content['strict']['psnr_db']:.2f}\n"
    assert row in printed
    assert "measured on            2 held-out frames, 64 x 48\n" in printed
    metrics = read_metrics(scene)
    assert metrics is not None and metrics.as_json() == content
    assert "no LPIPS: LPIPS has no weights" in printed


def test_images_are_shrunk_as_for_reconstruction_with_nothing_held_out(room):
    metrics = measure_scene(room.scene("small", image_width=32, held_out=[]))
    assert (metrics.width, metrics.height) == (32, 24)
    assert (metrics.strict_width, metrics.strict_height) == (64, 48)
    assert metrics.as_json()["psnr_db"] > 22
    assert metrics.as_json()["depth_relative"] < 0.05
    assert list(metrics.frames) == [0, 8] and not metrics.held_out
    assert "2 frames the scene was made from" in str(metrics)


def test_a_scene_against_its_own_views_with_and_without_depth(room):
    blind = replace(room.capture, load_depth=lambda i: None)
    scenes = room.scene("seeing"), room.scene("blind")
    seeing, metrics = measure_scene(scenes[0]), measure_scene(scenes[1], blind)
    found = seeing.as_json()
    assert list(seeing.frames) == [0, 8] and seeing.held_out
    assert found["psnr_db"] > 55 and found["ssim"] > 0.999
    assert found["depth_mae_m"] == found["floater_fraction"] == 0
    assert found["lpips"] is None and "pip install lpips" in found["lpips_missing"]
    wider, width = (np.shape(cv2.imread(str(scene / "views.png")))[1] for scene in scenes)
    assert wider > 5 * 64 and 0.5 * wider < width < 0.75 * wider
    assert metrics.mean("depth_mae_m") is None and metrics.mean("floater_fraction") is None
    assert metrics.as_json()["psnr_db"] > 55
    assert "depth MAE [m]          -" in str(metrics)


def test_scenes_that_cannot_be_measured(room):
    with pytest.raises(ValueError, match=r"scene\.yaml: names no capture"):
        SceneViews(room.scene("lost", capture=""))
    for name, fields in (("other", {"held_out": [0, 16]}), ("shorter", {"gains": [1.0] * 17})):
        with pytest.raises(ValueError, match=r"frames of a room .*must be those of .*, got 16"):
            SceneViews(room.scene(name, **fields))
    scene = room.scene("damaged")
    assert read_metrics(scene) is None
    (scene / "metrics.json").write_text("{}")
    with pytest.raises(ValueError, match=r"metrics\.json: .* measure again"):
        read_metrics(scene)


def far_wall(x: float, lower_y: float, gray: float) -> sp.GaussianScene:
    y, z = np.arange(lower_y + 0.2, 20.0, 0.25), np.arange(-15.0, 18.0, 0.25)
    return make_wall(x, y, z, 0.2, gray)


@pytest.mark.parametrize(
    ("frontier", "metric", "expected"),
    [
        (far_wall(5.8, -20.0, 0.5), True, 1.0),
        (far_wall(5.8, 1.5, 0.5), True, 0.5),
        (far_wall(6.0, -20.0, 0.5), True, 0.0),
        (far_wall(0.1, -20.0, 0.5), True, 0.0),
        (None, True, 0.0),
        (None, False, None),
    ],
)
def test_pixels_that_show_the_frontier_are_unseen(frontier, metric, expected, tmp_path):
    """The scene of 6 x 3 x 2.5 m is flown along x, looking at a captured wall."""
    known = np.zeros((60, 30, 25), bool)
    free = esdf_from_occupancy(known, known, np.zeros(3), 0.1)
    ends = np.array([1.0, 1.5, 1.2]), np.array([5.0, 1.5, 1.2])
    world = sp.World("hall", far_wall(5.9, -20.0, 1.0), free, free, (1.0, 1.0, 1.0), *ends)
    write_scene_folder(tmp_path / "hall", world, frontier, provenance="test", metric=metric)
    assert unseen_fraction(tmp_path / "hall") == (expected and pytest.approx(expected, abs=0.04))


def test_flight_into_unseen_space_is_warned_of():
    metrics = SceneMetrics(True, 8, 8, {}, 8, 8, {}, "", flight_unseen_fraction=0.2)
    assert "unseen in flight       20.0%" in str(metrics)
    assert "warning" not in str(metrics)
    assert "warning: a flight" in str(replace(metrics, flight_unseen_fraction=0.6))
    assert metrics.as_json()["flight_unseen_fraction"] == 0.2


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
    small = {"voxel_size": 0.2, "initial_gaussians": 10_000, "threads": 1}
    return ReconstructConfig(iterations=40, image_width=0, capture=settings, **small)


def test_settings_of_a_capture_stay_with_its_scene(folder, config, tmp_path, capsys):
    scene = tmp_path / "scene"
    summary, metrics = make_scene(capture=folder, out=scene, config=config)
    assert summary.held_out is not None
    assert summary.held_out.means()["psnr_db"] == pytest.approx(metrics.mean("psnr_db"), abs=0.01)
    written = (scene / "metrics.json").read_bytes()
    assert json.loads(written) == metrics.as_json()
    assert (metrics.mean("depth_relative") or 1) < 0.15
    metadata = read_scene_metadata(scene)
    assert metadata.capture_settings == ["intrinsics=[32.0, 32.0, 32.0, 24.0]", "depth_unit=500.0"]
    assert read_scene_capture(scene, metadata).K[0, 0] == 32

    with pytest.raises(FileExistsError, match=f"{scene} is there already"):
        make_scene(capture=folder, out=scene, config=config)
    (scene / "views.png").unlink()  # as a kill while it is measured leaves it
    make_scene(capture=folder, out=scene, config=config)
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


def test_an_interrupted_measurement_is_resumed_alone(folder, config, tmp_path, monkeypatch):
    scene = tmp_path / "scene"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt) as interrupted:
        patch.setattr(measure, "measure_scene", Mock(side_effect=KeyboardInterrupt))
        make_scene(capture=folder, out=scene, config=replace(config, iterations=2))
    command = re.search(r"not measured; `splatpilot (.*)` measures", interrupted.value.__notes__[0])
    assert command and main(command[1].split()) == 0
    assert (scene / "metrics.json").is_file() and (scene / "views.png").is_file()


def test_doubts_about_a_capture_are_printed_first_and_last(folder, config, tmp_path, capsys):
    config.capture.depth_unit = 2500.0
    summary, _ = make_scene(
        capture=folder, out=tmp_path / "scene", config=replace(config, iterations=2)
    )
    doubt = summary.warnings[0]
    assert "most likely depth is 5 times too small" in doubt and "`splatpilot capture" in doubt
    printed = capsys.readouterr().out
    assert printed.startswith(f"warning: {doubt}\n") and printed.count(doubt) == 2


def test_a_mesh_is_rendered_and_reconstructed(opengl, tmp_path, capsys, set_fields):
    mesh = trimesh.creation.box((7.0, 4.0, 3.0))
    mesh.invert()
    mesh.export(tmp_path / "room.obj", include_normals=True)
    out = tmp_path / "scene"
    fields = set_fields(
        *("render.width=64", "render.height=48", "render.path=[[-2, 0, 0], [2, 0, 0]]"),
        *("render.yaws=[0, 180]", "iterations=5", "image_width=0", "initial_gaussians=2000"),
    )
    command = ["reconstruct", str(tmp_path / "room.obj"), "--up", "z", "--out", str(out), *fields]
    assert main(command) == 0
    written = (out / "gaussians.ply").read_bytes()
    assert (out / "metrics.json").is_file()
    camera = true_camera(out / "capture")
    assert camera is not None and camera(RigidTransform()).depth.shape == (48, 64)

    assert main(command) == 1
    assert "is there already" in capsys.readouterr().err
    assert main([*command, "--overwrite"]) == 0
    assert "is complete already" in capsys.readouterr().out
    assert (out / "gaussians.ply").read_bytes() == written
