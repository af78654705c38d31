import numpy as np
import pytest

from splatpilot.diagrams.worlds import file_worlds as module
from splatpilot.diagrams.worlds.file_worlds import OctomapConfig, octomap_world, voxel_gaussians
from splatpilot.diagrams.worlds.scene_folder import SceneConfig
from splatpilot.diagrams.worlds.solids.textures import Daylight
from splatpilot.diagrams.worlds.world_registry import scene_config
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.collision.octomap import Octomap
from splatpilot.systems.common.provenance import InfeasibleFlightError


def hall(length: int, width: int) -> Octomap:
    """A hall of voxels of 0.25 m, four meters high, free within its floor and walls."""
    x, y, z = np.meshgrid(range(length), range(width), range(16), indexing="ij")
    corners = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    walls = (corners[:, 0] == 0) | (corners[:, 1] == 0) | (corners[:, 2] == 0)
    return Octomap(0.25, corners, np.ones(len(corners), int), walls)


@pytest.fixture
def in_map(tmp_path, monkeypatch):
    """Makes the world of a map as if it stood in a file."""
    (tmp_path / "map.bt").touch()

    def make(octomap: Octomap, **fields):
        monkeypatch.setattr(module, "read_octomap", lambda path: octomap)
        return octomap_world(OctomapConfig(path=str(tmp_path / "map.bt"), **fields), 0)

    return make


def test_large_maps_are_cropped_about_free_space(in_map, monkeypatch, caplog):
    octomap = hall(80, 40)
    whole = in_map(octomap)
    np.testing.assert_allclose(whole.esdf.upper_W - whole.esdf.lower_W, [20, 10, 4])
    assert not caplog.text
    monkeypatch.setattr(module, "MAX_VOXELS", 80 * 40 * 16 / 4)
    world = in_map(octomap)
    np.testing.assert_allclose(world.esdf.upper_W - world.esdf.lower_W, [10, 5, 4], atol=0.5)
    middle = 0.5 * (world.esdf.lower_W + world.esdf.upper_W)
    np.testing.assert_allclose(middle, [10, 5, 2], atol=0.3)
    assert "map.bt is large: using the part from [5." in caplog.text
    named = in_map(octomap, lower=[0, 0, 0], upper=[10, 10, 4])
    np.testing.assert_allclose(named.esdf.upper_W, [10, 10, 4])


def test_routes_are_as_long_as_the_scenario_says_and_short_ones_are_warned_of(in_map, caplog):
    in_map(hall(24, 12))
    assert "map.bt: the longest route from a start to a goal is" in caplog.text
    in_map(hall(40, 20), draw_ends=True, min_path=6.0)
    with pytest.raises(InfeasibleFlightError, match="at least 30 m, got"):
        in_map(hall(40, 20), draw_ends=True, min_path=30.0)
    full = hall(20, 20)
    full.occupied[:] = True
    with pytest.raises(InfeasibleFlightError, match=r"map\.bt: no space from .* known to be free"):
        in_map(full)


def test_suffixes_tell_scenes_from_maps(tmp_path):
    assert scene_config(tmp_path / "a.bt") == OctomapConfig(path=str(tmp_path / "a.bt"))
    assert scene_config(tmp_path / "a.spz") == SceneConfig(path=str(tmp_path / "a.spz"))


def test_octomap_is_seen_where_it_is_occupied():
    occupied = np.zeros((12, 12, 12), bool)
    occupied[4:8, 4:8, :] = True
    esdf = esdf_from_occupancy(occupied, np.zeros_like(occupied), np.zeros(3), 0.5)
    scene = voxel_gaussians(esdf, Daylight.sample(np.random.default_rng(0)))
    assert len(scene) == 12 * (16 - 4)  # the column's outer voxels
    assert (np.abs(esdf.distance(scene.means.astype(float))) <= 0.5).all()
