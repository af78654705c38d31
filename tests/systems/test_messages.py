"""Messages about values that a user gave."""

import pickle
from dataclasses import dataclass, field

import pytest

from splatpilot.systems.common.messages import (
    FieldError,
    did_you_mean,
    require,
    require_field,
    unknown,
)


@dataclass
class Lattice:
    speed: float = -1.0


@dataclass
class Whole:
    policy: dict[str, Lattice] = field(default_factory=lambda: {"a": Lattice(), "b": Lattice()})


def test_a_value_is_named_with_its_condition_and_remedy():
    require(True, "--jobs", "at least 1", 1)
    with pytest.raises(ValueError, match=r"^--jobs must be at least 1, got 0; leave it out$"):
        require(False, "--jobs", "at least 1", 0, "leave it out")


def test_a_field_is_named_by_its_path_within_the_whole_configuration():
    whole = Whole()
    with pytest.raises(FieldError) as raised:
        require_field(whole.policy["b"], "speed", False, "positive")
    assert str(raised.value) == "Lattice.speed must be positive, got -1.0"
    assert str(raised.value.within(whole)) == "policy.b.speed must be positive, got -1.0"
    assert raised.value.within(Whole()) is raised.value


def test_a_field_error_can_be_sent_to_another_process():
    error = FieldError(Lattice(), "speed", "must be positive, got -1.0")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("planer", "there is no policy 'planer'; did you mean planner?"),
        ("Planner", "there is no policy 'Planner'; did you mean planner?"),
        ("qqqq", "there is no policy 'qqqq'; there are planner, straight, and others"),
    ],
)
def test_an_unknown_name_is_told_with_the_most_similar_or_all(name, message):
    assert unknown("policy", name, ["planner", "straight", "planner"], "and others") == message


@pytest.mark.parametrize(
    ("name", "names", "question"),
    [
        ("P2", ["P01", "P02", "P12", "R13"], "did you mean P02 or P12?"),
        ("P0", [f"P0{k}" for k in range(1, 6)], ""),
        ("fly", [], ""),
    ],
)
def test_at_most_three_similar_names_are_suggested(name, names, question):
    assert did_you_mean(name, names) == question
