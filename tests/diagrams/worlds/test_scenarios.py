from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds import feasibility
from splatpilot.diagrams.worlds import outdoor as branches
from splatpilot.diagrams.worlds.feasibility import CLEARANCE, connects
from splatpilot.diagrams.worlds.indoor import OfficeConfig, RoomConfig
from splatpilot.diagrams.worlds.inserted import GAP, InsertedConfig
from splatpilot.diagrams.worlds.octomap_world import OctomapConfig, voxel_gaussians
from splatpilot.diagrams.worlds.outdoor import (
    BranchesConfig,
    ClutterConfig,
    OverUnderConfig,
    WallsConfig,
)
from splatpilot.diagrams.worlds.scene_folder import SceneConfig, find_scene, write_scene_folder
from splatpilot.diagrams.worlds.solids.shading import Daylight
from splatpilot.diagrams.worlds.solids.solid import WorldSpec
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_spec, make_world
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field, esdf_from_occupancy
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, Capsule, HalfSpace
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

FILES = sorted((Path(__file__).parents[3] / "diagrams" / "scenarios").glob("*.yaml"))
GENERATED = [file for file in FILES if file.stem.startswith("P")]


def _config(name: str):
    return load_config(Scenario(), next(f for f in FILES if f.stem == name)).world


def test_there_are_seventeen_and_all_are_valid():
    assert [file.stem for file in FILES] == [
        *(f"P{k:02d}" for k in range(1, 13)),
        *(f"R{k}" for k in range(13, 18)),
    ]
    for file in FILES:
        load_config(Scenario(), file).validate()


@pytest.mark.parametrize("file", GENERATED, ids=lambda file: file.stem)
def test_instances_are_feasible_and_repeatable(file):
    config = load_config(Scenario(), file).world
    one, again, other = (make_spec(config, seed) for seed in (3, 3, 4))
    if file.stem != "P08":  # its slits need a finer grid than is worth searching twice
        ends = one.p_WS, one.p_WG
        assert connects(one.distance_field, *ends, VEHICLE_RADIUS, 0.3)
    p = np.random.default_rng(0).uniform(one.lower_W, one.upper_W, (500, 3))
    fields = [spec.distance_field for spec in (one, again, other)]
    np.testing.assert_array_equal(fields[0].distance(p), fields[1].distance(p))
    assert np.abs(fields[0].distance(p) - fields[2].distance(p)).max() > 0.05
    assert fields[0].distance(np.stack([one.p_WS, one.p_WG])).min() >= CLEARANCE


def test_walls_have_the_sizes_asked_for():

    def free_widths(spec: WorldSpec) -> list[float]:
        """Widths in y of the free stretches in the planes through the middles of walls across."""
        widths = []
        walls = {
            round(float(s.shape.X_WO.translation()[0]), 6)
            for s in spec.solids
            if isinstance(s.shape, Box) and np.isclose(np.asarray(s.shape.size)[0], 0.3)
        }
        y = np.arange(spec.lower_W[1], spec.upper_W[1], 0.005)
        for x in sorted(w for w in walls if 0 < w < spec.upper_W[0]):
            p = np.column_stack([np.full_like(y, x), y, np.full_like(y, 5.9)])
            free = spec.distance_field.distance(p) > 0
            edges = np.flatnonzero(np.diff(np.concatenate([[0], free, [0]])))
            widths += [0.005 * (b - a) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        return widths

    slits = free_widths(make_spec(_config("P08"), 1))
    np.testing.assert_allclose(slits, [1.4, 1.25, 1.1, 1.0], atol=0.012)
    np.testing.assert_allclose(free_widths(make_spec(_config("P09"), 1)), [3.6] * 4, atol=0.012)
    sides = free_widths(make_spec(_config("P06"), 1))
    assert sum(sides) == pytest.approx(2.0, abs=0.02) and max(sides) > 2 * VEHICLE_RADIUS + 0.5


def test_thin_things_are_thin_and_hit():
    spec = make_spec(_config("P11"), 2)
    thin = [s.shape for s in spec.solids if isinstance(s.shape, Capsule) and s.shape.radius < 0.05]
    assert len(thin) > 60
    assert all(0.02 <= 2 * shape.radius <= 0.04 for shape in thin)
    middles = np.array([(np.asarray(s.p_WA) + np.asarray(s.p_WB)) / 2 for s in thin])
    distance = spec.distance_field.distance(middles)
    assert (distance[np.isfinite(distance)] <= -0.0099).all()


def test_a_wire_between_grid_points_closes_the_way():
    lower, upper = np.array([0.0, -1.5, 0]), np.array([8.0, 1.5, 3])
    ends = np.array([1.5, 0, 1.5]), np.array([6.5, 0, 1.5])
    net = [Capsule([4.0, y, -1], [4.0, y, 4], 0.01) for y in np.arange(-1.3, 1.5, 0.52)]
    assert connects(AnalyticDistanceField([], lower, upper), *ends, VEHICLE_RADIUS, 0.15)
    assert not connects(AnalyticDistanceField(net, lower, upper), *ends, VEHICLE_RADIUS, 0.15)


def test_what_is_drawn_is_where_it_is_hit():
    world = make_world(_config("P10"), 1)
    p = world.gaussians.means.astype(float)
    lower, upper = world.distance_field.lower_W, world.distance_field.upper_W
    inside = ((p >= lower) & (p <= upper)).all(axis=1)
    distance = np.abs(world.distance_field.distance(p[inside]))
    assert inside.sum() > 20_000 and distance.max() < 0.07
    forward = (world.p_WG - world.p_WS) * (1, 1, 0)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    axes = np.column_stack([right, np.cross(forward, right), forward])
    X_WC = RigidTransform(RotationMatrix(axes), world.p_WS)
    K = np.array([[60.0, 0, 60], [0, 60, 45], [0, 0, 1]])
    view = world.baked.render(K, 120, 90, X_WC, near=0.05)
    v, u = np.mgrid[:90, :120] + 0.5
    rays = np.stack([(u - 60) / 60, (v - 45) / 60, np.ones_like(u)], axis=-1)
    q = X_WC.multiply((rays * view.depth[..., None]).reshape(-1, 3).T).T
    off = np.abs(world.distance_field.distance(np.clip(q, lower, upper)))
    assert view.alpha.min() > 0.9  # a closed room has no holes
    assert np.median(off) < 0.005


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (WallsConfig(pattern="maze"), "pattern must be in {big_wall.* got maze"),
        (WallsConfig(wall=13.8), "wall must be at most 13.19 m.* got 13.8"),
        (WallsConfig(pattern="slits", slits=[0.7]), r"slits must be in \[0.808, .* got \[0.7\]"),
        (WallsConfig(length=8.0), "length must be at least 13 m.* got 8.0"),
        (ClutterConfig(spheres=-1), "spheres must be .* got -1"),
        (ClutterConfig(half_min=2.0), "half_min must be at most half_max = 0.9, got 2.0"),
        (RoomConfig(height=1.0), "height must be .* got 1.0"),
        (OfficeConfig(width=3.0), "width must be .* got 3.0"),
        (OfficeConfig(door_min=0.7), r"door_min must be in \[0.808, .* got 0.7"),
        (OfficeConfig(door_height=3.1), "door_height must be at most height = 3.0, got 3.1"),
        (OfficeConfig(room=2.0), r"room must be in \[2.1, 14\] m, got 2.0"),
        (OfficeConfig(second_doors=1.5), r"second_doors must be in \[0, 1\], got 1.5"),
        (OverUnderConfig(over=5.5), "over must be at most 5.19 m.* got 5.5"),
        (OverUnderConfig(barriers=30), "length must be at least 80.5 m.* got 36.0"),
        (InsertedConfig(), "path must be a scene folder"),
        (OctomapConfig(path="x", lower=[0.0, 0, 0]), "lower and upper must be given both"),
    ],
)
def test_what_cannot_be_built_is_refused(config, message):
    with pytest.raises(ValueError, match=message):
        config.validate()


def test_infeasible_draws_are_redrawn_and_given_up(monkeypatch):
    monkeypatch.setattr(feasibility, "TRIES", 2)
    full = ClutterConfig(
        length=8, width=4, height=3, spheres=0, boxes=200, half_min=0.5, half_max=0.7, floating=True
    )
    with pytest.raises(InfeasibleFlightError, match=r"none of 2 instances .* seed 0 leaves a"):
        make_spec(full, 0)
    monkeypatch.setattr(branches, "is_feasible", lambda spec: False)
    with pytest.raises(InfeasibleFlightError, match=r"leave no route in \d+ draws from seed 0"):
        make_spec(BranchesConfig(length=8, width=5, height=3), 0)
    with pytest.raises(ValueError, match="seed must be"):
        make_spec(RoomConfig(), -1)


@pytest.fixture(scope="module")
def hall(tmp_path_factory) -> Path:
    """A folder of scenes with one in it: an empty room of 9 x 5 x 4 m on a grid."""
    field = AnalyticDistanceField(
        [HalfSpace([0.0, 0, 1], 0.0)], np.array([0.0, 0, -0.2]), np.array([9.0, 5, 4])
    )
    esdf = esdf_from_distance_field(field, 0.1)
    gaussians = GaussianScene.from_colors(
        np.zeros((1, 3)), [[1, 0, 0, 0]], np.full((1, 3), 0.1), [0.5], np.full((1, 3), 0.5)
    )
    ends = np.array([1.0, 2.5, 2.0]), np.array([8.0, 2.5, 2.0])
    world = World("hall", gaussians, esdf, esdf, (0.0, 0.0, 0.0), *ends)
    folder = tmp_path_factory.mktemp("scenes")
    write_scene_folder(folder / "hall", world, provenance="test")
    return folder


def test_scenes_are_found_by_name(hall, monkeypatch, tmp_path):
    monkeypatch.setenv("SPLATPILOT_SCENES", str(hall))
    assert find_scene(SceneConfig(path="hall")) == hall / "hall"
    monkeypatch.setenv("SPLATPILOT_SCENES", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r": hall; .*SPLATPILOT_SCENES.*; ask Ann"):
        make_world(SceneConfig(path="hall", source="ask Ann"), 0)


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
    field = world.esdf.conservative()
    assert connects(field, *ends, GAP / 2 - 0.05, 0.1)
    again = make_world(InsertedConfig(path="hall"), 0)
    np.testing.assert_array_equal(world.gaussians.means, again.gaussians.means)


def test_octomap_is_seen_where_it_is_occupied():

    occupied = np.zeros((12, 12, 12), bool)
    occupied[4:8, 4:8, :] = True
    esdf = esdf_from_occupancy(occupied, np.zeros_like(occupied), np.zeros(3), 0.5)
    scene = voxel_gaussians(esdf, Daylight.sample(np.random.default_rng(0)))
    assert len(scene) == 12 * (16 - 4)  # the column's outer voxels
    assert (np.abs(esdf.distance(scene.means.astype(float))) <= 0.5).all()
