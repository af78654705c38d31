"""Flights that fail, and faults that are no failures of flights."""

import json
from dataclasses import dataclass, replace

import pytest

from splatpilot.analysis.benchmark import replay, rollout
from splatpilot.analysis.benchmark import run_study as benchmark
from splatpilot.analysis.benchmark.rollout import Fault
from splatpilot.analysis.benchmark.run_study import fly_all
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder, keep_inputs, kept_flights
from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.forest.layout import ForestConfig
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.systems.policies.straight import Straight


def test_infeasible_flight_fails_with_a_reason(short_scenario, tmp_path, capsys, rows_of):
    overrides = ["goal=[6.5, 0, 0.36]"]
    config = StudyConfig([str(short_scenario)], ["straight", "planner"], [2.0], 1, overrides)
    table = benchmark.run(config=config, out=tmp_path / "near", jobs=1)
    assert [row["infeasible"] for row in table] == [0, 1]
    assert (table[1]["flights"], table[1]["successes"]) == (1, 0)
    assert "must be at least" in rows_of(tmp_path / "near" / "rollouts.csv")[1]["reason"]

    config = replace(config, overrides=["goal=[50, 0, 1.8]"])
    table = benchmark.run(config=config, out=tmp_path / "far", jobs=1)
    assert [row["infeasible"] for row in table] == [1, 1]
    assert "short-straight-2-000, infeasible: goal" in capsys.readouterr().out
    words = ["--scenarios", str(short_scenario), "--policies", "straight,planner", "--seeds", "1"]
    words += ["--out", str(tmp_path / "far"), "--set", *config.overrides, "--json"]
    assert main(["benchmark", *words]) == 1  # No flight is no success,
    printed = capsys.readouterr()
    assert "none of the flights could be flown" in printed.err
    assert [row["infeasible"] for row in json.loads(printed.out)] == [1, 1]  # but a result.
    with pytest.raises(ValueError, match=r"could not be flown .* is outside the world"):
        replay.run(study=tmp_path / "far", id="short-straight-2-000")


def test_a_scene_without_a_start_and_goal_does_not_stop_the_study(place, tmp_path, short_scenario):
    hall = place.scene("hall", metric=True)
    longway = tmp_path / "longway.yaml"
    longway.write_text(f"world: !SceneConfig {{path: {hall}, draw_ends: true, least_way: 30}}\n")
    config = StudyConfig([str(longway), str(short_scenario)], ["straight"], seeds=1)
    [row] = benchmark.run(config=config, out=tmp_path / "out", jobs=1)
    assert (row["flights"], row["infeasible"]) == (2, 1)


def test_a_flight_that_becomes_infeasible_is_an_error_of_its_row(
    short_scenario, tmp_path, monkeypatch, rows_of
):
    update = Straight._update

    def fail_later(policy, context, discrete_state):
        if context.get_time() > 0.5:
            raise InfeasibleFlightError("no route leads to the goal")
        update(policy, context, discrete_state)

    monkeypatch.setattr(Straight, "_update", fail_later)
    config = StudyConfig([str(short_scenario)], ["straight", "planner"], [2.0], 1)
    straight, planner = benchmark.run(config=config, out=tmp_path / "out", jobs=1)
    assert (straight["error"], straight["infeasible"], planner["error"]) == (1, 0, 0)
    row = rows_of(tmp_path / "out" / "rollouts.csv")[0]
    assert row["outcome"] == "error" and 0.5 < float(row["flight_time_s"]) < 0.6
    assert row["reason"].startswith("at t = 0.53 s, p_WB = [")
    assert "no route leads to the goal" in (tmp_path / "out" / "report.html").read_text()
    assert replay.run(study=tmp_path / "out", id="short-straight-2-000").exact


def test_a_policy_that_raises_stops_the_study(short_scenario, tmp_path, monkeypatch, capsys):
    update = Straight._update

    def fail_later(policy, context, discrete_state):
        update(policy, context, discrete_state)
        if context.get_time() > 0.5:
            raise KeyError("depth")

    monkeypatch.setattr(Straight, "_update", fail_later)
    words = ["--scenarios", str(short_scenario), "--policies", "straight", "--jobs", "1"]
    assert main(["benchmark", "--out", str(tmp_path / "out"), *words]) == 1
    error = capsys.readouterr().err
    assert "at t = 0.53 s, p_WB = [" in error and "KeyError: 'depth'" in error
    traceback = (tmp_path / "out" / "errors" / "short-straight-2-000.txt").read_text()
    assert "in fail_later" in traceback


def test_exception_stops_the_study(short_scenario, tmp_path, capsys, rows_of):
    out = tmp_path / "out"
    words = ["benchmark", "--out", str(out), "--scenarios", str(short_scenario), "--seeds", "2"]
    words += ["--policies", "straight,straight:rate=7", "--jobs", "2"]
    measures = "splatpilot.analysis.benchmark.rollout.flight_metrics"

    def refuse(flight, shortest):
        raise ZeroDivisionError("of the policy\nwith a second line")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measures, refuse)
        assert main([*words[:-1], "1"]) == 1
    error = capsys.readouterr().err
    file = out / "errors" / "short-straight-2-000.txt"
    assert "flight short-straight-2-000 was ended by an exception" in error
    assert f"ZeroDivisionError: of the policy (traceback in {file})" in error
    assert "in refuse" in file.read_text() and "Traceback" in file.read_text()
    assert not (out / "rollouts.csv").exists()

    assert main(words) == 0
    assert not (out / "errors").exists()
    assert len(rows_of(out / "rollouts.csv")) == 4


def test_fault_in_a_worker_process_stops_the_study(short_scenario, tmp_path):
    shipped = PolicyCheckpoint.load("", "diffaero", DIFFAERO_NETWORK)
    mine = tmp_path / "mine.npz"
    PolicyCheckpoint("diffaero", shipped.spec, dict(shipped.weights), {}).save(mine)
    config = StudyConfig([str(short_scenario)], ["straight", f"mine={mine}"], seeds=3)
    folder = StudyFolder(tmp_path / "out")
    folder.claim(config, {})
    keep_inputs(folder, config, config.load_scenarios())
    flights = list(kept_flights(folder, config.rollouts()))
    folder.weights("mine").unlink()
    flown = list(fly_all(flights, jobs=2))
    faults = [fault for fault in flown if isinstance(fault, Fault)]
    assert {fault.id for fault in faults} == {f"short-mine-2-00{seed}" for seed in range(3)}
    assert all("FileNotFoundError: No such file of weights:" in fault.reason for fault in faults)
    assert len(flown) == 6


def test_worlds_of_two_types_with_the_same_fields_are_two(monkeypatch):

    @dataclass
    class OtherForestConfig(ForestConfig):
        pass

    monkeypatch.setattr(rollout, "make_world", lambda config, seed: (type(config), seed))
    for config in (ForestConfig(), OtherForestConfig()):
        for seed in (1_000, 1_001):
            scenario = Scenario(seed=seed, world=config)
            assert rollout.study_world(scenario) == (type(config), seed)
