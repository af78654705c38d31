from dataclasses import dataclass, field

import pytest
from pydrake.systems.sensors import CameraConfig

from splatpilot.systems.common.config import registry_field
from splatpilot.systems.common.field_help import describe_fields
from splatpilot.systems.common.registry import Registry

ENGINES = Registry("engine", "tests.engines", object)


@dataclass
class Wheel:
    """A part
    that rolls.

    More of it."""

    # [m]
    radius: float = 0.3


@dataclass
class Vehicle:
    # Above,
    # on two lines.
    mass: float = 1.0
    name: str = "größe # nothing"  # After: of it.
    wheel: Wheel = field(
        default_factory=Wheel,
    )
    """Below,
    on two lines."""

    # A heading.

    bare: int = 0
    spare: Wheel = field(default_factory=Wheel)
    engine: Wheel = registry_field(ENGINES, Wheel)  # [-] Of any kind.


@dataclass
class Car(Vehicle):
    mass: float = 900.0
    """[kg] Of the car."""
    doors: int = 4


def test_comments_and_strings_describe_fields():
    texts = {field.name: field.text for field in describe_fields(Vehicle())}
    assert texts == {
        "mass": "Above, on two lines.",
        "name": "After: of it.",
        "wheel": "Below, on two lines.",
        "bare": "",
        "spare": "A part that rolls.",
        "engine": "[-] Of any kind.",
    }


def test_inherited_fields_keep_their_descriptions():
    fields = describe_fields(Car(doors=2))
    assert [(f.name, f.value) for f in fields[:2]] == [("mass", 900.0), ("name", "größe # nothing")]
    texts = {field.name: field.text for field in fields}
    assert texts["mass"] == "[kg] Of the car." and texts["name"] == "After: of it."
    assert fields[-1].value == 2


def test_registry_fields_name_their_registry():
    registries = {field.name: field.registry for field in describe_fields(Vehicle())}
    assert registries.pop("engine") is ENGINES
    assert set(registries.values()) == {None}


def test_docstrings_of_drake_describe_its_fields():
    texts = {field.name: field.text for field in describe_fields(CameraConfig())}
    assert texts["width"] == "Image width (in pixels)."
    assert texts["X_PB"].startswith("The pose of the body camera relative to a parent frame P.")


def test_a_class_without_source_describes_only_inherited_fields():
    names = {"dataclass": dataclass, "Car": Car, "__name__": "a_session"}
    exec("@dataclass\nclass Taxi(Car):\n    fare: float = 2.0", names)
    fields = {field.name: field for field in describe_fields(names["Taxi"]())}
    assert (fields["fare"].value, fields["fare"].text) == (2.0, "")
    assert fields["mass"].text == "[kg] Of the car."


@pytest.mark.parametrize("value", [1, "text", None, [1.0], {}])
def test_plain_values_have_no_fields(value):
    assert describe_fields(value) == []
