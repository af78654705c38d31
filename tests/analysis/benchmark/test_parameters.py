import importlib
import subprocess
import sys
import textwrap
import threading

import numpy as np
import pandas as pd
import pytest
from pydrake.common.schema import Uniform, UniformDiscrete, UniformVectorX
from pydrake.systems.framework import LeafSystem

import splatpilot as sp
from splatpilot.analysis.benchmark import replay
from splatpilot.analysis.benchmark.study import (
    StudyConfig,
    parameter_rows,
    policy_texts,
    scenario_texts,
)
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.analysis.benchmark.variants import ScenarioVariant, parse_scenario, parse_variant
from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.systems.policies.reactive import ReactiveConfig


class Climb(LeafSystem):
    """Flies up."""

    def __init__(self, speed: float):
        super().__init__()
        self.DeclareVectorOutputPort("velocity", 3, lambda _, y: y.SetFromVector([0, 0, speed]))


def climb(scenario, world) -> Climb:
    return Climb(1.0)


@pytest.fixture
def short(short_scenario) -> sp.Scenario:
    """The forest of `short_scenario`, flown for 0.5 s."""
    return sp.load_config(sp.Scenario(), short_scenario, ["timeout=0.5"])


def test_tables_grids_and_distributions_are_rows():
    table = pd.DataFrame({"vehicle.drag": [0.3, 0.5], "timeout": [2.0, np.nan]})
    rows = [{"vehicle.drag": 0.3, "timeout": 2.0}, {"vehicle.drag": 0.5}]
    assert parameter_rows(table) == parameter_rows(table.to_dict("records")) == rows
    assert parameter_rows(None) == [{}]
    drag = Uniform(min=0.3, max=0.5)
    grid = {"vehicle.drag": drag, "timeout": [2, 3], "goal_radius": np.array([0.5])}
    assert [row["timeout"] for row in parameter_rows(grid)] == [2, 3]
    assert all(row["vehicle.drag"] is drag for row in parameter_rows(grid))
    drawn = parameter_rows({"vehicle.drag": drag, "goal": UniformVectorX(min=[1], max=[2])}, 3)
    assert len({row["vehicle.drag"] for row in drawn}) == len(drawn) == 3
    assert drawn[:2] == parameter_rows({"vehicle.drag": drag, "goal": UniformVectorX([1], [2])}, 2)
    texts = scenario_texts(
        ["P02"], [{"goal": np.ones(3), "vehicle.drag": drag, "timeout": np.int64(3)}]
    )
    assert texts == [
        "P02:goal=[1.0, 1.0, 1.0]:vehicle.drag=!Uniform {min: 0.3, max: 0.5}:timeout=3"
    ]


@pytest.mark.parametrize(
    ("parameters", "samples", "message"),
    [
        ({"timeout": 3.0}, None, r"parameters\['timeout'\] must be a list of values or a distrib"),
        ({"timeout": [3.0]}, 5, "samples must be None without distributions, got 5"),
        ({"timeout": Uniform(min=1, max=2)}, 0, "samples must be at least 1, got 0"),
    ],
)
def test_invalid_parameters_are_refused(parameters, samples, message):
    with pytest.raises(ValueError, match=message):
        parameter_rows(parameters, samples)


def test_scenarios_are_parsed_with_their_fields():
    short, named = "P02:world.spacing=2:policy.rate=5", "dense=out/a.yaml:goal=[1,2,3]"
    assert parse_scenario(short) == ScenarioVariant(
        "P02-world.spacing-2-policy.rate-5", "P02", ("world.spacing=2",), ("rate=5",)
    )
    assert parse_scenario(named) == ScenarioVariant("dense", "out/a.yaml", ("goal=[1,2,3]",))
    assert parse_scenario("out/x=y/a.yaml").label == "a"
    assert parse_scenario("P02:goal=[1,2,3]").label.startswith("P02-")
    assert parse_scenario(short).fields == ["world.spacing", "policy.rate"]


def test_configurations_of_policies_become_texts():
    config = ReactiveConfig(margin=0.3, speed=3.0)
    config.camera.width = 32
    texts, systems, speeds = policy_texts(["planner", config, climb])
    assert texts[0] == "planner" and texts[2] == "climb=live" and speeds == [3.0]
    assert parse_variant(texts[1]).config(3.0, None) == config
    assert systems == {"climb": climb}
    assert policy_texts({"up": climb, "r": "reactive:margin=0.2"})[0] == [
        "up=live",
        "r=reactive:margin=0.2",
    ]
    with pytest.raises(ValueError, match=r"a policy must be named, got <lambda>; .*LABEL"):
        policy_texts(lambda scenario, world: Climb(1.0))


def test_a_sweep_is_a_table_of_flights(short):
    drags = {"vehicle.drag": [0.3, 0.5], "policy.rate": [10.0]}
    flights = sp.study(short, drags, policies=["straight", "planner"], seeds=2, jobs=1)
    assert len(flights) == flights.id.nunique() == 8
    assert set(flights["vehicle.drag"]) == {0.3, 0.5} and set(flights["policy.rate"]) == {10.0}
    assert flights.groupby("seed").world_id.nunique().tolist() == [1, 1]
    names = ["outcome", "min_clearance_m", "flight_time_s", "end_x_m", "end_z_m", "bottleneck_m"]
    assert not flights[names].isna().to_numpy().any()
    drag = flights[flights.policy == "straight"].groupby("vehicle.drag").path_length_m.mean()
    assert drag.loc[0.3] > drag.loc[0.5]


def test_distributions_are_drawn_for_each_seed_and_recorded(short, tmp_path):
    parameters = {"vehicle.drag": Uniform(min=0.3, max=0.5)}
    out = tmp_path / "out"
    flights = sp.study(short, parameters, policies="straight", seeds=3, jobs=1, out=out)
    drags = flights["vehicle.drag"].tolist()
    assert len(set(drags)) == 3 and 0.3 <= min(drags) <= max(drags) <= 0.5
    written = pd.read_csv(out / "rollouts.csv")
    assert written["vehicle.drag"].tolist() == drags
    assert replay.run(study=out, id=flights.id[1])
    drawn = sp.study(short, parameters, policies="straight", seeds=1, samples=2, jobs=1)
    assert set(drawn.seed) == {0} and len(set(drawn["vehicle.drag"])) == 2


def test_a_study_grows_in_place_and_flies_only_what_is_missing(short, tmp_path, contents):
    def fly(out, rocks, policies, seeds, speeds):
        parameters = {"vehicle.drag": rocks}
        config = {"policies": policies, "seeds": seeds, "speeds": speeds}
        return sp.study({"short": short}, parameters, **config, jobs=1, out=out)

    small = fly(tmp_path / "out", [0.3], ["straight"], 1, [2.0])
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "out/rollouts").iterdir()}
    grown = fly(tmp_path / "out", [0.3, 0.5], ["planner", "straight"], 2, [1.0, 2.0])
    assert (len(small), len(grown)) == (1, 16)
    assert all(path.stat().st_mtime_ns == then for path, then in files.items())
    fly(tmp_path / "whole", [0.3, 0.5], ["planner", "straight"], 2, [1.0, 2.0])
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    with pytest.raises(ValueError, match=r"holds a study with seeds 2, not 1; choose another"):
        fly(tmp_path / "out", [0.3, 0.5], ["planner", "straight"], 1, [1.0, 2.0])


def test_systems_of_functions_fly_in_worker_processes_too(short, tmp_path, capsys):
    here = sp.study(short, policies={"up": climb, "s": "straight"}, seeds=1, jobs=1)
    there = sp.study(
        short,
        policies={"up": lambda scenario, world: Climb(1.0), "s": "straight"},
        seeds=1,
        jobs=2,
        out=tmp_path / "out",
    )
    assert here.digest.tolist() == there.digest.tolist()
    assert here.end_z_m[0] > here.end_z_m[1]
    with pytest.raises(ValueError, match="flown by a system that a function of Python made"):
        replay.run(study=tmp_path / "out", id=there.id[0])
    lock = threading.Lock()
    with pytest.raises(ValueError, match=r"policy up must be picklable .*; use one job"):
        sp.study(short, policies={"up": lambda *_: lock and Climb(1.0)}, seeds=1, jobs=2)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"seed": [1, 2]}, "must not override seed by scenario"),
        ({"policy": ["planner"]}, "must not override policy"),
        ({"policy.speed": [1.0]}, "must not set policy.speed; give the speeds"),
        ({"policy.margn": [1.0]}, "did you mean policy.margin|did you mean margin"),
        ({"vehicle.drag": [-1.0]}, r"vehicle.drag must be in \[0, inf"),
        ({"seed": Uniform(min=1, max=2)}, "must not override seed"),
        ({"world.rocks": Uniform(min=1, max=2)}, "a !UniformDiscrete of whole numbers"),
    ],
)
def test_invalid_studies_are_refused_before_they_start(short, tmp_path, parameters, message):
    with pytest.raises(ValueError, match=message):
        sp.study(short, parameters, policies="reactive", jobs=1, out=tmp_path / "out")
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_speeds_are_those_of_the_configurations(short):
    short.policy = ReactiveConfig(speed=1.5)
    assert set(sp.study(short, seeds=1, jobs=1).speed) == {1.5}
    assert set(sp.study(short, seeds=1, speeds=[1.0], jobs=1).speed) == {1.0}
    with pytest.raises(ValueError, match=r"speeds of the policies must be equal, got 1.5, 3"):
        sp.study(short, policies=["scenario", ReactiveConfig(speed=3.0)], seeds=1, jobs=1)


def test_counts_are_drawn_as_whole_numbers(short):
    flights = sp.study(
        short, {"world.rocks": UniformDiscrete(values=[1, 2])}, policies="straight", seeds=2, jobs=1
    )
    assert set(flights["world.rocks"]) <= {1, 2}
    assert flights.world_id.nunique() == 2


def test_command_line_sweeps_fields_of_scenarios(short_scenario, tmp_path, rows_of):
    out = tmp_path / "out"
    words = ["benchmark", "--scenarios", str(short_scenario), "--policies", "straight", "--seeds"]
    words += ["1", "--jobs", "1", "--out", str(out), "--sweep", "vehicle.drag=0.3,0.5"]
    assert main([*words, "--set", "goal_radius=!Uniform {min: 0.3, max: 0.4}"]) == 0
    rows = rows_of(out / "rollouts.csv")
    assert [row["vehicle.drag"] for row in rows] == ["0.3", "0.5"]
    assert all(0.3 <= float(row["goal_radius"]) <= 0.4 for row in rows)
    assert [row["scenario"] for row in rows] == ["short-vehicle.drag-0.3", "short-vehicle.drag-0.5"]
    assert StudyFolder(out).config() == StudyConfig(
        [f"{short_scenario}:vehicle.drag=0.3", f"{short_scenario}:vehicle.drag=0.5"],
        ["straight"],
        seeds=1,
        overrides=["goal_radius=!Uniform {min: 0.3, max: 0.4}"],
    )


def test_policies_of_main_are_the_cause_if_several_jobs_cannot_import_them(tmp_path):
    script = """
        from dataclasses import dataclass
        import splatpilot as sp
        from splatpilot.systems.policies.straight import Straight, StraightConfig

        for run_of_a_cell in range(2):
            @dataclass
            class HoldConfig(StraightConfig):
                pass

            sp.register_policy(HoldConfig, lambda config, world, scenario: Straight(config))
        scenario = sp.load_config(sp.Scenario(), overrides=["timeout=0.2", "world.length=8"])
        print(len(sp.study(scenario, policies="hold", seeds=1, jobs=1)))
        sp.study(scenario, policies="hold", seeds=1, jobs=2)
    """
    program = [sys.executable, "-c", textwrap.dedent(script)]
    done = subprocess.run(program, capture_output=True, text=True, cwd=tmp_path)
    assert done.stdout == "1\n"
    message = "HoldConfig must be of a module that worker processes import, got __main__; put it"
    assert message in done.stderr.splitlines()[-1]


LINEAR = """
from dataclasses import dataclass
import numpy as np
import splatpilot as sp
from pydrake.systems.framework import LeafSystem

@dataclass
class LinearConfig(sp.Config):
    rate: float = 10.0
    weights: str = ""

class Linear(LeafSystem):
    def __init__(self, config):
        super().__init__()
        v_W = np.loadtxt(config.weights)
        self.DeclareVectorOutputPort("velocity", 3, lambda _, y: y.SetFromVector(v_W))

sp.register_policy(LinearConfig, lambda config, world, scenario: Linear(config))
"""


def test_policies_of_others_have_their_own_files_of_weights(short, tmp_path, monkeypatch):
    monkeypatch.setattr(POLICIES, "_entries", dict(POLICIES._entries))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "linear_of_test", None)
    del sys.modules["linear_of_test"]
    (tmp_path / "linear_of_test.py").write_text(LINEAR)
    importlib.import_module("linear_of_test")
    (tmp_path / "w.txt").write_text("0 0 1")
    policy, out = f"mine=linear:weights={tmp_path / 'w.txt'}", tmp_path / "out"
    flights = sp.study(short, policies=policy, seeds=1, jobs=1, out=out)
    assert flights.end_z_m[0] > 1.85
    assert (out / "weights/mine.txt").read_text() == "0 0 1"
    assert "weights of mine" in StudyFolder(out).program()
    (tmp_path / "w.txt").unlink()
    assert replay.run(study=out, id=flights.id[0])
    (tmp_path / "w.txt").write_text("0 0 2")
    with pytest.raises(ValueError, match=r"w.txt has changed since"):
        sp.study(short, policies=policy, seeds=1, jobs=1, out=out)
