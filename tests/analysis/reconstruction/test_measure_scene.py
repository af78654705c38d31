import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.reconstruction.measure_scene import (
    SceneMetrics,
    SceneViews,
    measure_scene,
    read_metrics,
    unseen_fraction,
)
from splatpilot.diagrams.worlds.scene_folder import write_scene_folder
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.splats.scene import GaussianScene


def make_wall(x: float, y: np.ndarray, z: np.ndarray, size: float, gray: float) -> GaussianScene:
    """An opaque wall across x of Gaussians of this size [m] at all y and z."""
    y, z = (grid.ravel() for grid in np.meshgrid(y, z))
    return GaussianScene.from_colors(
        np.column_stack([np.full(len(y), x), y, z]),
        np.tile([1.0, 0, 0, 0], (len(y), 1)),
        np.tile([0.001, size, size], (len(y), 1)),
        np.full(len(y), 0.99),
        np.full((len(y), 3), gray),
    )


def with_curtain(gaussians: GaussianScene, x: float) -> GaussianScene:
    """The scene with a gray sheet across the room at x."""
    sheet = make_wall(x, np.arange(-1, 4, 0.08), np.arange(-1, 3.5, 0.08), 0.06, 0.5)
    return gaussians.merged_with(sheet)


def test_a_scene_against_its_own_views(room):
    metrics = measure_scene(room.scene("same"))
    found = metrics.as_json()
    assert list(metrics.frames) == [0, 8] and metrics.held_out
    assert found["psnr_db"] > 55 and found["ssim"] > 0.999
    assert found["depth_mae_m"] == found["floater_fraction"] == 0
    assert found["lpips"] is None and "pip install lpips" in found["lpips_missing"]


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
    frames, strict = content["frames"], content["strict_frames"]
    assert list(frames) == list(strict) == ["0", "8"]
    for name in ("psnr_db", "ssim", "depth_mae_m", "floater_fraction"):
        assert content[name] == pytest.approx(np.mean([f[name] for f in frames.values()]))
        assert content["strict"][name] == pytest.approx(np.mean([f[name] for f in strict.values()]))
        assert content["counts"][name] == 2
    assert content["counts"]["lpips"] == 0
    row = f"PSNR [dB]              {content['psnr_db']:<26.2f} {content['strict']['psnr_db']:.2f}\n"
    assert row in printed
    assert "measured on            2 held-out frames, 64 x 48\n" in printed
    metrics = read_metrics(scene)
    assert metrics is not None and metrics.as_json() == content
    assert "no LPIPS: LPIPS has no weights" in printed
    assert np.shape(cv2.imread(str(scene / "views.png")))[1] > 5 * 64


def test_nothing_held_out(room, capsys):
    scene = room.scene("all", held_out=[])
    metrics = measure_scene(scene)
    assert list(metrics.frames) == [0, 8] and not metrics.held_out
    assert "2 frames the scene was made from" in str(metrics)


def test_images_are_shrunk_as_for_reconstruction(room):
    metrics = measure_scene(room.scene("small", image_width=32))
    assert (metrics.width, metrics.height) == (32, 24)
    assert (metrics.strict_width, metrics.strict_height) == (64, 48)
    assert metrics.as_json()["psnr_db"] > 22
    assert metrics.as_json()["depth_relative"] < 0.05


def test_capture_without_depth(room):
    blind = replace(room.capture, load_depth=lambda i: None)
    scene, seeing = room.scene("blind"), room.scene("seeing")
    metrics = measure_scene(scene, blind)
    measure_scene(seeing)
    width, wider = (np.shape(cv2.imread(str(s / "views.png")))[1] for s in (scene, seeing))
    assert 0.5 * wider < width < 0.75 * wider
    assert metrics.mean("depth_mae_m") is None and metrics.mean("floater_fraction") is None
    assert metrics.as_json()["psnr_db"] > 55
    assert "depth MAE [m]          -" in str(metrics)


def test_scenes_that_cannot_be_measured(room):
    with pytest.raises(ValueError, match=r"scene\.yaml: names no capture"):
        SceneViews(room.scene("lost", capture=""))
    with pytest.raises(ValueError, match=r"frame 16 is held out, but a room .* only 16 frames"):
        SceneViews(room.scene("other", held_out=[0, 16]))
    scene = room.scene("damaged")
    assert read_metrics(scene) is None
    (scene / "metrics.json").write_text("{}")
    with pytest.raises(ValueError, match=r"metrics\.json: .* measure again"):
        read_metrics(scene)


def far_wall(x: float, lower_y: float, gray: float) -> GaussianScene:
    y, z = np.arange(lower_y + 0.2, 20.0, 0.25), np.arange(-15.0, 18.0, 0.25)
    return make_wall(x, y, z, 0.2, gray)


@pytest.fixture
def write_scene(tmp_path):
    """Writes a scene of 6 x 3 x 2.5 m that is flown along x, looking at a captured wall."""
    known = np.zeros((60, 30, 25), bool)
    free = esdf_from_occupancy(known, known, np.zeros(3), 0.1)
    ends = np.array([1.0, 1.5, 1.2]), np.array([5.0, 1.5, 1.2])

    world = World("hall", far_wall(5.9, -20.0, 1.0), free, free, (1.0, 1.0, 1.0), *ends)

    def write(frontier: GaussianScene | None, metric: bool = True):
        write_scene_folder(tmp_path / "hall", world, frontier, provenance="test", metric=metric)
        return tmp_path / "hall"

    return write


@pytest.mark.parametrize(
    ("x", "lower_y", "expected"),
    [(5.8, -20.0, 1.0), (5.8, 1.5, 0.5), (6.0, -20.0, 0.0), (0.1, -20.0, 0.0)],
)
def test_pixels_that_show_the_frontier_are_unseen(write_scene, x, lower_y, expected):
    assert unseen_fraction(write_scene(far_wall(x, lower_y, 0.5))) == pytest.approx(
        expected, abs=0.04
    )


def test_unseen_fraction_without_frontier_or_scale(write_scene):
    assert unseen_fraction(write_scene(None)) == 0.0
    assert unseen_fraction(write_scene(None, metric=False)) is None


def test_flight_into_unseen_space_is_warned_of():
    metrics = SceneMetrics(True, 8, 8, {}, 8, 8, {}, "", flight_unseen_fraction=0.2)
    assert "unseen in flight       20.0%" in str(metrics)
    assert "warning" not in str(metrics)
    assert "warning: a flight" in str(replace(metrics, flight_unseen_fraction=0.6))
    assert metrics.as_json()["flight_unseen_fraction"] == 0.2
