from splatpilot.analysis import realism
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.systems.common.config import load_config


def test_effects_have_their_section_of_harsh_and_no_other(tmp_path):
    harsh = load_config(Scenario(), overrides=["profile=harsh"])
    effects = realism.write_effects(tmp_path)
    assert {"estimator", "decision_delay", "imaging", "observation", "vehicle", "wind"} < {*effects}
    for name in effects.keys() - {"rotors"}:
        expected = Scenario(controller=harsh.controller)
        setattr(expected, name, getattr(harsh, name))
        assert load_config(Scenario(), overrides=effects[name]) == expected


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
