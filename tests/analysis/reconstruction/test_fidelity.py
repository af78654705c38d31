import csv
from dataclasses import replace

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

import splatpilot as sp
from splatpilot.analysis.commands.main import main
from splatpilot.analysis.reconstruction import fidelity
from splatpilot.analysis.reconstruction.fidelity import FidelityConfig, study_scene
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.training.captures import capture_registry
from splatpilot.training.captures.capture import CaptureFrame, no_depth
from splatpilot.training.reconstruction.splat_rendering import SceneRenderer


@pytest.fixture
def find_camera(room):
    """Makes the room a world that can be rendered from anywhere."""
    baked, capture = sp.BakedScene(room.gaussians), room.capture

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


def test_a_wrong_scene_is_not_trusted_and_cameras_stay_inside_walls(room, find_camera):
    gaussians = room.gaussians
    kept = ~((gaussians.means[:, 1] > 2.9) & (gaussians.means[:, 0] > 3.0))
    names = ("means", "quats", "scales", "opacities", "sh")
    part = replace(gaussians, **{name: getattr(gaussians, name)[kept] for name in names})
    scene = room.scene("part", part, held_out=[0])
    # The walls are 1.5 m to either side; the field knows nothing beyond them.
    config = FidelityConfig(offsets=[0.0, 0.3, 1.4], max_depth_error=0.02)
    found = study_scene(scene, room.folder / "out", config, find_camera)
    assert found.column("depth_relative").min() > 0.02 and found.reach == 0
    assert set(found.column("offset")) == {0.0, 0.3}


def test_held_out_stretches(room, set_fields):
    scene, out = room.scene("real", held_out=[0]), room.folder / "out"
    small = ("iterations=10", "threads=1", "initial_gaussians=2000", "voxel_size=0.2")
    fields = set_fields(
        *("stretches=[1, 3]", "kept=3", "max_depth_error=0.5", "max_psnr_drop=30"),
        *(f"reconstruct.{field}" for field in small),
    )
    command = ["scene", "fidelity", str(scene), "--out", str(out), *fields]
    assert main(command) == 0
    rows = read_rows(out)
    assert [int(row["frame"]) for row in rows] == [3, 7, 8, 9]
    expected = [0.15, 0.15, 0.3, 0.15]
    np.testing.assert_allclose([float(row["offset"]) for row in rows], expected, atol=1e-9)
    part = read_scene_metadata(out / "real")
    assert len(part.gains) == 12 and part.held_out == [0, 8]
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
        ("kept=2", "has no metric depth"),
    ],
)
def test_invalid_settings_and_captures_are_refused(room, monkeypatch, capsys, setting, message):
    blind = replace(room.capture, load_depth=no_depth)
    monkeypatch.setattr(capture_registry, "read_capture", lambda path, config: blind)
    scene, out = room.scene("scene"), room.folder / "out"
    assert main(["scene", "fidelity", str(scene), "--out", str(out), "--set", setting]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("psnr_slope", "relative_slope", "reach"), [(-5, 0.125, 0.4), (-20, 0.01, 0.3)]
)
def test_reach_is_the_offset_of_the_first_limit(psnr_slope, relative_slope, reach):
    samples = [
        fidelity.Sample(
            *(0, x, x / 2, 30 + psnr_slope * x, 2 * relative_slope * x, relative_slope * x, 0.0)
        )
        for x in np.linspace(0, 1, 11)
    ]
    limits = {"max_depth_error": 0.05, "max_psnr_drop": 6.0}
    found = fidelity.FidelityStudy("room", "rendered", 30.0, samples, **limits)
    assert found.reach == pytest.approx(reach)
    assert found.unseen_limit == pytest.approx(reach / 2)
    assert found.agreement() == (1.0, 0.0)


def test_reach_is_the_crossing_of_the_fit():
    x = np.repeat(np.linspace(0, 1, 11), 9)
    y = 0.3 * x
    y[0] = 300.0  # one wrong view
    assert fidelity.reach(x, y, 0.15) == pytest.approx(0.5)
    rng = np.random.default_rng(0)
    x = rng.uniform(0, 2, 4000)
    y = 0.3 * x + rng.normal(0, 0.05, 4000)
    assert fidelity.reach(x, y, 0.15) == pytest.approx(0.5, abs=0.08)
    assert fidelity.reach([0.0, 0.4, 0.8], [0, 0.1, 0.2], 1.0) == 0.8
    assert fidelity.reach([0.1, 0.4, 0.8], [2, 2, 2], 1.0) == 0


def test_bands():
    found = fidelity.band(np.repeat([0.5, 0.0], 11), np.r_[np.arange(11), np.full(11, 7)])
    np.testing.assert_allclose(found.at, [0, 0.5])
    np.testing.assert_allclose([found.low, found.middle, found.high], [[7, 1], [7, 5], [7, 9]])
    many = fidelity.band(np.arange(40), 2.0 * np.arange(40))
    np.testing.assert_array_equal(many.counts, [5] * 8)
    np.testing.assert_allclose(many.middle, 2 * many.at)
    assert len(fidelity.band(np.arange(4000), np.arange(4000)).at) == 16


def test_held_out_frames_are_chosen_between_the_others():
    assert fidelity.choose_held_out(16, [1, 3], 2) == [2, 5, 6, 7, 10]
    assert fidelity.choose_held_out(5, [1], 2) == [2]
    with pytest.raises(ValueError, match="4 frames are too few to hold out 1 between 2"):
        fidelity.choose_held_out(4, [1], 2)


def test_displaced_poses():
    R_WC = RotationMatrix.MakeZRotation(0.3)
    path = [RigidTransform(R_WC, [1.0 * i, 2.0 * i, 0.5 * i]) for i in range(4)]
    left = np.array([-2, 1, 0]) / np.sqrt(5)
    expected = (0.4 * left, -0.4 * left, [0, 0, 0.4], [0, 0, -0.4])
    for X_WC, step in zip(fidelity.displace_pose(path, 1, 0.4), expected, strict=True):
        np.testing.assert_allclose(X_WC.translation(), path[1].translation() + step, atol=1e-12)
        np.testing.assert_array_equal(X_WC.rotation().matrix(), R_WC.matrix())
    climb = [RigidTransform(R_WC, [0.0, 0.0, 1.0 * i]) for i in range(3)]
    for path in (climb[:1], climb):
        left = fidelity.displace_pose(path, 0, 0.5)[0].translation()
        np.testing.assert_allclose(left, -0.5 * R_WC.matrix()[:, 0], atol=1e-12)


@pytest.fixture
def look(room):
    """Returns a pose that looks along the room from x [m]."""
    return lambda x: RigidTransform(room.capture.X_WCs[0].rotation(), [x, 1.5, 1.2])


@pytest.fixture
def support(room):
    """Returns the support by one fitted camera in the room, perhaps with more Gaussians."""

    def make(X_WC: RigidTransform, more: sp.GaussianScene | None = None) -> fidelity.ViewSupport:
        capture, scene = room.capture, room.gaussians
        renderer = SceneRenderer(scene if more is None else scene.merged_with(more), "3dgs")
        return fidelity.ViewSupport(renderer, (capture.K, capture.width, capture.height), [X_WC])

    return make


def test_support_falls_with_the_distance_from_the_camera(support, look):
    found = support(look(1.0))
    fractions = [found.fraction(look(x)) for x in (1.0, 0.8, 0.5, 0.2)]
    assert fractions[0] > 0.98 and fractions[-1] < 0.8
    assert fractions == sorted(fractions, reverse=True)
    assert found.distance([1.0, 1.9, 1.5]) == pytest.approx(0.5)
    behind = RotationMatrix.MakeZRotation(np.pi) @ look(1.0).rotation()
    assert found.fraction(RigidTransform(behind, [1.0, 1.5, 1.2])) == 0


def test_occluded_surfaces_are_unseen(support, look):
    y, z = (g.ravel() for g in np.meshgrid(np.arange(0, 3, 0.08), np.arange(0, 2.5, 0.08)))
    ones = np.ones((len(y), 1))
    means, quats = np.column_stack([3.0 * ones, y, z]), ones * [1.0, 0, 0, 0]
    sizes, gray = 0.06 * np.tile(ones, 3), 0.5 * np.tile(ones, 3)
    wall = sp.GaussianScene.from_colors(means, quats, sizes, 0.99 * ones[:, 0], gray)
    assert support(look(1.0)).fraction(look(3.5)) > 0.3
    assert support(look(1.0), wall).fraction(look(3.5)) < 0.02


def test_surfaces_seen_from_over_twice_the_distance_are_unseen(support, look):
    # The end wall, at 6 m, was seen from 5.5 m; now it is seen from 3.2 and from 2.4 m.
    far = support(look(0.5))
    assert far.fraction(look(2.8)) > 0.35
    assert far.fraction(look(3.6)) < 0.1
