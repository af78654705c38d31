"""What the fields of configurations mean, read from where their classes are written."""

import ast
import dataclasses
import functools
import inspect
import textwrap
from itertools import zip_longest
from typing import Any

from splatpilot.systems.configuration import OPEN_REGISTRY
from splatpilot.systems.registry import Registry


@dataclasses.dataclass(frozen=True)
class FieldDescription:
    """One field of a configuration."""

    name: str
    """Of the field."""
    value: Any
    """What the configuration has there: a plain value or another configuration."""
    text: str
    """What it is, in one paragraph: what stands at the field, or else the first paragraph of the
    configuration that it holds; empty if nobody wrote anything down."""
    registry: Registry | None = None
    """Whose kinds of configurations may stand there, for an open field."""


def describe_fields(config: Any) -> list[FieldDescription]:
    """
    The fields of a configuration, those of base classes first.

    What one is stands in the source, in one of three ways: a comment in the lines above the field,
    a comment after it, or a string below it. Of Drake's own configurations it is their docstrings.

    Args:
        config: a dataclass or one of Drake's configurations; describes plain values as no fields.
    """
    if dataclasses.is_dataclass(config):
        texts: dict[str, str] = {}
        for base in reversed(type(config).__mro__):
            if dataclasses.is_dataclass(base):
                texts |= _texts(base)
        return [
            FieldDescription(
                field.name,
                getattr(config, field.name),
                texts.get(field.name) or _first_paragraph_of(getattr(config, field.name)),
                field.metadata.get(OPEN_REGISTRY),
            )
            for field in dataclasses.fields(config)
        ]
    return [
        FieldDescription(field.name, getattr(config, field.name), _drakes(config, field.name))
        for field in getattr(config, "__fields__", ())
    ]


def is_configuration(value: Any) -> bool:
    """Whether a value is a configuration, which has fields, and not a plain value."""
    return dataclasses.is_dataclass(value) or hasattr(value, "__fields__")


@functools.cache
def _texts(config: type) -> dict[str, str]:
    """What the source of one class says of the fields that it defines: nothing where there is no
    source, of classes from a session or a package without it."""
    try:
        lines = textwrap.dedent(inspect.getsource(config)).splitlines()
    except (OSError, TypeError):
        return {}
    (definition,) = ast.parse("\n".join(lines)).body
    assert isinstance(definition, ast.ClassDef)
    texts = {}
    for statement, following in zip_longest(definition.body, definition.body[1:]):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            text = _string(following) or _comment(lines, statement)
            if text:
                texts[statement.target.id] = " ".join(text.split())
    return texts


def _string(statement: ast.stmt | None) -> str:
    """The string that a statement is, empty if it is none."""
    value = statement.value if isinstance(statement, ast.Expr) else None
    return value.value if isinstance(value, ast.Constant) and isinstance(value.value, str) else ""


def _comment(lines: list[str], field: ast.stmt) -> str:
    """The comment after a field, or the one in the lines above it."""
    assert field.end_lineno is not None
    after = lines[field.end_lineno - 1].encode()[field.end_col_offset :].decode().strip()
    if after.startswith("#"):
        return after.lstrip("# ")
    above = []
    for line in reversed(lines[: field.lineno - 1]):
        if not line.strip().startswith("#"):
            break
        above.insert(0, line.strip().lstrip("# "))
    return " ".join(above)


def _drakes(config: Any, name: str) -> str:
    """What Drake's documentation says of a field, or of the configuration that it holds."""
    text = getattr(type(config), name).__doc__ or ""
    if text.startswith("(self)"):  # pybind11's signature, where there is no docstring.
        return _first_paragraph_of(getattr(config, name))
    return _paragraph(text)


def _first_paragraph_of(value: Any) -> str:
    """What the class of a configuration says of itself; empty for plain values."""
    return _paragraph(type(value).__doc__ or "") if is_configuration(value) else ""


def _paragraph(text: str) -> str:
    """The first paragraph as one line, without the marks of Doxygen that Drake leaves in."""
    return " ".join(text.partition("\n\n")[0].split()).lstrip("%").replace("∷", "::")
