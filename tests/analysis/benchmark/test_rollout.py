import json
import math
from dataclasses import dataclass
from itertools import product

import numpy as np
import pytest

import splatpilot as sp
from splatpilot.analysis.benchmark import replay, rollout, run_study
from splatpilot.analysis.benchmark.rollout import (
    Fault,
    flight_metrics,
    jerk_metrics,
    shortest_length,
)
from splatpilot.analysis.benchmark.run_study import fly_all
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder, keep_inputs, kept_flights
from splatpilot.diagrams.flight.simulation import Flight, Outcome
from splatpilot.diagrams.worlds.forest.layout import ForestConfig
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Cylinder
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.systems.policies.straight import Straight
from splatpilot.systems.policies.time_of_arrival import path_lengths
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS


def straight_flight(outcome=Outcome.GOAL, clearance=0.5) -> Flight:
    """Two meters a second along x for three seconds, and a last sample between two periods."""
    times = np.append(np.arange(151) * 0.02, 3.007)
    states = np.zeros((152, 13))
    states[:, 0], states[:, 3] = 2.0 * times, 2.0
    return Flight(
        outcome, times, states, np.zeros((152, 4)), np.full(152, clearance), np.empty((0, 0)), 1.0
    )


def test_metrics_of_a_straight_flight():
    metrics = flight_metrics(straight_flight(), shortest=5.0)
    assert metrics["success"]
    assert metrics["path_length_m"] == pytest.approx(6.014)
    assert metrics["mean_speed_m_s"] == pytest.approx(2.0)
    assert metrics["path_excess"] == pytest.approx(6.014 / 5.0 - 1)
    assert metrics["jerk_m_s3"] == pytest.approx(0.0, abs=1e-9)
    assert not flight_metrics(straight_flight(clearance=-0.001), 6.0)["success"]
    for outcome in (Outcome.COLLISION, Outcome.TIMEOUT, Outcome.LEFT_VOLUME):
        metrics = flight_metrics(straight_flight(outcome), 6.0)
        assert not metrics["success"] and math.isnan(metrics["path_excess"])


def test_jerk_of_a_sine():
    amplitude, w = 2.0, np.pi / 2
    times = np.append(np.arange(0, 801) * 0.02, 16.013)  # Four periods.
    velocities = np.zeros((802, 3))
    velocities[:, 1] = amplitude * np.sin(w * times)
    jerk, smoothness = jerk_metrics(velocities, times)
    assert jerk == pytest.approx(amplitude * w**2 / np.sqrt(2), rel=0.01)
    expected = -np.log(16.0**3 / amplitude**2 * (amplitude * w**2) ** 2 / 2 * 16.0)
    assert smoothness == pytest.approx(expected, abs=0.02)


def test_shortest_path_goes_around_a_post():
    post = Cylinder(p_WA=[5.0, 0.0, -2.0], p_WB=[5.0, 0.0, 6.0], radius=0.5)
    exact = AnalyticDistanceField([post], [0.0, -3.0, 0.0], [10.0, 3.0, 4.0])
    field = esdf_from_distance_field(exact, 0.1).conservative()
    lengths = path_lengths(field, np.array([9.0, 0.0, 2.0]))
    shortest = shortest_length(lengths, np.array([1.0, 0.0, 2.0]), goal_radius=0.3)
    r = 0.5 + VEHICLE_RADIUS
    tangents, arc = 2 * np.sqrt(16 - r**2), r * (np.pi - 2 * np.arccos(r / 4.0))
    assert shortest == pytest.approx(tangents + arc - 0.3, abs=0.15)
    assert shortest > 8.0 - 0.3
    assert math.isnan(shortest_length(lengths, np.array([5.0, 0.0, 2.0]), 0.3))


def test_infeasible_flights_fail_with_a_reason(benchmark, tmp_path, capsys, rows_of):
    words = ["--policies", "straight,planner", "--json", "--set"]
    assert benchmark("near", *words, "goal=[6.5, 0, 0.36]") == 0
    table = json.loads(capsys.readouterr().out)
    assert [row["infeasible"] for row in table] == [0, 1]
    assert (table[1]["flights"], table[1]["successes"]) == (1, 0)
    assert "must be at least" in rows_of(tmp_path / "near" / "rollouts.csv")[1]["reason"]

    assert benchmark("far", *words, "goal=[50, 0, 1.8]") == 1  # a failure with a result
    printed = capsys.readouterr()
    assert "short-straight-2-000, infeasible: goal" in printed.err
    assert "none of the flights could be flown" in printed.err
    assert [row["infeasible"] for row in json.loads(printed.out)] == [1, 1]
    with pytest.raises(ValueError, match=r"could not be flown .* is outside the world"):
        replay.run(study=tmp_path / "far", id="short-straight-2-000")


def test_a_scene_without_a_start_and_goal_does_not_stop_the_study(room, tmp_path, short_scenario):
    hall = room.scene("hall", metric=True)
    far = tmp_path / "far.yaml"
    far.write_text(f"world: !SceneConfig {{path: {hall}, draw_ends: true, min_path: 30}}\n")
    config = StudyConfig([str(far), str(short_scenario)], ["straight"], seeds=1)
    [row] = run_study.run(config=config, out=tmp_path / "out", jobs=1).table
    assert (row["flights"], row["infeasible"]) == (2, 1)


def fail_later(monkeypatch, error):
    """Lets the straight policy raise after half a second."""
    update = Straight._update

    def update_or_fail(policy, context, discrete_state):
        if context.get_time() > 0.5:
            raise error
        update(policy, context, discrete_state)

    monkeypatch.setattr(Straight, "_update", update_or_fail)


def test_a_flight_that_becomes_infeasible_is_an_error_of_its_row(
    benchmark, tmp_path, monkeypatch, rows_of
):
    fail_later(monkeypatch, sp.InfeasibleFlightError("no route leads to the goal"))
    assert benchmark("out", "--policies", "straight,planner") == 0
    straight, planner = rows_of(tmp_path / "out" / "table.csv")
    assert (straight["error"], straight["infeasible"], planner["error"]) == ("1", "0", "0")
    row = rows_of(tmp_path / "out" / "rollouts.csv")[0]
    assert row["outcome"] == "error" and 0.5 < float(row["flight_time_s"]) < 0.6
    assert row["reason"].startswith("at t = 0.53 s, p_WB = [")
    assert "no route leads to the goal" in (tmp_path / "out" / "report.html").read_text()
    assert replay.run(study=tmp_path / "out", id="short-straight-2-000")


def test_an_exception_stops_the_study_which_is_resumed(
    benchmark, tmp_path, monkeypatch, capsys, rows_of
):
    out, words = tmp_path / "out", ("out", "--policies", "straight,straight:rate=7")
    with monkeypatch.context() as patch:
        fail_later(patch, KeyError("depth"))
        assert benchmark(*words) == 1
    error, file = capsys.readouterr().err, out / "errors" / "short-straight-2-000.txt"
    assert "flight short-straight-2-000 was ended by an exception" in error
    assert "at t = 0.53 s, p_WB = [" in error and "KeyError: 'depth'" in error
    assert str(file) in error and "in update_or_fail" in file.read_text()
    assert not (out / "rollouts.csv").exists()

    assert benchmark(*words) == 0
    assert not (out / "errors").exists()
    assert len(rows_of(out / "rollouts.csv")) == 2


def test_a_fault_in_a_worker_process_is_returned(short_scenario, tmp_path):
    mine = tmp_path / "mine.npz"
    PolicyCheckpoint.load("", "diffaero", DIFFAERO_NETWORK).save(mine)
    config = StudyConfig([str(short_scenario)], ["straight", f"mine={mine}"], seeds=2)
    folder = StudyFolder(tmp_path / "out")
    folder.begin(config, {})
    keep_inputs(folder, config, config.load_scenarios())
    flights = list(kept_flights(folder, config.rollouts()))
    folder.weights("mine").unlink()
    flown = {each.id: each for each in fly_all(flights, jobs=2) if isinstance(each, Fault)}
    assert sorted(flown) == ["short-mine-2-000", "short-mine-2-001"]
    assert all("FileNotFoundError" in fault.reason for fault in flown.values())


def test_worlds_of_two_types_with_the_same_fields_are_two(monkeypatch):
    @dataclass
    class OtherForestConfig(ForestConfig):
        pass

    monkeypatch.setattr(rollout, "_worlds", {})
    monkeypatch.setattr(rollout, "make_world", lambda config, seed: (type(config), seed))
    for config, seed in product((ForestConfig(), OtherForestConfig()), (1_000, 1_001)):
        assert rollout.study_world(sp.Scenario(seed=seed, world=config)) == (type(config), seed)
