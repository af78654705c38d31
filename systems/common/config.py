"""Configurations: dataclasses that YAML files and the command line set, and their descriptions.

Drake's `yaml_load_typed` and `yaml_dump_typed` do the work. `load_config` adds overrides of single
fields and messages that name the field and its likely spelling.
"""

import ast
import copy
import dataclasses
import functools
import inspect
import re
import reprlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from itertools import zip_longest
from math import inf
from pathlib import Path
from textwrap import dedent, indent, wrap
from types import NoneType, UnionType
from typing import Any, Union, cast, get_args, get_origin

import numpy as np
import yaml
from pydrake.common.yaml import yaml_load_data, yaml_load_typed

from splatpilot.systems.common.distributions import (
    DrawnField,
    FieldPath,
    config_fields,
    distribution_text,
    dump_config,
    find_distributions,
    is_distribution,
    take_distributions,
)
from splatpilot.systems.common.readers import (
    error_summary,
    read_text,
    yaml_collections,
    yaml_errors,
)
from splatpilot.systems.common.registry import Registry
from splatpilot.systems.common.validation import TYPES, did_you_mean, require

_UNKNOWN_TAG = re.compile(r"The yaml type tag value '(.*)' did not match .* for '(.*)' \(")


class _Exact(type):
    """Metaclass of a class that stands for its base without the base's subclasses.

    Drake writes a value without a tag if it is an instance of the first type of a union.
    """

    def __instancecheck__(cls, instance: Any) -> bool:
        return type(instance) is cls.__base__

    def __call__(cls, *args: Any, **keywords: Any) -> Any:
        return cast(Any, cls.__base__)(*args, **keywords)


class RegistryField(dataclasses.Field):
    """Field of a dataclass that holds a configuration of a registry, or a dictionary of such.

    Its `type` is the union of the types that are registered now, as Drake's functions need it.
    """

    def __init__(self, registry: Registry, default: Callable[[], Any]) -> None:
        self.registry, self.default_factory = registry, default
        super().__init__(dataclasses.MISSING, default, True, True, None, True, {}, False)

    @property
    def type(self) -> Any:
        known = self.registry.configs()
        is_dict = self.default_factory is dict
        default = known[0] if is_dict else cast(Any, self.default_factory)
        exact = _Exact(default.__name__, (default,), {"__module__": default.__module__})
        # Drake takes the first match: derived types precede their bases.
        derived = sorted({default, *known}, key=lambda config: -len(config.__mro__))
        union = Union[(exact, *derived)]
        return dict[str, union] if is_dict else union

    @type.setter
    def type(self, annotation: Any) -> None:
        """Ignores the annotation, which is for readers and type checkers."""


def registry_field(registry: Registry, default: Callable[[], Any]) -> Any:
    """Declares a field for any configuration of a registry, or a dictionary of them if `default` is
    `dict`. In YAML a tag names their types; the type `default` needs none."""
    return RegistryField(registry, default)


def load_config[Configuration](
    defaults: Configuration,
    path: str | Path | None = None,
    overrides: Sequence[str] | None = None,
) -> Configuration:
    """Reads a YAML file, if any, and applies overrides of single fields.

    Args:
        defaults: configuration with the values of all other fields.
        overrides: "dotted.field=YAML value" each, applied in order after the file; or "NAME=FILE",
            with the fields of a YAML file, of a name in `defaults.OVERLAYS`.
    """
    config = defaults if path is None else parse_config(defaults, read_text(Path(path)), str(path))
    for override in overrides or ():
        name, equals, value = override.partition("=")
        require(equals, "an override", "FIELD=VALUE", repr(override))
        if name in (overlays := getattr(config, "OVERLAYS", {})):
            file = overlays[name](value)
            with yaml_errors(str(file)):
                root = yaml.compose(read_text(file), yaml.SafeLoader)
            config = _with_fields(config, root, [], str(file))
        else:
            config = _with_field(config, name.split("."), value, f"override {override!r}")
    return config


def parse_config[Configuration](
    defaults: Configuration, text: str, source: str, prefix: str = ""
) -> Configuration:
    """Reads a configuration from a YAML text. Messages name the `source`, and fields by their paths
    with a `prefix`, that of `defaults`, such as "policy."."""
    with yaml_errors(source):
        given = yaml_load_data(text, private=True)
        try:
            _require_distinct_keys(text)
            drawn, start = {}, tuple(filter(None, prefix.split(".")))
            if dataclasses.is_dataclass(defaults):  # Drake's types take the distributions they can
                text, drawn = take_distributions(text, start)
            given = yaml_load_data(text, private=True) if drawn else given
            _check_names(defaults, given, prefix)
            _import_types(defaults, text)
            config = yaml_load_typed(schema=type(defaults), data=text, defaults=defaults)
            for path, distribution in drawn.items():
                _put(config, path[len(start) :], distribution, prefix)
            list(find_distributions(config, start))  # checks them
            return config
        except RecursionError:
            raise
        except Exception as error:  # Drake's reader raises any type.
            unknown = _UNKNOWN_TAG.match(str(error))
            reason = _unknown_tag(defaults, *unknown.groups()) if unknown else error_summary(error)
            raise ValueError(f"{source}: {reason}") from None


def equal_by_fields(config: Any, other: object) -> bool:
    """Compares two configurations by all fields; Drake's types compare by identity."""
    return type(other) is type(config) and dump_config(config) == dump_config(other)


def yaml_line(value: Any) -> str:
    """Returns a plain value as YAML in one line."""
    text: str = yaml.safe_dump(value, default_flow_style=True, width=inf)
    return text.removesuffix("...\n").strip()


def is_configuration(value: Any) -> bool:
    """Returns True for dataclasses and for Drake's configurations."""
    return dataclasses.is_dataclass(value) or hasattr(value, "__fields__")


def require_configuration(config: type) -> None:
    """Checks that a type is a dataclass with defaults that YAML can hold, and has `validate`."""
    name = getattr(config, "__name__", repr(config))
    is_dataclass = isinstance(config, type) and dataclasses.is_dataclass(config)
    require(is_dataclass, name, "a dataclass", config, "decorate it with @dataclass")
    if not callable(getattr(config, "validate", None)):
        raise ValueError(f"{name} has no method validate(); derive it from Config")
    try:
        dump_config(config())
    except Exception as error:  # A missing default, or a type that Drake cannot write.
        raise ValueError(
            f"{name} makes no YAML ({type(error).__name__}: {error_summary(error)}); give all "
            "fields defaults, and types of bool, int, float, str, list, dict or other dataclasses"
        ) from None


def _with_fields(config: Any, node: yaml.Node | None, path: list[str], source: str) -> Any:
    """Returns a copy of `config` with the fields of a YAML mapping, one by one: parts without a tag
    keep their type and their other fields."""
    what = ".".join(path) or source
    require(isinstance(node, yaml.MappingNode), what, "fields, NAME: VALUE each", "none")
    assert isinstance(node, yaml.MappingNode)
    for key, value in node.value:
        inner, part = [*path, key.value], config
        for name in inner:
            part = getattr(part, name, None)
        plain = isinstance(value, yaml.MappingNode) and value.tag.startswith("tag:yaml.org")
        if plain and is_configuration(part):
            config = _with_fields(config, value, inner, source)
        else:
            if isinstance(value, yaml.CollectionNode):
                value.flow_style = True
            text = yaml.serialize(value, width=inf).removesuffix("...\n").strip()
            config = _with_field(config, inner, text, source)
    return config


def _with_field(config: Any, path: list[str], value: str, source: str) -> Any:
    """Returns a copy of `config` whose field at `path` is read from a YAML value."""
    config = held = copy.deepcopy(config)
    owner, owner_depth, parent = config, 0, None
    for depth, name in enumerate(path[:-1], 1):
        holder = held
        held = held.get(name) if isinstance(held, dict) else getattr(held, name, None)
        if is_configuration(held):
            owner, owner_depth, parent = held, depth, holder
        elif not isinstance(held, dict):
            break
    text = f"{path[-1]}: {value}"
    for name in reversed(path[owner_depth:-1]):
        text = f"{name}:\n{indent(text, '  ')}"
    prefix = "".join(f"{name}." for name in path[:owner_depth])
    changed = parse_config(owner, text, source, prefix)
    if parent is None:
        return changed
    if isinstance(parent, dict):
        parent[path[owner_depth - 1]] = changed
    else:
        setattr(parent, path[owner_depth - 1], changed)
    return config


def _put(config: Any, path: FieldPath, distribution: Any, prefix: str) -> None:
    """Sets the field of a configuration at `path` to a distribution."""
    *holders, name = path
    for holder in holders:
        plain = isinstance(config, dict | list)
        config = config[holder] if plain else getattr(config, str(holder))  # pyright: ignore
        prefix += f"{holder}."
    if not isinstance(config, dict | list):
        if name not in field_types(config):
            raise _unknown_field(config, name, None, prefix)
        is_ours, text = dataclasses.is_dataclass(config), distribution_text(distribution)
        require(is_ours, f"{prefix}{name}", "one value", text)
    DrawnField(path, config, distribution).put(distribution)


def _check_names(config: Any, given: Any, prefix: str, kinds: Sequence[Any] = ()) -> None:
    """Raises ValueError for unknown fields, with their likely spelling, and for wrong types. A tag
    may name `kinds`."""
    if is_distribution(config):
        return
    if isinstance(given, dict) and "_tag" in given:
        tag, given = given["_tag"], {name: each for name, each in given.items() if name != "_tag"}
        config = next((kind() for kind in kinds if f"!{kind.__name__}" == tag), None)
    known, what = field_types(config), prefix.rstrip(".") or "the text"
    if not (known or isinstance(config, dict)):
        return  # Drake's reader checks plain values, and tags.
    require(isinstance(given, dict), what, "fields, NAME: VALUE each", _shortened(given))
    for name, value in given.items():
        if isinstance(config, dict):
            require(value is not None, f"{prefix}{name}", "fields, NAME: VALUE each", "null")
            _check_names(config.get(name), value, f"{prefix}{name}.", kinds)
            continue
        if name not in known:
            raise _unknown_field(config, name, value, prefix)
        if value is None and NoneType in get_args(known[name]):
            continue
        _check_type(f"{prefix}{name}", known[name], value)
        _check_names(getattr(config, name), value, f"{prefix}{name}.", _tagged_types(known[name]))


_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast


def _require_distinct_keys(text: str) -> None:
    """Raises ValueError for a key that is given twice in a mapping of YAML, at any depth."""
    for node, _ in yaml_collections(yaml.compose(text, _LOADER)):
        if isinstance(node, yaml.MappingNode):
            keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
            repeated = [name for k, name in enumerate(keys) if name in keys[:k]]
            require(not repeated, "fields", "given once", ", ".join(repeated))


def _tagged_types(expected: Any) -> list[Any]:
    """Returns the types that tags of a field, or of the items of its dictionary, may name."""
    options = get_args(get_args(expected)[1] if get_origin(expected) is dict else expected)
    return [option for option in options if dataclasses.is_dataclass(option)]


def _unknown_field(config: Any, name: Any, value: Any, prefix: str) -> ValueError:
    """Suggests fields of the same name elsewhere, fields that `value` names, or similar names."""
    known = sorted(field_types(config))
    fields = _nested(config, str(name), prefix)
    fields += [prefix + each for each in _names(value) if each in known]
    hint = f"did you mean {' or '.join(fields)}?" if fields else ""
    hint = hint or did_you_mean(str(name), known, prefix)
    hint = hint or f"the fields are {', '.join(prefix + other for other in known)}"
    return ValueError(f"there is no field {prefix}{name}; {hint}")


def _nested(config: Any, name: str, prefix: str) -> list[str]:
    """Returns the dotted names of the fields called `name` in the configurations in `config`."""
    parts = [(f"{prefix}{field}.", getattr(config, field)) for field in sorted(field_types(config))]
    found = [path + name for path, part in parts if name in field_types(part)]
    return found + [other for path, part in parts for other in _nested(part, name, path)]


def _names(given: Any) -> list[str]:
    """Returns the names of fields in YAML data, at any depth."""
    if not isinstance(given, dict):
        return []
    return [each for name, value in given.items() for each in (str(name), *_names(value))]


def field_types(config: Any) -> dict[str, Any]:
    """Returns the types of a configuration's fields by name; empty for plain values."""
    return {field.name: field.type for field in config_fields(config)}


def _check_type(name: str, expected: Any, value: Any) -> None:
    """Raises ValueError for a plain value that Drake's reader cannot convert to a field's type."""
    options = [option for option in get_args(expected) if option is not NoneType]
    if get_origin(expected) is list and isinstance(value, list):
        for index, each in enumerate(value):
            _check_type(f"{name}[{index}]", options[0], each)
    elif get_origin(expected) is list:  # Drake's reader takes letters of texts, and keys.
        remedy = f"write [{value}]" if isinstance(value, str) else ""
        require(not isinstance(value, str | dict), name, "a list", _shortened(value), remedy)
    elif get_origin(expected) is UnionType and len(options) == 1:
        _check_type(name, options[0], value)
    elif expected in TYPES:
        require(_converts(value, expected), name, TYPES[expected], _shortened(value))
    elif expected is str:
        require(not isinstance(value, dict | list), name, "text", _shortened(value))


def _converts(value: Any, expected: type) -> bool:
    if expected is bool or isinstance(value, bool):
        return expected is bool and value in (True, False, "true", "false")
    try:
        expected(value)
    except (TypeError, ValueError, OverflowError):
        return False
    return expected is float or not isinstance(value, float) or value.is_integer()


def _import_types(config: Any, text: str) -> None:
    """Imports packages that announce configurations, if the text has a tag that is not known."""
    for field in config_fields(config):
        if isinstance(field, RegistryField):
            known = {known.__name__ for known in field.registry.configs()}
            if set(re.findall(r"!(\w+)", text)) - known:
                field.registry.load_announced()
        else:
            _import_types(getattr(config, field.name, None), text)


def _unknown_tag(config: Any, tag: str, name: str) -> str:
    """Returns the message for an unknown tag, with the known ones."""
    union = field_types(config).get(name)
    known = ", ".join(dict.fromkeys(f"!{option.__name__}" for option in get_args(union)))
    return (
        f"{name} must be one of {known or 'the known types'}, got !{tag}; install the package "
        "that has it, or import its module (--import)"
    )


def _shortened(value: Any) -> str:
    """Returns a value's text, shortened: it may be a whole file."""
    if isinstance(value, dict) and "_tag" in value:
        value = value["_tag"]
    # Aliases of YAML may make a short file a huge value.
    whole = reprlib.repr(value) if isinstance(value, dict | list) else str(value)
    text = "null" if value is None else " ".join(whole.split())
    return text if len(text) <= 40 else f"{text[:40]}..."


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
    texts: dict[str, str] = {}
    for base in reversed(type(config).__mro__):
        texts |= _texts(base)
    return [
        FieldDescription(
            field.name,
            value := getattr(config, field.name),
            texts.get(field.name) or _class_text(value),
            getattr(field, "registry", None),
        )
        for field in config_fields(config)
    ]


def format_fields(config: Any) -> str:
    """Lists the fields of a configuration with types, values and descriptions."""
    width = max(shutil.get_terminal_size().columns - 2, 40)
    lines = []
    for heading, text in _described(config, ""):
        lines.append(heading)
        lines += wrap(text, width, initial_indent="    ", subsequent_indent="    ")
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
        found = field_types(config)[field.name]
        return found.__name__ if type(found) is type else re.sub(r"\b\w+\.(?=\w)", "", str(found))
    if isinstance(field.value, np.ndarray):
        return "list[float]"
    return "number, text or null" if field.value is None else type(field.value).__name__


@functools.cache
def _texts(config: type) -> dict[str, str]:
    """Returns the texts of the fields that a class itself defines; empty without source."""
    if not dataclasses.is_dataclass(config):  # pybind11 writes a signature if there is no text.
        docs = {f.name: getattr(config, f.name).__doc__ or "" for f in config_fields(config)}
        return {name: _paragraph(doc) for name, doc in docs.items() if not doc.startswith("(self)")}
    try:
        lines = dedent(inspect.getsource(config)).splitlines()
    except (OSError, TypeError):
        return {}
    (definition,) = ast.parse("\n".join(lines)).body
    assert isinstance(definition, ast.ClassDef)
    texts = {}
    for statement, following in zip_longest(definition.body, definition.body[1:]):
        match statement, following:
            case ast.AnnAssign(target=ast.Name(name)), ast.Expr(value=ast.Constant(str(text))):
                texts[name] = " ".join(text.split())
            case ast.AnnAssign(target=ast.Name(name)), _:
                texts[name] = _comment(lines, statement)
    return {name: text for name, text in texts.items() if text}


def _comment(lines: list[str], field: ast.stmt) -> str:
    """Returns the comment after a field, or else the one in the lines above it."""
    assert field.end_lineno is not None
    after = lines[field.end_lineno - 1].encode()[field.end_col_offset :].decode().strip()
    if after.startswith("#"):
        return " ".join(after.lstrip("# ").split())
    above = []
    for line in reversed(lines[: field.lineno - 1]):
        if not line.strip().startswith("#"):
            break
        above.insert(0, line.strip().lstrip("# "))
    return " ".join(" ".join(above).split())


def _class_text(value: Any) -> str:
    return _paragraph(type(value).__doc__ or "") if is_configuration(value) else ""


def _paragraph(text: str) -> str:
    """Returns the first paragraph as one line, without the Doxygen marks that Drake leaves in."""
    return " ".join(text.partition("\n\n")[0].split()).lstrip("%").replace("∷", "::")
