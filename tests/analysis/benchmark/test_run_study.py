import os
import re
import shutil
import signal
import threading
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from pydrake.common.schema import Uniform, UniformDiscrete
from pydrake.systems.framework import LeafSystem

import splatpilot as sp
from splatpilot.analysis.benchmark import replay, run_study
from splatpilot.analysis.benchmark.run_study import chunks
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.analysis.benchmark.tables import DODGEDRONE_SPEEDS, PUBLISHED
from splatpilot.analysis.benchmark.variants import BENCHMARK_POLICIES
from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.systems.policies.reactive import ReactiveConfig
from splatpilot.systems.policies.straight import Straight, StraightConfig


def test_chunks_are_flights_through_one_world(short_scenario):
    config = StudyConfig([str(short_scenario)], ["planner", "straight"], [1.5, 2.0], seeds=3)
    flights = [(spec, spec.id) for spec in config.rollouts()]
    parts = list(chunks(flights, 3))
    assert [flight for part in parts for flight in part] == flights
    assert [len(part) for part in parts] == [3, 1] * 3
    assert all(len({spec.seed for spec, _ in part}) == 1 for part in parts)


def test_variants_of_a_scenario_share_chunks_if_they_share_worlds():
    texts = ["P02:vehicle.drag=0.3", "P02:world.spacing=2", "P02:vehicle.drag=0.5"]
    config = StudyConfig(texts, ["straight"], seeds=2)
    flights = [(spec, spec.id) for spec in config.rollouts()]
    changed = {each.label: each for each in config.scenario_variants}
    parts = [[spec.scenario for spec, _ in part] for part in chunks(flights, 6, changed)]
    drags = ["P02-vehicle.drag-0.3", "P02-vehicle.drag-0.5"]
    assert parts == [drags, drags, *[["P02-world.spacing-2"]] * 2]


def test_study_has_all_flights_tables_and_a_report(study, rows_of):
    config, out = study
    rows = rows_of(out / "rollouts.csv")
    assert [row["id"] for row in rows] == [spec.id for spec in config.rollouts()]
    for row, spec in zip(rows, config.rollouts(), strict=True):
        _, arrays = StudyFolder(out).read(spec)
        assert arrays["times"][-1] == pytest.approx(float(row["flight_time_s"]))
        clearance = float(np.nanmin(arrays["clearances"]))
        assert clearance == pytest.approx(float(row["min_clearance_m"]), abs=1e-6)
    assert {row["id"] for row in rows_of(out / "timings.csv")} == {row["id"] for row in rows}
    table = rows_of(out / "table.csv")
    assert [row["policy"] for row in table] == config.policies
    assert all(int(row["flights"]) == 3 for row in table)
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    assert "http" not in page.replace("http-equiv", "")
    assert all(f"splatpilot replay . {row['id']} --meshcat" in page for row in rows)
    assert all(f'href="replays/{row["id"]}/flight.html"' in page for row in rows)
    assert 'name="viewport"' in page and "color-scheme: light dark" in page
    for heading in ("Policies", "Scenarios", "Pairs of policies on the same flights"):
        assert f"<h2>{heading}, development seeds</h2>" in page
    assert not list(out.rglob(".*"))


def test_study_interrupted_before_its_flights_is_resumed(benchmark, monkeypatch, tmp_path, rows_of):
    def interrupt(*words):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(run_study, "keep_inputs", interrupt)
        assert benchmark("begun", "--policies", "straight") == 130
    assert benchmark("begun", "--policies", "straight") == 0
    assert len(rows_of(tmp_path / "begun" / "rollouts.csv")) == 1


def test_damaged_files_are_flown_again_and_reported(study, tmp_path, capsys, contents):
    config, whole = study
    out = tmp_path / "damaged"
    shutil.copytree(whole, out)
    files = [out / "rollouts" / f"{spec.id}.npz" for spec in config.rollouts()]
    content = files[0].read_bytes()
    files[0].write_bytes(content[:547] + bytes(24) + content[571:])
    shutil.copyfile(files[4], files[3])
    untouched = files[1].stat().st_mtime_ns
    run_study.run(config=config, out=out, jobs=1)
    printed = capsys.readouterr().out
    assert f"{files[0]} is damaged" in printed
    assert f"{files[3]} is of another flight" in printed
    assert "4 of 6 flights exist already" in printed
    assert contents(out) == contents(whole)
    assert files[1].stat().st_mtime_ns == untouched
    assert "is damaged" in (out / "report.html").read_text()


def test_folder_of_another_study_is_refused(study, tmp_path, contents):
    config, whole = study
    before = contents(whole)
    for changes, message in (
        ({"seeds": 2}, "holds a study with seeds 3, not 2"),
        ({"overrides": ["timeout=2"]}, r"study with overrides \[\], not \['timeout=2'\]"),
        ({"split": "test"}, "holds a study with split dev, not test; choose"),
    ):
        with pytest.raises(ValueError, match=message):
            run_study.run(config=replace(config, **changes), out=whole, jobs=1)
    assert contents(whole) == before
    other = tmp_path / "other"
    shutil.copytree(whole, other)
    next(other.glob("rollouts/*")).unlink()
    text = (other / "study.yaml").read_text()
    (other / "study.yaml").write_text(re.sub(r"numpy: .*", "numpy: 0.1", text))
    with pytest.raises(ValueError, match=r"numpy of .* must be 0.1"):
        run_study.run(config=config, out=other, jobs=1)
    (tmp_path / "thesis.txt").write_text("")
    with pytest.raises(ValueError, match="is not empty and holds no study"):
        run_study.run(config=config, out=tmp_path, jobs=1)


def test_absent_scene_is_not_run_and_never_passed(short_scenario, tmp_path, capsys):
    absent = tmp_path / "R99.yaml"
    absent.write_text(f"world: !SceneConfig {{path: {tmp_path / 'nowhere'}}}\n")
    config = StudyConfig([str(short_scenario), str(absent)], ["straight"], [2.0], seeds=2)
    table = run_study.run(config=config, out=tmp_path / "out", jobs=1).table
    assert (table[0]["flights"], table[0]["not_run"]) == (2, 2)
    printed = capsys.readouterr().out
    assert f"R99 is not flown: No such file or folder: {tmp_path / 'nowhere'}" in printed
    assert "R99 was not run" in (tmp_path / "out" / "report.html").read_text()

    with pytest.raises(FileNotFoundError, match=r"nothing can be flown: .*nowhere"):
        run_study.run(config=replace(config, scenarios=[str(absent)]), out=tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_cluster_flies_the_same_study_and_survives_the_death_of_a_worker(
    study, tmp_path, contents, monkeypatch
):
    distributed = pytest.importorskip("distributed")
    config, whole = study
    out = tmp_path / "cluster"
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        with distributed.Client(cluster) as client:
            victim, _ = client.run(os.getpid).values()
        killed = []
        write = StudyFolder.write

        def write_and_kill(folder: StudyFolder, rollout) -> None:
            write(folder, rollout)
            if not killed:
                killed.append(os.kill(victim, signal.SIGKILL))

        monkeypatch.setattr(StudyFolder, "write", write_and_kill)
        run_study.run(config=config, out=out, cluster=cluster.scheduler_address)
    assert killed
    assert contents(out) == contents(whole)


def test_missing_cluster_is_named(study, tmp_path, monkeypatch):
    config, _ = study
    monkeypatch.setattr(run_study, "CONNECT_TIMEOUT", 0.5)
    with pytest.raises(OSError, match=r"tcp://127.0.0.1:1 .*dask worker"):
        run_study.run(config=config, out=tmp_path / "out", cluster="tcp://127.0.0.1:1")


def test_test_study_flies_only_in_test_scenes_each_one_environment(room, tmp_path, capsys):
    hall = tmp_path / "hall.yaml"
    config = StudyConfig([str(hall)], ["straight"], seeds=1, split="test")
    hall.write_text(f"world: !SceneConfig {{path: {room.scene('own', split='train')}}}\n")
    with pytest.raises(ValueError, match=r"split of .*own, in which hall flies, must be test"):
        run_study.run(config=config, out=tmp_path / "out", jobs=1)
    hall.write_text(f"world: !SceneConfig {{path: {room.scene('held', split='test')}}}\n")
    (row,) = run_study.run(config=config, out=tmp_path / "out", jobs=1).table
    assert row["flights"] == 1
    assert "test seeds" in capsys.readouterr().out
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Each of hall is one environment" in page and "<h2>Policies, test seeds</h2>" in page


def test_one_option_flies_the_dodgedrone_challenge(monkeypatch, tmp_path):
    studies = []

    def run(*, config, out, jobs, cluster):
        studies.append(config)
        return run_study.Flown([], [])

    monkeypatch.setattr(run_study, "run", run)
    command = ["benchmark", "--dodgedrone", "--out", str(tmp_path)]
    assert main(command) == 0
    main([*command, "--scenarios", "dodgedrone_easy", "--speeds", "3", "--seeds", "2"])
    whole, part = studies
    assert whole.scenarios == list(PUBLISHED) and whole.speeds == list(DODGEDRONE_SPEEDS)
    assert tuple(whole.policies) == BENCHMARK_POLICIES and whole.seeds == 20
    assert (part.scenarios, part.speeds, part.seeds) == (["dodgedrone_easy"], [3.0], 2)
    assert len(whole.load_scenarios()) == 3
    for policy in BENCHMARK_POLICIES:
        for speed in DODGEDRONE_SPEEDS:
            policy_named(policy, speed)


class Climb(LeafSystem):
    def __init__(self, speed: float = 1.0):
        super().__init__()
        self.DeclareVectorOutputPort("velocity", 3, lambda _, y: y.SetFromVector([0, 0, speed]))


@dataclass
class ClimbConfig(sp.Config):
    rate: float = 10.0
    weights: str = ""


@pytest.fixture
def short(short_scenario) -> sp.Scenario:
    return sp.load_config(sp.Scenario(), short_scenario, ["timeout=0.5"])


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
    rocks = UniformDiscrete(values=[1, 2])
    parameters = {"vehicle.drag": Uniform(min=0.3, max=0.5), "world.rocks": rocks}
    out = tmp_path / "out"
    flights = sp.study(short, parameters, policies="straight", seeds=3, jobs=1, out=out)
    drags = flights["vehicle.drag"].tolist()
    assert len(set(drags)) == 3 and 0.3 <= min(drags) <= max(drags) <= 0.5
    assert set(flights["world.rocks"]) == {1, 2}
    assert pd.read_csv(out / "rollouts.csv")["vehicle.drag"].tolist() == drags
    assert replay.run(study=out, id=flights.id[1])
    drawn = sp.study(short, parameters, policies="straight", seeds=1, samples=2, jobs=1)
    assert set(drawn.seed) == {0} and len(set(drawn["vehicle.drag"])) == 2


def test_a_study_grows_in_place_and_flies_only_what_is_missing(short, tmp_path, contents):
    def fly(name, drags, seeds, speeds, policies=("planner", "straight")):
        parameters, config = {"vehicle.drag": drags}, {"seeds": seeds, "speeds": speeds}
        out = tmp_path / name
        return sp.study({"short": short}, parameters, policies=policies, **config, jobs=1, out=out)

    assert len(fly("out", [0.3], 1, [2.0], ["straight"])) == 1
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "out/rollouts").iterdir()}
    assert len(fly("out", [0.3, 0.5], 2, [1.0, 2.0])) == 16
    assert all(path.stat().st_mtime_ns == then for path, then in files.items())
    fly("whole", [0.3, 0.5], 2, [1.0, 2.0])
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    with pytest.raises(ValueError, match=r"holds a study with seeds 2, not 1; choose another"):
        fly("out", [0.3, 0.5], 1, [1.0, 2.0])


def test_systems_of_functions_fly_in_worker_processes_too(short, tmp_path):
    here = sp.study(short, policies={"up": lambda *_: Climb(), "s": "straight"}, seeds=1, jobs=1)
    assert here.end_z_m[0] > here.end_z_m[1]
    policies, out = {"up": lambda scenario, world: Climb(), "s": "straight"}, tmp_path / "out"
    there = sp.study(short, policies=policies, seeds=1, jobs=2, out=out)
    assert here.digest.tolist() == there.digest.tolist()
    with pytest.raises(ValueError, match="flown by a system that a function of Python made"):
        replay.run(study=out, id=there.id[0])


def test_a_study_is_not_continued_by_a_function_that_holds_other_values(short, tmp_path):
    def climbing(speed):
        return lambda *_: speed and Climb()

    def fly(make):
        return sp.study(short, policies={"up": make}, seeds=1, jobs=1, out=tmp_path / "out")

    fly(climbing(1.0))
    assert len(fly(climbing(1.0))) == 1
    for other in (climbing(2.0), partial(lambda a, *_: Climb(), 1.0)):
        with pytest.raises(ValueError, match=r"system of up of .* must be"):
            fly(other)


def test_what_worker_processes_cannot_import_is_refused(short, registered):
    lock = threading.Lock()
    with pytest.raises(ValueError, match=r"policy up must be picklable .*; use one job"):
        sp.study(short, policies={"up": lambda *_: lock and Climb()}, seeds=1, jobs=2)
    for _ in range(2):  # as runs of a notebook's cell

        @dataclass
        class HoldConfig(StraightConfig):
            __module__ = "__main__"

        sp.register_policy(HoldConfig, lambda config, world, scenario: Straight(config))
    assert len(sp.study(short, policies="hold", seeds=1, jobs=1)) == 1
    message = "HoldConfig must be of a module that worker processes import, got __main__; put it"
    with pytest.raises(ValueError, match=message):
        sp.study(short, policies="hold", seeds=1, jobs=2)


@pytest.mark.parametrize(
    ("parameters", "samples", "message"),
    [
        ({"timeout": 3.0}, None, r"parameters\['timeout'\] must be a list of values or a distrib"),
        ({"timeout": [3.0]}, 5, "samples must be None without distributions, got 5"),
        ({"timeout": Uniform(min=1, max=2)}, 0, "samples must be at least 1, got 0"),
        ({"seed": [1, 2]}, None, "must not override seed by scenario"),
        ({"policy": ["planner"]}, None, "must not override policy"),
        ({"policy.speed": [1.0]}, None, "must not set policy.speed; give the speeds"),
        ({"policy.margn": [1.0]}, None, "did you mean policy.margin|did you mean margin"),
        ({"vehicle.drag": [-1.0]}, None, r"vehicle.drag must be in \[0, inf"),
        ({"seed": Uniform(min=1, max=2)}, None, "must not override seed"),
        ({"world.rocks": Uniform(min=1, max=2)}, None, "a !UniformDiscrete of whole numbers"),
    ],
)
def test_invalid_studies_are_refused_before_they_start(
    short, tmp_path, parameters, samples, message
):
    out = tmp_path / "out"
    with pytest.raises(ValueError, match=message):
        sp.study(short, parameters, samples=samples, policies="reactive", jobs=1, out=out)
    assert not out.exists() or not list(out.iterdir())


def test_speeds_are_those_of_the_configurations(short):
    short.policy = ReactiveConfig(speed=1.5)
    assert set(sp.study(short, seeds=1, jobs=1).speed) == {1.5}
    assert set(sp.study(short, seeds=1, speeds=[1.0], jobs=1).speed) == {1.0}
    with pytest.raises(ValueError, match=r"speeds of the policies must be equal, got 1.5, 3"):
        sp.study(short, policies=["scenario", ReactiveConfig(speed=3.0)], seeds=1, jobs=1)


def test_command_line_sweeps_fields_of_scenarios(benchmark, short_scenario, tmp_path, rows_of):
    out, goal_radius = tmp_path / "out", "goal_radius=!Uniform {min: 0.3, max: 0.4}"
    words = "--policies", "straight", "--sweep", "vehicle.drag=0.3,0.5", "--set", goal_radius
    assert benchmark("out", *words) == 0
    rows = rows_of(out / "rollouts.csv")
    assert [row["vehicle.drag"] for row in rows] == ["0.3", "0.5"]
    assert all(0.3 <= float(row["goal_radius"]) <= 0.4 for row in rows)
    assert [row["scenario"] for row in rows] == ["short-vehicle.drag-0.3", "short-vehicle.drag-0.5"]
    scenarios = [f"{short_scenario}:vehicle.drag={drag}" for drag in ("0.3", "0.5")]
    expected = StudyConfig(scenarios, ["straight"], seeds=1, overrides=[goal_radius])
    assert StudyFolder(out).config() == expected


def test_policies_of_others_have_their_own_files_of_weights(short, tmp_path, registered):
    sp.register_policy(ClimbConfig, lambda config, *_: Climb(float(np.loadtxt(config.weights))))
    file, out = tmp_path / "w.txt", tmp_path / "out"
    file.write_text("1")
    policy = f"mine=climb:weights={file}"
    flights = sp.study(short, policies=policy, seeds=1, jobs=1, out=out)
    assert flights.end_z_m[0] > 1.85
    assert (out / "weights/mine.txt").read_text() == "1"
    assert "weights of mine" in StudyFolder(out).program()
    file.unlink()
    assert replay.run(study=out, id=flights.id[0])
    file.write_text("2")
    with pytest.raises(ValueError, match=r"w.txt has changed since"):
        sp.study(short, policies=policy, seeds=1, jobs=1, out=out)
