"""Descriptions of the fields of configurations, read from their source."""

import ast
import dataclasses
import functools
import inspect
import re
import shutil
import textwrap
from collections.abc import Iterator
from itertools import zip_longest
from typing import Any

import numpy as np

from splatpilot.systems.common.config import RegistryField, is_configuration, yaml_line
from splatpilot.systems.common.registry import Registry


@dataclasses.dataclass(frozen=True)
class FieldDescription:
    """One field of a configuration."""

    name: str
    value: Any  # of the configuration: a plain value or another configuration
    text: str  # one paragraph, or empty
    registry: Registry | None = None  # of the configurations that the field may hold


def describe_fields(config: Any) -> list[FieldDescription]:
    """Describes the fields of a configuration, those of base classes first.

    The text of a field is a comment above it, a comment after it, or a string below it; without
    any, the first paragraph of the configuration that it holds. Drake's fields have docstrings.
    """
    if not dataclasses.is_dataclass(config):
        names = [field.name for field in getattr(config, "__fields__", ())]
        return [FieldDescription(n, getattr(config, n), _drake_text(config, n)) for n in names]
    texts: dict[str, str] = {}
    for base in reversed(type(config).__mro__):
        if dataclasses.is_dataclass(base):
            texts |= _texts(base)
    return [
        FieldDescription(
            field.name,
            value := getattr(config, field.name),
            texts.get(field.name) or _class_text(value),
            field.registry if isinstance(field, RegistryField) else None,
        )
        for field in dataclasses.fields(config)
    ]


def format_fields(config: Any) -> str:
    """Lists the fields of a configuration with types, values and descriptions."""
    width = max(shutil.get_terminal_size().columns - 2, 40)
    lines = []
    for heading, text in _described(config, ""):
        lines.append(heading)
        lines += textwrap.wrap(text, width, initial_indent="    ", subsequent_indent="    ")
    return "\n".join(lines)


def _described(config: Any, prefix: str) -> Iterator[tuple[str, str]]:
    """Yields heading and description of each field; nested fields follow their parent."""
    for field in describe_fields(config):
        name = prefix + field.name
        if is_configuration(field.value):
            if field.registry is not None:
                field.registry.load_announced()
            configs = field.registry.configs() if field.registry is not None else []
            tags = [f"!{config.__name__}" for config in (type(field.value), *configs)]
            yield f"{name}  ({' or '.join(dict.fromkeys(tags))})", field.text
            yield from _described(field.value, f"{name}.")
        else:
            plain = field.value.tolist() if isinstance(field.value, np.ndarray) else field.value
            yield f"{name}={yaml_line(plain)}  ({_type_name(config, field)})", field.text


def _type_name(config: Any, field: FieldDescription) -> str:
    if field.registry is not None:
        return f"dictionary of {field.registry.what}s"
    if dataclasses.is_dataclass(config):
        types = {each.name: each.type for each in dataclasses.fields(config)}
        found = types[field.name]
        return found.__name__ if type(found) is type else re.sub(r"\b\w+\.(?=\w)", "", str(found))
    if isinstance(field.value, np.ndarray):
        return "list[float]"
    return "number, text or null" if field.value is None else type(field.value).__name__


@functools.cache
def _texts(config: type) -> dict[str, str]:
    """Returns the texts of the fields that a class itself defines; empty without source."""
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
    value = statement.value if isinstance(statement, ast.Expr) else None
    return value.value if isinstance(value, ast.Constant) and isinstance(value.value, str) else ""


def _comment(lines: list[str], field: ast.stmt) -> str:
    """Returns the comment after a field, or else the one in the lines above it."""
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


def _drake_text(config: Any, name: str) -> str:
    text = getattr(type(config), name).__doc__ or ""
    if text.startswith("(self)"):  # pybind11's signature, for a field without a docstring
        return _class_text(getattr(config, name))
    return _paragraph(text)


def _class_text(value: Any) -> str:
    return _paragraph(type(value).__doc__ or "") if is_configuration(value) else ""


def _paragraph(text: str) -> str:
    """Returns the first paragraph as one line, without the Doxygen marks that Drake leaves in."""
    return " ".join(text.partition("\n\n")[0].split()).lstrip("%").replace("∷", "::")
