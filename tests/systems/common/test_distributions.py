import copy
import pickle

import pytest
from pydrake.common.schema import (
    Gaussian,
    GaussianVectorX,
    Uniform,
    UniformDiscrete,
    UniformVectorX,
)

import splatpilot as sp
from splatpilot.diagrams.flight.scenario import sample_scenario
from splatpilot.systems.common.config import parse_config
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams

DRAWN = [
    "vehicle.drag=!Uniform {min: 0.3, max: 0.5}",
    "start=[!Gaussian {mean: 0, stddev: 0.1}, 0, 2]",
    "goal=!UniformVector {min: [5, 0, 1], max: [6, 1, 2]}",
    "world.rocks=!UniformDiscrete {values: [1, 2, 3]}",
    "camera.X_PB.translation=!UniformVector {min: [0, 0, 0], max: [0.1, 0, 0]}",
    "camera.X_PB.rotation=!Uniform {}",
]


def load(*overrides: str, seed: int = 4) -> sp.Scenario:
    return sp.load_config(sp.Scenario(seed=seed), overrides=overrides)


def test_values_are_drawn_in_their_ranges_by_the_seed():
    scenario = load(*DRAWN)
    drawn = sample_scenario(scenario)
    assert drawn == sample_scenario(copy.deepcopy(scenario))
    assert drawn != sample_scenario(load(*DRAWN, seed=5))
    assert 0.3 < drawn.vehicle.drag < 0.5 and abs(drawn.start[0]) < 0.5
    assert 5 < drawn.goal[0] < 6 and 0 < drawn.goal[1] < 1 < drawn.goal[2] < 2
    assert drawn.world.rocks in (1, 2, 3) and type(drawn.world.rocks) is int
    assert 0 < drawn.camera.X_PB.translation[0] < 0.1 and drawn.camera.X_PB.IsDeterministic()
    assert isinstance(scenario.vehicle.drag, Uniform)
    assert sample_scenario(drawn) is drawn
    # Further distributions change no other value.
    assert sample_scenario(load(DRAWN[0])).vehicle.drag == drawn.vehicle.drag
    assert sample_scenario(load(*DRAWN[:3])).goal == drawn.goal


def test_distributions_of_python_equal_those_of_yaml():
    scenario = sp.Scenario(seed=4, vehicle=QuadrotorParams(drag=Uniform(min=0.3, max=0.5)))
    scenario.start = [Gaussian(mean=0, stddev=0.1), 0.0, 2.0]
    scenario.goal = UniformVectorX(min=[5, 0, 1], max=[6, 1, 2])
    scenario.world.rocks = UniformDiscrete(values=[1, 2, 3])
    assert scenario == load(*DRAWN[:4])
    scenario.start = GaussianVectorX(mean=[0, 0, 2], stddev=[0.1, -0.1, 0.1])
    with pytest.raises(ValueError, match=r"stddev of start must be at least 0"):
        sample_scenario(scenario)


@pytest.mark.parametrize(
    "overrides", [[], DRAWN, ["world=!WallsConfig {depth: !Uniform {min: 3, max: 5}}"]]
)
def test_scenarios_pickle_copy_and_are_read_again(overrides):
    scenario = load(*overrides)
    assert copy.deepcopy(scenario) == pickle.loads(pickle.dumps(scenario)) == scenario
    assert parse_config(sp.Scenario(), sp.dump_config(scenario), "again") == scenario
    assert scenario != load(*overrides, "camera.fps=7")
    assert scenario != 3


def test_worlds_pickle_and_compare_by_configuration_and_seed():
    scenario = load(
        "world={length: 8, rocks: 0, logs: 0}", "world.spacing=!Uniform {min: 2.5, max: 4}"
    )
    world = sp.make_world(scenario.world, 4)
    again = pickle.loads(pickle.dumps(world))
    assert again == world and hash(again) == hash(world)
    assert (again.gaussians.means == world.gaussians.means).all()
    assert world == sp.make_world(sample_scenario(scenario).world, 4)
    assert world != sp.make_world(scenario.world, 5)
    assert world.recolored(world.gaussians, world.background) != world


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed=!Uniform {min: 1, max: 2}", "seed must be one value, got !Uniform {min: 1.0, max"),
        ("world=!Uniform {min: 1, max: 2}", "world must be one value"),
        ("camera.fps=!Uniform {min: 1, max: 2}", "camera.fps must be a number, got !Uniform"),
        ("simulator.integration_scheme=!Uniform {min: 0, max: 1}", "scheme must be text, got !Uni"),
        ("simulator.use_error_control=!UniformDiscrete {values: [0]}", "must be true or false"),
        ("world.rocks=!Uniform {min: 1, max: 2}", "rocks must be a !UniformDiscrete of whole"),
        ("vehicle.drag=!Uniform {min: 1}", "vehicle.drag must be !Uniform {min: ..., max: ...}"),
        ("vehicle.drag=!Uniform 3", "a tag must have fields"),
        ("vehicle.drag=!Uniform {min: 2, max: 1}", "min of vehicle.drag must be at most its max"),
        ("vehicle.drag=!UniformDiscrete {values: []}", "values of vehicle.drag .* at least one"),
        ("vehicle.drag=!UniformVector {min: [1], max: [2]}", "vehicle.drag must be one value"),
        ("vehicle.drg=!Uniform {min: 1, max: 2}", "no field vehicle.drg; did you mean vehicle.dr"),
        ("goal=!Uniform {min: 1, max: 2}", "goal must be a list, .* write !UniformVector"),
        ("vehicle.drag=!Uniform {min: -3, max: -2}", r"vehicle.drag must be in .* got -2\."),
        ("policy=!ReactiveConfig {camera: {width: !UniformDiscrete {values: [9]}}}", "camera.wid"),
    ],
)
def test_invalid_distributions_are_refused(override, message):
    with pytest.raises(ValueError, match=message):
        load(override).validate()


def test_a_drawn_scenario_flies_and_is_recorded(tmp_path):
    from splatpilot.analysis.commands.main import main

    overrides = [DRAWN[0], DRAWN[4], "world={length: 8, rocks: 0, logs: 0}", "timeout=0.1"]
    words = [word for override in overrides for word in ("--set", override)]
    assert main(["fly", "--policy", "straight", "--out", str(tmp_path / "out"), *words]) == 0
    recorded = sp.load_config(sp.Scenario(), tmp_path / "out/scenario.yaml")
    assert recorded.vehicle == sample_scenario(load(DRAWN[0], seed=0)).vehicle

    scenario = load(*overrides)
    world = sp.make_world(scenario.world, scenario.seed)
    flown, drawn = (
        sp.fly(sp.BuildFlightDiagram(each, world)) for each in (scenario, sample_scenario(scenario))
    )
    assert (flown.states == drawn.states).all()
