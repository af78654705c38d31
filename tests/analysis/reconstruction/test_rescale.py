"""Finished scenes in another scale."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.reconstruction.rescale import rescale, run
from splatpilot.diagrams.worlds.scene_folder import (
    read_scene,
    read_scene_folder,
    read_scene_metadata,
    write_scene_folder,
    write_scene_metadata,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.training.captures.capture_registry import read_scene_capture

SHRUNK = 0.25
"""Units of the photographs' registration a meter."""


@pytest.fixture
def photographs(seen_room, tmp_path):
    """The room in nerfstudio's format without depth, in units of which nobody knows the length,
    with its points."""
    _, capture = seen_room
    path = tmp_path / "photographs"
    path.mkdir()
    frames = []
    for i in range(len(capture)):
        cv2.imwrite(str(path / f"{i:02d}.png"), capture.load_image(i)[..., ::-1])
        X_WC = capture.X_WCs[i]
        X_FC = RigidTransform(X_WC.rotation(), SHRUNK * X_WC.translation())
        matrix = X_FC.GetAsMatrix4() @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"{i:02d}.png", "transform_matrix": matrix.tolist()})
    content = {"w": 64, "h": 48, "fl_x": 32.0, "cx": 32.0, "cy": 24.0, "frames": frames}
    points = SHRUNK * capture.points.p_WQ
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    rows = "".join(f"{x} {y} {z} 90 90 90\n" for x, y, z in points)
    (path / "points.ply").write_text(f"{header}end_header\n{rows}")
    content["ply_file_path"] = "points.ply"
    (path / "transforms.json").write_text(json.dumps(content))
    return path


@pytest.fixture
def unscaled(seen_room, photographs, tmp_path):
    """The room as a scene of photographs alone: what lies behind the cameras is unknown."""
    gaussians, _ = seen_room
    occupied, unknown = np.zeros((2, 60, 30, 25), bool)
    occupied[5:, :, 0] = True
    unknown[:5] = True
    field = esdf_from_occupancy(occupied, unknown, np.zeros(3), 0.1 * SHRUNK)
    world = World(
        name="room",
        gaussians=gaussians.scaled_by(SHRUNK),
        distance_field=field,
        esdf=field,
        background=(0.1, 0.2, 0.3),
        p_WS=np.full(3, SHRUNK),
        p_WG=np.full(3, SHRUNK),
    )
    path = tmp_path / "unscaled"
    write_scene_folder(
        path,
        world,
        provenance="photographs",
        gains=[1.0] * 16,
        metric=False,
        capture=str(photographs),
        held_out=[0, 8],
        split="validation",
        source_digest=["0123456789abcdef"],
    )
    return path


def test_scene_of_photographs_can_be_flown_in_once_it_has_its_size(
    unscaled, seen_room, tmp_path, capsys
):
    with pytest.raises(ValueError, match=r"splatpilot view .* `splatpilot scene scale`"):
        read_scene(unscaled)
    before = {file.name: file.read_bytes() for file in unscaled.iterdir()}
    out = tmp_path / "scaled"
    command = [
        "scene",
        "scale",
        str(unscaled),
        "--out",
        str(out),
        "--between",
        "-0.1,0.2,0.3",
        "1.4,.2,.3",
    ]
    assert main([*command, "--distance", "6"]) == 0
    assert "6 x 3 x 2.5 m" in capsys.readouterr().out
    assert {file.name: file.read_bytes() for file in unscaled.iterdir()} == before

    old, new = read_scene_folder(unscaled, metric=False), read_scene(out)
    gaussians, capture = seen_room
    np.testing.assert_allclose(new.gaussians.means[: len(gaussians)], gaussians.means, atol=1e-5)
    metadata = read_scene_metadata(out)
    assert (metadata.split, metadata.source_digest) == ("validation", ["0123456789abcdef"])
    again = read_scene_capture(out, metadata)
    assert again.metric
    for i in (0, 15):
        X_WC = capture.X_WCs[i]
        assert again.X_WCs[i].IsNearlyEqualTo(X_WC, 1e-9)
        X_OC = RigidTransform(X_WC.rotation(), SHRUNK * X_WC.translation())
        scaled = BakedScene(old.gaussians.scaled_by(1 / SHRUNK)).render(again.K, 64, 48, X_WC)
        unit = BakedScene(old.gaussians).render(again.K, 64, 48, X_OC)
        np.testing.assert_allclose(scaled.color, unit.color, atol=1e-4)
        np.testing.assert_allclose(scaled.depth, unit.depth / SHRUNK, rtol=1e-4)
    known = new.esdf.states == old.esdf.states  # All but what closes the near end.
    assert known.mean() > 0.9
    free = old.esdf.states == FieldState.FREE
    assert (new.esdf.distances <= old.esdf.distances / SHRUNK + 1e-5)[free].all()
    assert metadata.frontier
    assert (new.esdf.states == FieldState.OCCUPIED).sum() > (
        old.esdf.states == FieldState.OCCUPIED
    ).sum()
    assert (metadata.held_out, metadata.gains) == ([0, 8], [1.0] * 16)
    assert "scaled by 4" in metadata.provenance
    assert np.linalg.norm(new.p_WG - new.p_WS) > 1.0


def test_factors_multiply(unscaled, tmp_path):
    rescale(unscaled, tmp_path / "once", 4.0)
    summary = rescale(tmp_path / "once", tmp_path / "twice", 0.5)
    once, twice = (read_scene(tmp_path / name) for name in ("once", "twice"))
    np.testing.assert_array_equal(twice.esdf.distances, 0.5 * once.esdf.distances)
    np.testing.assert_array_equal(twice.esdf.states, once.esdf.states)
    np.testing.assert_allclose(twice.gaussians.scales, 0.5 * once.gaussians.scales, rtol=1e-6)
    np.testing.assert_allclose(summary.size, [3, 1.5, 1.25])
    metadata = read_scene_metadata(tmp_path / "twice")
    assert metadata.capture_settings == ["scale.factor=2.0"]
    poses = read_scene_capture(tmp_path / "twice", metadata).X_WCs
    np.testing.assert_allclose(poses[0].translation(), [0.25, 0.75, 0.6], atol=1e-9)


def test_origin_is_scaled_with_the_scene(unscaled, tmp_path):
    origin = [100.0, 200.0, -30.0]
    metadata = replace(read_scene_metadata(unscaled), origin=origin)
    write_scene_metadata(unscaled, metadata)
    poses = read_scene_capture(unscaled, metadata).X_WCs
    rescale(unscaled, tmp_path / "scaled", 4.0)
    scaled = read_scene_metadata(tmp_path / "scaled")
    assert scaled.origin == [400.0, 800.0, -120.0]
    for X, Y in zip(poses, read_scene_capture(tmp_path / "scaled", scaled).X_WCs, strict=True):
        np.testing.assert_allclose(Y.translation(), 4 * X.translation(), atol=1e-9)


def test_known_height_of_the_cameras_gives_the_scale(unscaled, tmp_path):
    summary = run(scene=unscaled, out=tmp_path / "scaled", height=1.2)
    assert summary.factor == pytest.approx(1 / SHRUNK, rel=0.02)


def test_scene_of_measured_depth_is_not_compared_with_its_capture_any_more(place, tmp_path):
    summary = rescale(place.scene("metric"), tmp_path / "scaled", 2.0)
    assert "has metric depth" in str(summary)
    metadata = read_scene_metadata(tmp_path / "scaled")
    assert (metadata.capture, metadata.held_out, metadata.gains) == ("", [], [])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--factor", "-1"], "factor must be finite and > 0, got -1.0"),
        (["--height", "nan"], "height must be finite and > 0, got nan"),
        (["--between", "0,0,0", "0,0,0", "--distance", "1"], "points of --between must differ"),
        (["--between", "0,0", "0,0,0", "--distance", "1"], "a point X,Y,Z is needed"),
        (["--between", "0,0,1", "0,0,0"], "--between and --distance belong together"),
        (["--factor", "2", "--distance", "1"], "--between and --distance belong together"),
    ],
)
def test_scales_that_make_no_sense_are_refused(unscaled, tmp_path, capsys, words, message):
    assert main(["scene", "scale", str(unscaled), "--out", str(tmp_path / "scaled"), *words]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "scaled").exists()


def test_nothing_is_overwritten(unscaled):
    with pytest.raises(ValueError, match="exists already"):
        rescale(unscaled, unscaled, 2.0)
