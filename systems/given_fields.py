"""The fields that a YAML text gives: whether the configuration has them, before any is read."""

import dataclasses
import difflib
from types import NoneType
from typing import Any, get_args

import yaml

_TAGGED = object()


class _NamesLoader(yaml.SafeLoader):
    """Reads only for the names of fields: what tagged values hold is left to Drake's reader."""


_NamesLoader.add_multi_constructor("!", lambda loader, tag, node: _TAGGED)


def check_fields(config: Any, text: str) -> None:
    """
    Checks what a YAML text gives, but for the values of fields.

    Raises:
        ValueError: if it gives nothing, a field that `config` does not have, and which it might be,
            or a string where a list belongs.
        YAMLError: if it is no YAML.
    """
    given = yaml.load(text, _NamesLoader)
    if given is None:
        raise ValueError("holds no field; write NAME: VALUE of what is to change, or leave it")
    _check_names(config, given, "")


def _check_names(config: Any, given: Any, prefix: str) -> None:
    """Raises ValueError for a field that `config` does not have, and says which it might be."""
    known = _field_names(config)
    if given is None and prefix and (known or isinstance(config, dict)):
        raise ValueError(f"{prefix[:-1]} is null where fields belong; leave it out, or give some")
    if isinstance(config, dict) and isinstance(given, dict):
        for name, value in given.items():
            _check_names({}, value, f"{prefix}{name}.")
    if not known or given is None or given is _TAGGED:
        return
    if not isinstance(given, dict):
        raise ValueError(
            f"{prefix[:-1] or 'the file'} is {_shown(given)}; it must be fields, NAME: VALUE each"
        )
    for name, value in given.items():
        if name not in known:
            close = _nested_fields(config, str(name), prefix) or [
                prefix + other for other in difflib.get_close_matches(str(name), known)
            ]
            hint = f"did you mean {' or '.join(close)}?"
            listed = f"the fields are {', '.join(sorted(prefix + other for other in known))}"
            raise ValueError(f"there is no field {prefix}{name}; {hint if close else listed}")
        if value is None and _may_be_null(config, name):
            continue
        held = getattr(config, name)
        if isinstance(held, list) and isinstance(value, str):  # whose letters would be taken
            raise ValueError(f"{prefix}{name} is {_shown(value)}; write it as a list, [{value}]")
        _check_names(held, value, f"{prefix}{name}.")


def _may_be_null(config: Any, name: str) -> bool:
    """Whether a field's type says that it may have no value."""
    fields = dataclasses.fields(config) if dataclasses.is_dataclass(config) else ()
    return any(field.name == name and NoneType in get_args(field.type) for field in fields)


def _shown(value: Any) -> str:
    """A value that is not what it should be: enough to know it by, for it may be a whole file."""
    text = " ".join(str(value).split())
    return text if len(text) <= 40 else f"{text[:40]}..."


def _nested_fields(config: Any, name: str, prefix: str) -> list[str]:
    """The dotted names of the fields called `name` of the configurations that `config` holds."""
    found = []
    for field in sorted(_field_names(config)):
        held = getattr(config, field)
        if name in _field_names(held):
            found.append(f"{prefix}{field}.{name}")
        found += _nested_fields(held, name, f"{prefix}{field}.")
    return found


def _field_names(config: Any) -> set[str]:
    """The names of the fields of a configuration, empty for plain values."""
    if dataclasses.is_dataclass(config):
        return {field.name for field in dataclasses.fields(config)}
    return {field.name for field in getattr(config, "__fields__", ())}  # Drake's own.
