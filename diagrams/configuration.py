"""Configurations: dataclasses whose fields a YAML file or the command line may set."""

import dataclasses
import difflib
import re
from pathlib import Path
from typing import Any, cast

import yaml
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed


def load_config[Config](
    defaults: Config, path: Path | None = None, overrides: list[str] | None = None
) -> Config:
    """
    Reads a configuration file and applies overrides of single fields.

    Args:
        defaults: a dataclass of the configuration's type; fields nobody sets keep its values.
        path: YAML file, or None.
        overrides: "dotted.field=YAML value" each, applied in order after the file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for text that is not YAML, unknown fields and values of another type; the
            message
            names the file or override, the field and its likely spelling.
    """
    config = defaults
    if path is not None:
        if not path.is_file():
            raise FileNotFoundError(f"{path}: there is no such configuration file")
        config = _updated(config, path.read_text(), str(path))
    for override in overrides or []:
        name, equals, value = override.partition("=")
        if not equals:
            raise ValueError(f"override {override!r} has no value; write FIELD=VALUE")
        *parents, field = name.split(".")
        text = f"{field}: {value}"
        for parent in reversed(parents):
            text = f"{parent}:\n" + "".join(f"  {line}\n" for line in text.splitlines())
        config = _updated(config, text, f"override {override!r}")
    return config


def dump_config(config: Any) -> str:
    """The configuration as YAML, every field written out."""
    return cast(str, yaml_dump_typed(config))


def _updated[Config](config: Config, text: str, source: str) -> Config:
    """`config` with the fields that the YAML `text` gives; `source` names the text in errors."""
    try:
        return yaml_load_typed(schema=type(config), data=text, defaults=config)
    except yaml.YAMLError as error:
        raise ValueError(f"{source} is not YAML: {error}") from None
    except (RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{source}: {error}{_suggestion(config, str(error))}") from None


def _suggestion(config: Any, error: str) -> str:
    """What an unknown field might have been meant to be."""
    if "unknown to the schema" not in error:
        return ""
    known = _field_names(config)
    close = {
        name
        for field in re.findall(r"'(\w+)'", error)
        for name in difflib.get_close_matches(field, known)
    }
    if close:
        return f"; did you mean {' or '.join(sorted(close))}?"
    return f"; the fields are {', '.join(sorted(known))}"


def _field_names(config: Any) -> set[str]:
    """The names of the fields of a configuration and of the configurations within it."""
    if dataclasses.is_dataclass(config):
        names = {field.name for field in dataclasses.fields(config)}
    else:  # Drake's own configurations.
        names = {field.name for field in getattr(config, "__fields__", ())}
    return names.union(*(_field_names(getattr(config, name)) for name in names))
