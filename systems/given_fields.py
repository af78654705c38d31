"""The fields that a YAML text gives: whether the configuration has them, before any is read."""

import dataclasses
from types import NoneType, UnionType
from typing import Any, get_args, get_origin

import yaml

from splatpilot.systems.messages import TYPES, did_you_mean, require

_TAGGED = object()


class _NamesLoader(yaml.SafeLoader):
    """Reads only for the names of fields: what tagged values hold is left to Drake's reader."""


_NamesLoader.add_multi_constructor("!", lambda loader, tag, node: _TAGGED)


def check_fields(config: Any, text: str) -> None:
    """
    Checks the fields that a YAML text gives, and the types of plain values.

    Raises:
        ValueError: if it gives nothing, a field that `config` does not have, and which it might be,
            or a value of another type than the field's.
        YAMLError: if it is no YAML.
    """
    given = yaml.load(text, _NamesLoader)
    if given is None:
        raise ValueError("holds no field; write NAME: VALUE of what is to change, or leave it")
    _check_names(config, given, "")


def _check_names(config: Any, given: Any, prefix: str) -> None:
    """Raises ValueError for a field that `config` does not have, and says which it might be."""
    known = _field_names(config)
    listed = sorted(prefix + other for other in known)
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
            # A field of this name elsewhere, what stood under it (as of another policy), or a typo.
            within = [prefix + each for each in _names(value) if each in known]
            close = " or ".join(_nested_fields(config, str(name), prefix) or within)
            typo = did_you_mean(str(name), sorted(known), prefix)
            hint = f"did you mean {close}?" if close else typo
            fields = f"the fields are {', '.join(listed)}"
            raise ValueError(f"there is no field {prefix}{name}; {hint or fields}")
        if value is None and _may_be_null(config, name):
            continue
        held = getattr(config, name)
        if isinstance(held, list) and isinstance(value, str):  # whose letters would be taken
            raise ValueError(f"{prefix}{name} is {_shown(value)}; write it as a list, [{value}]")
        _check_type(f"{prefix}{name}", _field_types(config).get(name), value)
        _check_names(held, value, f"{prefix}{name}.")


def _check_type(name: str, expected: Any, value: Any) -> None:
    """Raises ValueError for a plain value that Drake's reader cannot convert to a field's type."""
    options = [option for option in get_args(expected) if option is not NoneType]
    if get_origin(expected) is list and isinstance(value, list):
        for number, each in enumerate(value):
            _check_type(f"{name}[{number}]", options[0], each)
    elif get_origin(expected) is UnionType and len(options) == 1:
        _check_type(name, options[0], value)
    elif expected in TYPES and value is not _TAGGED:
        require(_converts(value, expected), name, TYPES[expected], _shown(value))


def _converts(value: Any, expected: type) -> bool:
    if isinstance(value, str) and expected is not bool:
        try:
            expected(value)
        except ValueError:
            return False
        return True
    if isinstance(value, bool) or expected is bool:
        return expected is bool and value in (True, False, "true", "false")
    return isinstance(value, int) or (
        isinstance(value, float) and (expected is float or value.is_integer())
    )


def _may_be_null(config: Any, name: str) -> bool:
    """Whether a field's type says that it may have no value."""
    return NoneType in get_args(_field_types(config).get(name))


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


def _names(given: Any) -> list[str]:
    """The names of the fields that are given, at any depth."""
    if not isinstance(given, dict):
        return []
    return [each for name, value in given.items() for each in (str(name), *_names(value))]


def _field_names(config: Any) -> set[str]:
    """The names of the fields of a configuration, empty for plain values."""
    return set(_field_types(config))


def _field_types(config: Any) -> dict[str, Any]:
    """The types of the fields of a configuration by name, empty for plain values."""
    if dataclasses.is_dataclass(config):
        return {field.name: field.type for field in dataclasses.fields(config)}
    return {field.name: field.type for field in getattr(config, "__fields__", ())}  # Drake's own.
