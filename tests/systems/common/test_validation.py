import pickle
from dataclasses import dataclass, field

import pytest

from splatpilot.systems.common.validation import (
    Config,
    FieldError,
    bounded,
    did_you_mean,
    require,
    require_field,
    unknown,
)


def test_a_value_is_named_with_its_condition_and_remedy():
    require(True, "--jobs", "at least 1", 1)
    with pytest.raises(ValueError, match=r"^--jobs must be at least 1, got 0; leave it out$"):
        require(False, "--jobs", "at least 1", 0, "leave it out")


def test_a_field_is_named_by_its_path_within_the_whole_configuration():
    whole = Outer(others={"a": Inner(), "b": Inner()})
    with pytest.raises(FieldError) as raised:
        require_field(whole.others["b"], "share", False, "positive")
    assert str(raised.value) == "Inner.share must be positive, got 0.5"
    assert str(raised.value.within(whole)) == "others.b.share must be positive, got 0.5"
    assert raised.value.within(Outer()) is raised.value
    sent = pickle.loads(pickle.dumps(raised.value))  # to another process
    assert str(sent) == str(raised.value)


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


def test_at_most_three_similar_names_are_suggested():
    assert did_you_mean("P2", ["P01", "P02", "P12", "R13"]) == "did you mean P02 or P12?"
    assert did_you_mean("P0", [f"P0{k}" for k in range(1, 6)]) == did_you_mean("fly", []) == ""


@dataclass
class Inner(Config):
    share: float = bounded(0.5, "[0, 1)")


@dataclass
class Outer(Config):
    speed: float = bounded(1.0, "(0, 20] m/s")
    kind: str = bounded("a", "{a, b}")
    sizes: list[int] = bounded(lambda: [1, 2], "[1, 9]")
    height: float | None = bounded(None, "[0, inf) m")
    inner: Inner = field(default_factory=Inner)
    others: dict[str, Inner] = field(default_factory=dict)

    def check(self) -> None:
        require(self.speed != 13.0, "speed", "another number", self.speed)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"speed": 0.0}, r"Outer\.speed must be in \(0, 20\] m/s, got 0\.0"),
        ({"speed": float("nan")}, "speed .* got nan"),
        ({"speed": "fast"}, "speed .* got fast"),
        ({"kind": "c"}, r"kind must be in \{a, b\}, got c"),
        ({"sizes": [1, 10]}, r"sizes must be in \[1, 9\], got \[1, 10\]"),
        ({"height": float("inf")}, "height must be in .* got inf"),
        ({"inner": Inner(1.0)}, r"Inner\.share must be in \[0, 1\), got 1\.0"),
        ({"others": {"x": Inner(-0.1)}}, "share .* got -0.1"),
        ({"speed": 13.0}, "speed must be another number, got 13"),
    ],
)
def test_fields_out_of_their_domain_are_refused(changes, message):
    Outer().validate()
    Outer(speed=20.0, height=3.0).validate()
    with pytest.raises(ValueError, match=message):
        Outer(**changes).validate()
