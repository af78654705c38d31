from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpilot.diagrams.worlds.feasibility import connects
from splatpilot.diagrams.worlds.inserted import GAP, InsertedConfig
from splatpilot.diagrams.worlds.scene_folder import (
    SceneConfig,
    find_scene,
    read_scene_folder,
    write_scene_folder,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, HalfSpace
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS


@pytest.fixture(scope="module")
def hall(tmp_path_factory) -> Path:
    """A folder of scenes with one in it: an empty room of 9 x 5 x 4 m on a grid."""
    ground = HalfSpace([0.0, 0, 1], 0.0)
    field = AnalyticDistanceField([ground], np.array([0.0, 0, -0.2]), np.array([9.0, 5, 4]))
    esdf = esdf_from_distance_field(field, 0.1)
    dot = [[0] * 3], [[1, 0, 0, 0]], [[0.1] * 3], [0.5], [[0.5] * 3]
    ends = np.array([1.0, 2.5, 2.0]), np.array([8.0, 2.5, 2.0])
    world = World("hall", GaussianScene.from_colors(*dot), esdf, esdf, (0.0, 0.0, 0.0), *ends)
    folder = tmp_path_factory.mktemp("scenes")
    write_scene_folder(folder / "hall", world, provenance="test")
    return folder


def test_scenes_are_found_by_name(hall, monkeypatch, tmp_path):
    monkeypatch.setenv("SPLATPILOT_SCENES", str(hall))
    assert find_scene(SceneConfig(path="hall")) == hall / "hall"
    monkeypatch.setenv("SPLATPILOT_SCENES", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r": hall; .*SPLATPILOT_SCENES.*; ask Ann"):
        make_world(SceneConfig(path="hall", source="ask Ann"), 0)


@pytest.fixture(scope="module")
def house() -> World:
    return make_world(SceneConfig(path="small_house"), 0)


def test_shipped_scene_can_be_flown_in(house):
    assert len(house.gaussians) > 300_000 and house.num_frontier > 0
    ends = np.stack([house.p_WS, house.p_WG])
    assert (house.esdf.conservative().distance(ends) > VEHICLE_RADIUS).all()


def test_starts_and_goals_are_drawn_from_the_seed(hall, monkeypatch):
    monkeypatch.setenv("SPLATPILOT_SCENES", str(hall))
    config = SceneConfig(path="hall", draw_ends=True)
    worlds = [make_world(config, seed) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(worlds[0].p_WS, worlds[1].p_WS)
    assert not np.allclose(worlds[0].p_WS, worlds[2].p_WS)
    for world in worlds:
        ends = np.stack([world.p_WS, world.p_WG])
        assert (world.esdf.conservative().distance(ends) > VEHICLE_RADIUS).all()
        assert np.linalg.norm(world.p_WS - world.p_WG) > 3


def test_inserted_solids_are_seen_hit_and_leave_gaps(hall, monkeypatch):
    monkeypatch.setenv("SPLATPILOT_SCENES", str(hall))
    before = make_world(SceneConfig(path="hall"), 0)
    world = make_world(InsertedConfig(path="hall"), 0)
    new = world.gaussians.means[len(before.gaussians) :].astype(float)
    assert len(new) > 100
    assert np.abs(world.esdf.distance(new)).max() < 0.08
    changed = world.esdf.distances < before.esdf.distances - 1e-6
    assert changed.any() and (world.esdf.distances <= before.esdf.distances + 1e-6).all()
    ends = np.stack([world.p_WS, world.p_WG])
    assert world.esdf.distance(ends).min() > 0.8
    assert connects(world.esdf.conservative(), *ends, GAP / 2 - 0.05, 0.1)
    again = make_world(InsertedConfig(path="hall"), 0)
    np.testing.assert_array_equal(world.gaussians.means, again.gaussians.means)


def test_scenes_with_inserted_solids_stay_antialiased(hall, tmp_path):
    scene = read_scene_folder(hall / "hall")
    scene = replace(scene, gaussians=replace(scene.gaussians, antialiased=True))
    write_scene_folder(tmp_path / "hall", scene)
    world = make_world(InsertedConfig(path=str(tmp_path / "hall")), 0)
    assert len(world.gaussians) > 100 and world.gaussians.antialiased


def test_inserted_solids_count_as_observed(house):
    world = make_world(InsertedConfig(path="small_house"), 0)
    assert len(world.observations.voxels) > len(house.observations.voxels)
    added = world.gaussians.means[: len(world.gaussians) - len(house.gaussians)].astype(float)
    above = added.mean(axis=0) + np.array([0.0, 0.0, 5.0])
    assert world.observations.agree_with(added, above).mean() > 0.98
