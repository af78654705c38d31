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
    """Lists the fields of a configuration with types, values and descriptions."""
    width = max(shutil.get_terminal_size().columns - 2, 40)
    lines = []
    for heading, text in _settings(config, ""):
        lines.append(heading)
        lines += textwrap.wrap(text, width, initial_indent="    ", subsequent_indent="    ")
    return "\n".join(lines)


def _settings(config: Any, prefix: str) -> Iterator[tuple[str, str]]:
    """Yields heading and description of each field; nested fields follow their parent."""
    for field in describe_fields(config):
        name = prefix + field.name
        if is_configuration(field.value):
            configs = field.registry.configs() if field.registry is not None else []
            tags = [f"!{config.__name__}" for config in (type(field.value), *configs)]
            yield f"{name}  ({' or '.join(dict.fromkeys(tags))})", field.text
            yield from _settings(field.value, f"{name}.")
        else:
            plain = field.value.tolist() if isinstance(field.value, np.ndarray) else field.value
            text = yaml.safe_dump(plain, default_flow_style=True, width=math.inf)
            text = text.removesuffix("...\n").strip()
            yield f"{name}={text}  ({_type_name(config, field)})", field.text


def _type_name(config: Any, field: FieldDescription) -> str:
    if field.registry is not None:
        return f"dictionary of {field.registry.what}s"
    if dataclasses.is_dataclass(config):
        types = {each.name: each.type for each in dataclasses.fields(config)}
        found = types[field.name]
        return found.__name__ if type(found) is type else str(found)
    return "number, text or null" if field.value is None else type(field.value).__name__
