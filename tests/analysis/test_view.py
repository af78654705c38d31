import base64
import gzip
import json
import re
from dataclasses import replace

import numpy as np
import pytest

import splatpilot as sp
from splatpilot.analysis import view
from splatpilot.analysis.commands.main import main
from splatpilot.analysis.view import capture_gaussians
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds import file_worlds
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata, write_scene_metadata
from splatpilot.systems.collision.octomap import Octomap


def read_data(page) -> dict:
    found = re.search(r'id="data">([^<]*)<', page.read_text())
    assert found is not None
    return json.loads(gzip.decompress(base64.b64decode(found[1])))


@pytest.fixture
def show(tmp_path):
    """Writes a page; returns its data."""
    return lambda what, **options: read_data(
        view.run(what=str(what), out=tmp_path / "page.html", overwrite=True, **options)
    )


def read_grid(data) -> np.ndarray:
    """Reads the distances (nx, ny, nz) as bytes."""
    values = gzip.decompress(base64.b64decode(data["grid"]["values"]))
    return np.frombuffer(values, np.uint8).reshape(data["grid"]["shape"], order="F")


def test_generated_world(tmp_path, capsys, set_fields):
    out = tmp_path / "there" / "forest.html"
    changes = ["world.length=8", "world.width=5", "world.height=3", "world.voxel_size=0.25"]
    assert main(["view", "P02", "--seed", "3", "--out", str(out), *set_fields(*changes)]) == 0
    assert str(out) in capsys.readouterr().out
    data = read_data(out)
    scenario = sp.load_config(sp.Scenario(), scenario_file("P02"), changes)
    esdf = sp.make_world(scenario.world, 3).esdf
    expected = np.clip(esdf.distances, 0, 2) * 127
    np.testing.assert_allclose(read_grid(data), expected, atol=0.51)
    np.testing.assert_allclose(data["upper"], esdf.upper_W, atol=1e-4)
    assert [name for _, name in data["legend"]] == ["bounds", "start", "goal"]
    assert data["unit"] == "m" and data["scale_command"] == ""
    assert "seed 3" in data["name"]


def test_scene_with_its_capture(room, show):
    data = show(scene := room.scene("scene"))
    poses = np.reshape(data["cameras"]["poses"], (-1, 4, 4))
    truth = [X_WC.GetAsMatrix4() for X_WC in room.capture.X_WCs]
    np.testing.assert_allclose(poses, truth, atol=1e-9)
    assert len(data["cameras"]["images"]) == len(data["cameras"]["names"]) == 16
    assert data["cameras"]["fov_y"] == pytest.approx(2 * np.degrees(np.arctan(24 / 32)))
    assert data["scale_command"].startswith(f"splatpilot scene scale {scene} --out ")
    assert data["size"].startswith("6 x 3 x 2.5 m")


def test_scene_without_scale_or_capture_is_shown(room, show, monkeypatch):
    def lost(path, metadata):
        raise FileNotFoundError("room: no such folder")

    monkeypatch.setattr(view, "read_scene_capture", lost)
    scene = room.scene("scene")
    write_scene_metadata(scene, replace(read_scene_metadata(scene), metric=False))
    data = show(scene)
    assert data["cameras"] is None
    assert data["unit"] == "units"
    assert data["size"].startswith("6 x 3 x 2.5 in units of unknown length")
    assert any("room: no such folder" in note for note in data["notes"])
    assert "start" not in [name for _, name in data["legend"]]


def test_capture_shows_its_measured_surfaces(room, show, monkeypatch):
    monkeypatch.setattr(view, "read_capture", lambda path, config: room.capture)
    data = show(room.folder / "captures", overrides=["capture.depth_unit=5000"])
    assert data["grid"] is None and len(data["cameras"]["poses"]) == 16
    gaussians = capture_gaussians(room.capture, range(16))
    assert gaussians is not None
    to_wall = np.minimum(np.abs(gaussians.means), np.abs(gaussians.means - [6, 3, 2.5])).min(axis=1)
    assert np.percentile(to_wall, 95) < 0.1  # The room's Gaussians are spheres of 6 cm.
    bare = replace(room.capture, load_depth=type(room.capture).load_depth)
    points = capture_gaussians(bare, range(16))
    assert points is not None
    np.testing.assert_allclose(points.means, room.capture.points.p_WQ, atol=1e-6)


def test_bare_gaussians(room, show, tmp_path):
    path = tmp_path / "room.ply"
    sp.write_ply(room.gaussians, path)
    assert show(path)["grid"] is not None
    sp.write_ply(room.gaussians.scaled_by(1000.0), path)
    data = show(path)
    assert data["grid"] is None and "Without distances" in data["notes"][0]


def test_map(tmp_path, show, monkeypatch):
    hall = np.full((20, 12, 10), sp.FieldState.FREE, np.uint8)
    hall[0] = hall[:, 0] = hall[:, :, 0] = sp.FieldState.OCCUPIED
    corners = np.argwhere(np.ones_like(hall))
    octomap = Octomap(
        0.3, corners, np.ones(len(corners), int), hall.ravel() == sp.FieldState.OCCUPIED
    )
    monkeypatch.setattr(file_worlds, "read_octomap", lambda path: octomap)
    (tmp_path / "hall.bt").touch()
    assert read_grid(show(tmp_path / "hall.bt")).shape == (20, 12, 10)
