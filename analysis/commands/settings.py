"""The text of `--set help`."""

import dataclasses
import math
import shutil
import textwrap
from collections.abc import Iterator
from typing import Any

import numpy as np
import yaml

from splatpilot.systems.common.config import is_configuration
from splatpilot.systems.common.field_help import FieldDescription, describe_fields


def format_settings(config: Any) -> str:
    """All fields that `--set` takes for a configuration: their names, types, values, and what they
    are."""
    width = max(shutil.get_terminal_size().columns - 2, 40)
    lines = []
    for name, type_, value, text in _settings(config, ""):
        lines.append(f"{name}={value}  ({type_})" if value else f"{name}  ({type_})")
        lines += textwrap.wrap(text, width, initial_indent="    ", subsequent_indent="    ")
    return "\n".join(lines)


def _settings(config: Any, prefix: str) -> Iterator[tuple[str, str, str, str]]:
    """Name, type, value and text of each field, those of what a field holds behind it."""
    for field in describe_fields(config):
        name = prefix + field.name
        if is_configuration(field.value):
            yield name, _kinds(field), "", field.text
            yield from _settings(field.value, f"{name}.")
        else:
            yield name, _type_of(config, field), _as_yaml(field.value), field.text


def _kinds(field: FieldDescription) -> str:
    """The tags of what may stand in a field, that of what stands there first."""
    own = f"!{type(field.value).__name__}"
    others = field.registry.configs() if field.registry is not None else []
    tags = [own, *(f"!{config.__name__}" for config in others)]
    return " or ".join(dict.fromkeys(tags))


def _type_of(config: Any, field: FieldDescription) -> str:
    if field.registry is not None:
        return f"dictionary of {field.registry.what}s"
    if dataclasses.is_dataclass(config):
        types = {each.name: each.type for each in dataclasses.fields(config)}
        found = types[field.name]
        return found.__name__ if type(found) is type else str(found)
    return "number, text or null" if field.value is None else type(field.value).__name__


def _as_yaml(value: Any) -> str:
    """A plain value as `--set` takes it."""
    plain = value.tolist() if isinstance(value, np.ndarray) else value
    text = yaml.safe_dump(plain, default_flow_style=True, width=math.inf)
    return text.removesuffix("...\n").strip()
