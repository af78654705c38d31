import numpy as np
import pytest
from room import pinhole_rays

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios, scenario_file
from splatpilot.diagrams.worlds.feasibility import CLEARANCE, connects
from splatpilot.diagrams.worlds.file_worlds import OctomapConfig
from splatpilot.diagrams.worlds.indoor import OfficeConfig
from splatpilot.diagrams.worlds.inserted import InsertedConfig
from splatpilot.diagrams.worlds.outdoor import ClutterConfig, OverUnderConfig, WallsConfig
from splatpilot.diagrams.worlds.world_registry import make_spec, make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.captures.coverage import look_along


@pytest.mark.parametrize("name", [name for name in benchmark_scenarios() if name[0] == "P"])
def test_instances_are_feasible_and_repeatable(name):
    config = load_config(Scenario(), scenario_file(name)).world
    one, again, other = (make_spec(config, seed) for seed in (3, 3, 4))
    if name != "P08":  # its slits need a finer grid than is worth searching twice
        ends = one.p_WS, one.p_WG
        assert connects(one.distance_field, *ends, VEHICLE_RADIUS, 0.3)
    p = np.random.default_rng(0).uniform(one.lower_W, one.upper_W, (500, 3))
    fields = [spec.distance_field for spec in (one, again, other)]
    np.testing.assert_array_equal(fields[0].distance(p), fields[1].distance(p))
    assert np.abs(fields[0].distance(p) - fields[2].distance(p)).max() > 0.05
    assert fields[0].distance(np.stack([one.p_WS, one.p_WG])).min() >= CLEARANCE


def test_drawn_surfaces_are_those_of_the_distance_field():
    world = make_world(load_config(Scenario(), scenario_file("P10")).world, 1)
    p = world.gaussians.means.astype(float)
    lower, upper = world.distance_field.lower_W, world.distance_field.upper_W
    inside = ((p >= lower) & (p <= upper)).all(axis=1)
    distance = np.abs(world.distance_field.distance(p[inside]))
    assert inside.sum() > 20_000 and distance.max() < 0.07
    forward = world.p_WG - world.p_WS
    X_WC = look_along(world.p_WS, np.arctan2(forward[1], forward[0]), 0.0)
    K = np.array([[60.0, 0, 60], [0, 60, 45], [0, 0, 1]])
    view = world.baked.render(K, 120, 90, X_WC, near=0.05)
    rays = np.dstack([pinhole_rays(K, 120, 90), np.ones((90, 120))])
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
        (ClutterConfig(half_min=2.0), "half_min must be at most half_max = 0.9, got 2.0"),
        (OfficeConfig(door_height=3.1), "door_height must be at most height = 3.0, got 3.1"),
        (OfficeConfig(room=2.0), r"room must be in \[2.1, 14\] m, got 2.0"),
        (OverUnderConfig(over=5.5), "over must be at most 5.19 m.* got 5.5"),
        (OverUnderConfig(barriers=30), "length must be at least 80.5 m.* got 36.0"),
        (InsertedConfig(), "path must be a scene folder"),
        (OctomapConfig(path="x", lower=[0.0, 0, 0]), "lower and upper must be given both"),
    ],
)
def test_invalid_worlds_are_refused(config, message):
    with pytest.raises(ValueError, match=message):
        config.validate()
