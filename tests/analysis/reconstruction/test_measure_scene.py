import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.reconstruction.measure_scene import SceneViews, measure_scene, read_metrics
from splatpilot.systems.splats.scene import GaussianScene


def with_curtain(gaussians: GaussianScene, x: float) -> GaussianScene:
    """The scene with a gray sheet across the room at x."""
    y, z = (g.ravel() for g in np.meshgrid(np.arange(-1, 4, 0.08), np.arange(-1, 3.5, 0.08)))
    count = len(y)
    curtain = GaussianScene.from_colors(
        np.column_stack([np.full(count, x), y, z]),
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.tile([0.005, 0.06, 0.06], (count, 1)),
        np.full(count, 0.99),
        np.full((count, 3), 0.5),
    )
    return gaussians.merged_with(curtain)


def test_a_scene_against_its_own_views(place):
    measures = measure_scene(place.scene("same"))
    assert list(measures.frames) == [0, 8] and measures.held_out
    assert measures.as_json()["psnr_db"] > 55
    assert measures.as_json()["ssim"] > 0.999
    assert measures.as_json()["depth_mae_m"] == measures.as_json()["floater_fraction"] == 0


def test_a_curtain_is_a_floater(place):
    scene = place.scene("curtain", with_curtain(place.gaussians, x=2.0), held_out=[8])
    found = measure_scene(scene).frames[8]
    truth = place.capture.load_depth(8)
    to_curtain = 2.0 - place.capture.X_WCs[8].translation()[0]
    behind = truth > to_curtain
    assert found.depth_mae_m == pytest.approx((truth - to_curtain)[behind].sum() / truth.size, 0.05)
    far = truth - to_curtain > 0.1 * np.maximum(1, truth)
    assert found.floater_fraction == pytest.approx(far.mean(), abs=0.05)
    assert far.mean() > 0.4
    assert found.psnr_db is not None and found.psnr_db < 20


def test_metrics_file(place, capsys):
    scene = place.scene("same", with_curtain(place.gaussians, 3.0))
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
    measures = read_metrics(scene)
    assert measures is not None and measures.as_json() == content
    assert np.shape(cv2.imread(str(scene / "views.png")))[1] > 5 * 64


def test_without_lpips_weights(place, capsys):
    scene = place.scene("same")
    assert main(["scene", "measure", str(scene)]) == 0
    content = json.loads((scene / "metrics.json").read_text())
    assert content["lpips"] is None
    assert "pip install lpips" in content["lpips_missing"]
    assert "no LPIPS: LPIPS has no weights" in capsys.readouterr().out


def test_nothing_held_out(place, capsys):
    scene = place.scene("all", held_out=[])
    measures = measure_scene(scene)
    assert list(measures.frames) == [0, 8] and not measures.held_out
    assert "2 frames the scene was made from" in str(measures)


def test_images_are_shrunk_as_for_the_making(place):
    measures = measure_scene(place.scene("small", image_width=32))
    assert (measures.width, measures.height) == (32, 24)
    assert measures.as_json()["psnr_db"] > 22
    assert measures.as_json()["depth_relative"] < 0.05


def test_capture_without_depth(place):
    blind = replace(place.capture, load_depth=lambda i: None)
    scene, seeing = place.scene("blind"), place.scene("seeing")
    measures = measure_scene(scene, blind)
    measure_scene(seeing)
    width, wider = (np.shape(cv2.imread(str(s / "views.png")))[1] for s in (scene, seeing))
    assert 0.5 * wider < width < 0.75 * wider
    assert measures.mean("depth_mae_m") is None and measures.mean("floater_fraction") is None
    assert measures.as_json()["psnr_db"] > 55
    assert "depth MAE [m]          -" in str(measures)


def test_scenes_that_cannot_be_measured(place):
    with pytest.raises(ValueError, match=r"scene\.yaml: names no capture"):
        SceneViews(place.scene("lost", capture=""))
    with pytest.raises(ValueError, match=r"frame 16 is held out, but a room .* only 16 frames"):
        SceneViews(place.scene("other", held_out=[0, 16]))
    scene = place.scene("damaged")
    assert read_metrics(scene) is None
    (scene / "metrics.json").write_text("{}")
    with pytest.raises(ValueError, match=r"metrics\.json: .* measure again"):
        read_metrics(scene)
