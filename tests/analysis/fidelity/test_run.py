import csv
from dataclasses import replace

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.fidelity import fidelity as fidelity
from splatpilot.analysis.fidelity.fidelity import FidelityConfig
from splatpilot.analysis.fidelity.study import FidelityStudy, Sample
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.training.captures.capture import CaptureFrame


def study(samples: list[Sample], kind: str = "rendered") -> FidelityStudy:
    return FidelityStudy("place", kind, 30.0, samples, max_depth_error=0.05, max_psnr_drop=6.0)


def samples_of(offsets: np.ndarray, psnr, relative) -> list[Sample]:
    return [
        Sample(0, float(x), float(x) / 2, psnr(x), 2 * relative(x), relative(x), 0.0)
        for x in offsets
    ]


def test_reach_is_where_the_first_limit_is_met():
    offsets = np.linspace(0, 1, 11)
    by_depth = study(samples_of(offsets, lambda x: 30 - 5 * x, lambda x: 0.125 * x))
    assert by_depth.reach == pytest.approx(0.4)
    assert by_depth.unseen_limit == pytest.approx(0.2)
    by_color = study(samples_of(offsets, lambda x: 30 - 20 * x, lambda x: 0.01 * x))
    assert by_color.reach == pytest.approx(0.3)
    at = by_depth.at(0.5)
    assert at["psnr_db"] == pytest.approx(27.5) and at["depth_mae_m"] == pytest.approx(0.125)
    assert np.isnan(by_depth.at(1.1)["psnr_db"])
    assert by_depth.agreement() == (1.0, 0.0)


@pytest.fixture
def rendered_world(place):
    """Makes the room a world that can be rendered from anywhere."""
    baked, capture = BakedScene(place.gaussians), place.capture

    def camera(X_WC: RigidTransform) -> CaptureFrame:
        view = baked.render(capture.K, capture.width, capture.height, X_WC)
        image = np.round(255 * np.clip(view.color, 0, 1)).astype(np.uint8)
        return CaptureFrame(image, view.depth, X_WC, capture.K)

    return lambda folder: camera


def rows_of(folder) -> list[dict]:
    with open(folder / "fidelity.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_a_perfect_scene_is_trusted_as_far_as_measured(place, rendered_world, capsys):
    scene = place.scene("perfect")
    config = FidelityConfig(offsets=[0.0, 0.2, 0.4])
    fidelity.run([scene], place.folder / "out", config, rendered_world)
    rows = rows_of(place.folder / "out")
    # Both held-out poses, at their place and to both sides.
    assert sorted(float(row["offset"]) for row in rows) == [0, 0, 0.2, 0.2, 0.2, 0.2] + [0.4] * 4
    assert all(float(row["depth_mae_m"]) == 0 for row in rows)
    metadata = read_scene_metadata(scene)
    assert metadata.perturbation_bound == pytest.approx(0.4)
    assert len(metadata.pose_perturbation_bounds) == 16
    assert "perturbation bound 0.40 m" in capsys.readouterr().out
    for name in ("fidelity.png", "perfect_views.png"):
        assert cv2.imread(str(place.folder / "out" / name)) is not None


def test_a_wrong_scene_is_trusted_less(place, rendered_world):
    gaussians = place.gaussians
    there = ~((gaussians.means[:, 1] > 2.9) & (gaussians.means[:, 0] > 3.0))
    part = replace(
        gaussians,
        **{
            name: getattr(gaussians, name)[there]
            for name in ("means", "quats", "scales", "opacities", "sh")
        },
    )
    scene = place.scene("part", part, held_out=[0])
    config = FidelityConfig(offsets=[0.0, 0.3], max_depth_error=0.02)
    (found,) = fidelity.run([scene], place.folder / "out", config, rendered_world)
    assert found.column("depth_relative").min() > 0.02
    assert found.reach == 0 and read_scene_metadata(scene).perturbation_bound == 0


def test_walls_are_not_walked_through(place, rendered_world):
    scene = place.scene("room_with_walls", held_out=[0])
    # The room's walls are 1.5 m to either side; the field knows nothing beyond them.
    config = FidelityConfig(offsets=[0.0, 1.0, 1.4])
    (found,) = fidelity.run([scene], place.folder / "out", config, rendered_world)
    assert set(found.column("offset")) == {0.0, 1.0}


def test_withheld_stretches(place):
    scene = place.scene("real", held_out=[0])
    settings = [
        "stretches=[1, 3]",
        "kept=3",
        "reconstruct.iterations=10",
        "reconstruct.threads=1",
        "reconstruct.initial_gaussians=2000",
        "reconstruct.voxel_size=0.2",
        "max_depth_error=0.5",
        "max_psnr_drop=30",
    ]
    words = [word for setting in settings for word in ("--set", setting)]
    out = place.folder / "out"
    assert main(["scene", "fidelity", str(scene), "--out", str(out), *words]) == 0
    rows = rows_of(out)
    assert [int(row["frame"]) for row in rows] == [3, 7, 8, 9]
    expected = [0.15, 0.15, 0.3, 0.15]
    np.testing.assert_allclose([float(row["offset"]) for row in rows], expected, atol=1e-9)
    part = read_scene_metadata(out / "real")
    assert len(part.gains) == 12 and part.held_out == []
    metadata = read_scene_metadata(scene)
    assert metadata.perturbation_bound == np.median(metadata.pose_perturbation_bounds)
    assert 0 < np.median(metadata.pose_perturbation_bounds) < 0.31

    made = (out / "real" / "gaussians.ply").stat().st_mtime_ns
    assert main(["scene", "fidelity", str(scene), "--out", str(out), *words]) == 0
    assert (out / "real" / "gaussians.ply").stat().st_mtime_ns == made


def test_studies_are_not_mixed(place, rendered_world):
    scene, out = place.scene("perfect", held_out=[0]), place.folder / "out"
    narrow, wide = (FidelityConfig(offsets=[0.0, offset]) for offset in (0.2, 0.4))
    fidelity.run([scene], out, narrow, rendered_world)
    for folder, error, message in (
        (out, ValueError, r"fidelity.yaml holds another configuration"),
        (place.folder / "other", FileExistsError, r"scene.yaml has the bounds of another study"),
    ):
        with pytest.raises(error, match=message):
            fidelity.run([scene], folder, wide, rendered_world)
    assert not (place.folder / "other").exists()
    assert {row["offset"] for row in rows_of(out)} == {"0.0", "0.2"}
    assert read_scene_metadata(scene).perturbation_bound == pytest.approx(0.2)
    fidelity.run([scene], out, wide, rendered_world, overwrite=True)
    assert {row["offset"] for row in rows_of(out)} == {"0.0", "0.4"}
    assert read_scene_metadata(scene).perturbation_bound == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("offsets=[0.5, 0.1]", "offsets must be at least one, rising, got [0.5, 0.1]"),
        ("stretches=[]", "stretches must be at least one, got []"),
        ("kept=0", "kept must be in [1, inf), got 0"),
        ("clearance=0.0", "clearance must be in (0, inf) m, got 0.0"),
        ("reconstruct.hold_out=1", "hold_out must be 0 or at least 2, got 1"),
    ],
)
def test_bad_settings(place, capsys, setting, message):
    scene, out = place.scene("scene"), place.folder / "out"
    assert main(["scene", "fidelity", str(scene), "--out", str(out), "--set", setting]) == 1
    assert message in capsys.readouterr().err


def test_capture_without_depth(place, monkeypatch, capsys):
    from splatpilot.training.captures import capture_registry as capture_of_scene
    from splatpilot.training.captures.capture import no_depth

    blind = replace(place.capture, load_depth=no_depth)
    monkeypatch.setattr(capture_of_scene, "read_capture", lambda path, config: blind)
    scene = place.scene("blind")
    assert main(["scene", "fidelity", str(scene), "--out", str(place.folder / "out")]) == 1
    assert "has no metric depth" in capsys.readouterr().err
