import pytest

import splatpilot as sp
from splatpilot.analysis import realism
from splatpilot.analysis.benchmark import run_study
from splatpilot.analysis.benchmark.study_folder import StudyFolder


def test_effects_have_their_section_of_harsh_and_no_other(tmp_path):
    harsh = sp.load_config(sp.Scenario(), overrides=["profile=harsh"])
    effects = realism.write_effects(tmp_path)
    assert {"estimator", "decision_delay", "imaging", "observation", "vehicle", "wind"} < {*effects}
    for name in effects.keys() - {"rotors"}:
        expected = sp.Scenario(controller=harsh.controller)
        setattr(expected, name, getattr(harsh, name))
        assert sp.load_config(sp.Scenario(), overrides=effects[name]) == expected


def flight(seed: int, success: bool, **columns) -> dict:
    outcome = "goal" if success else "collision"
    flown = {"min_clearance_m": 0.1 * seed, "flight_time_s": 10.0 + seed}
    row = {"scenario": "P02", "policy": "planner", "seed": seed, "success": success}
    return row | {"outcome": outcome} | flown | columns


def test_flights_are_compared_with_the_ideal_ones_of_the_same_seed():
    ideal = [flight(0, True), flight(1, False), flight(2, True), flight(3, True)]
    rows = [flight(2, False), flight(1, True), flight(0, True)]
    [row] = realism.compare("harsh", rows, ideal)
    assert (row["flights"], row["successes"], row["collision"]) == (3, 2, 1)
    assert (row["lost"], row["gained"]) == (1, 1)
    assert (row["clearance_m"], row["time_s"]) == ("0.100", "11.00")


def test_conditions_are_compared_within_one_revision(tmp_path, monkeypatch):
    def run(config, out, **_):
        out.mkdir()
        StudyFolder(out).record(config, {"splatpilot": f"revision of {out.name}"})
        return run_study.Flown([flight(0, True)], [])

    monkeypatch.setattr(run_study, "run", run)
    with pytest.raises(ValueError, match=r"realistic must be revision of ideal, got"):
        realism.run(out=tmp_path, policies=["planner"], seeds=1, effect_seeds=0)
