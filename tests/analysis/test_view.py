import base64
import gzip
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from splatpilot.analysis import view
from splatpilot.analysis.commands.main import main
from splatpilot.analysis.view import capture_gaussians
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds import octomap_world
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata, write_scene_metadata
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.octomap import Octomap
from splatpilot.systems.common.config import load_config
from splatpilot.systems.splats.splat_files import write_ply


def data_of(page) -> dict:
    """Reads the data of a page."""
    found = re.search(r'id="data">([^<]*)<', page.read_text())
    assert found is not None
    return json.loads(gzip.decompress(base64.b64decode(found[1])))


def grid_of(data) -> np.ndarray:
    """Reads the distances (nx, ny, nz) as bytes."""
    values = gzip.decompress(base64.b64decode(data["grid"]["values"]))
    return np.frombuffer(values, np.uint8).reshape(data["grid"]["shape"], order="F")


def test_generated_world(tmp_path, capsys, set_fields):
    out = tmp_path / "there" / "forest.html"
    changes = ["world.length=8", "world.width=5", "world.height=3", "world.voxel_size=0.25"]
    assert main(["view", "P02", "--seed", "3", "--out", str(out), *set_fields(*changes)]) == 0
    assert str(out) in capsys.readouterr().out
    data = data_of(out)
    scenario = load_config(Scenario(), scenario_file("P02"), changes)
    esdf = make_world(scenario.world, 3).esdf
    expected = np.clip(esdf.distances, 0, 2) * 127
    np.testing.assert_allclose(grid_of(data), expected, atol=0.51)
    np.testing.assert_allclose(data["upper"], esdf.upper_W, atol=1e-4)
    assert [name for _, name in data["legend"]] == ["bounds", "start", "goal"]
    assert data["unit"] == "m" and data["scale_command"] == ""
    assert "seed 3" in data["name"]


def test_scene_with_its_capture(room):
    scene = room.scene("scene")
    data = data_of(view.run(what=str(scene), out=room.folder / "page.html"))
    poses = np.reshape(data["cameras"]["poses"], (-1, 4, 4))
    truth = [X_WC.GetAsMatrix4() for X_WC in room.capture.X_WCs]
    np.testing.assert_allclose(poses, truth, atol=1e-9)
    assert len(data["cameras"]["images"]) == len(data["cameras"]["names"]) == 16
    assert data["cameras"]["fov_y"] == pytest.approx(2 * np.degrees(np.arctan(24 / 32)))
    assert data["scale_command"].startswith(f"splatpilot scene scale {scene} --out ")
    assert data["size"].startswith("6 x 3 x 2.5 m")


def test_scene_without_scale_or_capture_is_shown(room, monkeypatch):
    def lost(path, metadata):
        raise FileNotFoundError("room: no such folder")

    monkeypatch.setattr(view, "read_scene_capture", lost)
    scene = room.scene("scene")
    write_scene_metadata(scene, replace(read_scene_metadata(scene), metric=False))
    data = data_of(view.run(what=str(scene), out=room.folder / "page.html"))
    assert data["cameras"] is None
    assert data["unit"] == "units"
    assert data["size"].startswith("6 x 3 x 2.5 in units of unknown length")
    assert any("room: no such folder" in note for note in data["notes"])
    assert "start" not in [name for _, name in data["legend"]]


def test_capture_shows_its_measured_surfaces(room, monkeypatch, tmp_path):
    folder = tmp_path / "capture"
    folder.mkdir()
    monkeypatch.setattr(view, "read_capture", lambda path, config: room.capture)
    data = data_of(view.run(what=str(folder), out=tmp_path / "page.html"))
    assert data["grid"] is None and len(data["cameras"]["poses"]) == 16
    gaussians = capture_gaussians(room.capture, range(16))
    assert gaussians is not None
    to_wall = np.minimum(np.abs(gaussians.means), np.abs(gaussians.means - [6, 3, 2.5])).min(axis=1)
    assert np.percentile(to_wall, 95) < 0.1  # The room's Gaussians are spheres of 6 cm.
    bare = replace(room.capture, load_depth=type(room.capture).load_depth)
    points = capture_gaussians(bare, range(16))
    assert points is not None
    np.testing.assert_allclose(points.means, room.capture.points.p_WQ, atol=1e-6)


def test_bare_gaussians(room, tmp_path):
    path = tmp_path / "room.ply"
    write_ply(room.gaussians, path)
    assert data_of(view.run(what=str(path), out=tmp_path / "a.html"))["grid"] is not None
    write_ply(room.gaussians.scaled_by(1000.0), path)
    data = data_of(view.run(what=str(path), out=tmp_path / "b.html"))
    assert data["grid"] is None and "Without distances" in data["notes"][0]
    records = np.zeros(100, [("p", "<f4", 3), ("s", "<f4", 3), ("rgba_q", "u1", 8)])
    records["p"], records["s"] = room.gaussians.means[:100], room.gaussians.scales[:100]
    records["rgba_q"] = 200
    records.tofile(tmp_path / "room.splat")
    data = data_of(view.run(what=str(tmp_path / "room.splat"), out=tmp_path / "c.html"))
    assert data["name"] == "room"


def test_map(tmp_path, monkeypatch):
    hall = np.full((20, 12, 10), FieldState.FREE, np.uint8)
    hall[0] = hall[:, 0] = hall[:, :, 0] = FieldState.OCCUPIED
    corners = np.argwhere(np.ones_like(hall))
    octomap = Octomap(0.3, corners, np.ones(len(corners), int), hall.ravel() == FieldState.OCCUPIED)
    monkeypatch.setattr(octomap_world, "read_octomap", lambda path: octomap)
    (tmp_path / "hall.bt").touch()
    data = data_of(view.run(what=str(tmp_path / "hall.bt"), out=tmp_path / "page.html"))
    assert grid_of(data).shape == (20, 12, 10)
