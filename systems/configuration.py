"""Configurations: dataclasses whose fields a YAML file or the command line may set."""

import dataclasses
import functools
import operator
import re
from collections.abc import Callable
from pathlib import Path
from textwrap import indent
from types import UnionType
from typing import Any, cast

import yaml
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed

from splatpilot.systems.array_files import reason_of
from splatpilot.systems.given_fields import check_fields
from splatpilot.systems.read_limit import read_text, require_shallow
from splatpilot.systems.registry import Registry

OPEN_REGISTRY = "registry"
"""Key of an open field's registry in its metadata."""


def open_field(registry: Registry, default: Callable[[], Any]) -> Any:
    """
    A field of a dataclass that holds a configuration of any kind that the registry has or will
    have, or a dictionary of such. In YAML its tag names the type; one without a tag is of the type
    that `default` makes.
    """
    return dataclasses.field(default_factory=default, metadata={OPEN_REGISTRY: registry})


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
            message names the file or override, the field and its likely spelling.
    """
    config = defaults
    if path is not None:
        config = _updated(config, read_text(path), str(path))
    for override in overrides or []:
        name, equals, value = override.partition("=")
        if not equals:
            raise ValueError(f"override {override!r} has no value; write FIELD=VALUE")
        _resolve_open_fields(config, set())  # of which `_tag_of` asks which types there are
        *parents, field = name.split(".")
        text = tagged = f"{field}: {value}"
        for depth in reversed(range(len(parents))):
            tag = _tag_of(config, parents[: depth + 1])
            text = f"{parents[depth]}:\n{indent(text, '  ')}"
            tagged = f"{parents[depth]}: {tag}\n{indent(tagged, '  ')}"
        config = _updated(config, text, f"override {override!r}", tagged)
    return config


def parse_config[Config](defaults: Config, text: str, source: str) -> Config:
    """The configuration that a YAML text describes; `source` names the text in errors.

    Raises:
        ValueError: see `load_config`.
    """
    return _updated(defaults, text, source)


def require_configuration(config: type) -> None:
    """
    Checks that a type can be that of configurations: a dataclass whose fields have defaults, which
    YAML can hold, with a method `validate`.

    Raises:
        ValueError: if it cannot; the message says what it lacks.
    """
    name = getattr(config, "__name__", repr(config))
    if not (isinstance(config, type) and dataclasses.is_dataclass(config)):
        raise ValueError(f"{name} is no dataclass; decorate it with @dataclass")
    if not callable(getattr(config, "validate", None)):
        raise ValueError(
            f"{name} has no method validate(); give it one that raises ValueError on a value out "
            "of range"
        )
    try:
        dump_config(config())
    except Exception as error:  # of fields without defaults, and of types that Drake cannot write
        raise ValueError(
            f"{name} makes no YAML ({type(error).__name__}: {reason_of(error)}); give all fields "
            "defaults, and types of bool, int, float, str, list, dict or other dataclasses"
        ) from None


def dump_config(config: Any) -> str:
    """The configuration as YAML, every field written out."""
    _resolve_open_fields(config, set())
    return cast(str, yaml_dump_typed(config))


def yaml_problem(error: yaml.YAMLError) -> str:
    """What is wrong with a text that is not YAML, in one line and without what it holds."""
    if not isinstance(error, yaml.MarkedYAMLError) or error.problem_mark is None:
        return reason_of(error)
    return f"line {error.problem_mark.line + 1}: {reason_of(error.problem)}"


def _resolve_open_fields(config: Any, tags: set[str]) -> None:
    """
    Gives Drake's reader and writer, which go by the types of fields, the types that the open fields
    of a configuration and of those in it may have now; `tags` are those that a text names.

    They read what has no tag as the first type, and write a value as the first type that it is an
    instance of, without a tag where that is the very first.
    """
    if not dataclasses.is_dataclass(config):
        return
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        registry: Registry | None = field.metadata.get(OPEN_REGISTRY)
        if registry is None:
            _resolve_open_fields(value, tags)
            continue
        held = list(value.values()) if isinstance(value, dict) else [value]
        for one in held:
            _resolve_open_fields(one, tags)
        known = registry.configs(tags | {type(one).__name__ for one in held})
        first = known[0] if isinstance(value, dict) else type(field.default_factory())  # type: ignore
        # Of types that derive from each other the derived ones come first. A value that derives
        # from the untagged type must not pass for it: then what fits none goes before all.
        others = [t for t in dict.fromkeys([*known, *map(type, held)]) if t is not first]
        derived = sorted(others, key=lambda t: -len(t.__mro__))
        passes = any(isinstance(one, first) and type(one) is not first for one in held)
        types = [_Nothing, *derived, first] if passes else [first, *derived, _Nothing]
        union = functools.reduce(operator.or_, types)
        field.type = dict[str, union] if isinstance(value, dict) else union


class _Nothing:
    """A type that no value is of: it keeps unions of one type unions."""


def _tag_of(config: Any, path: list[str]) -> str:
    """The YAML tag that keeps the type which a field has now, where it may have several."""
    owner = config
    for name in path[:-1]:
        owner = owner.get(name) if isinstance(owner, dict) else getattr(owner, name, None)
    if isinstance(owner, dict):
        value, several = owner.get(path[-1]), True
    else:
        fields = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
        schema = next((field.type for field in fields if field.name == path[-1]), None)
        value, several = getattr(owner, path[-1], None), isinstance(schema, UnionType)
    return f"!{type(value).__name__}" if several and dataclasses.is_dataclass(value) else ""


def _updated[Config](config: Config, text: str, source: str, tagged: str = "") -> Config:
    """`config` with the fields that the YAML `text` gives; `source` names the text in errors.

    `tagged` is the same text with the types of fields that may have several.
    """
    require_shallow(text, source)
    try:
        _require_finite(text)
        tokens = [token for token in yaml.scan(text) if isinstance(token, yaml.TagToken)]
        _resolve_open_fields(config, {token.value[1] for token in tokens})
        check_fields(config, text)
        return yaml_load_typed(schema=type(config), data=tagged or text, defaults=config)
    except yaml.YAMLError as error:
        raise ValueError(f"{source} is not YAML: {yaml_problem(error)}") from None
    except RecursionError:
        raise ValueError(f"{source}: fields are nested too deeply; name another file") from None
    except AssertionError:  # How Drake's reader refuses a plain value where fields belong.
        raise ValueError(f"{source}: null stands where fields belong") from None
    except Exception as error:  # Drake's reader raises anything of values of other types
        unknown = _UNKNOWN_TAG.fullmatch(str(error).partition("\n")[0])
        reason = _known_tags(unknown) if unknown else reason_of(error)
        raise ValueError(f"{source}: {reason}") from None


def _require_finite(text: str) -> None:
    """Raises ValueError for a YAML text in which something stands within itself."""
    open_nodes: list[str | None] = []
    for event in yaml.parse(text):
        if isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append(event.anchor)
        elif isinstance(event, yaml.CollectionEndEvent):
            open_nodes.pop()
        elif isinstance(event, yaml.AliasEvent) and event.anchor in open_nodes:
            raise ValueError(f"line {event.start_mark.line + 1}: *{event.anchor} is within itself")


_UNKNOWN_TAG = re.compile(r"The yaml type tag value '(.*)' did not match .* for '(.*)' \((.*)\)$")


def _known_tags(refusal: re.Match[str]) -> str:
    """What Drake's reader says of an unknown tag, with the tags that there are and the remedy."""
    tag, field, types = refusal.groups()
    known = ", ".join(f"!{name}" for name in re.findall(r"\.([A-Za-z]\w*)'>", types))
    return (
        f"{field} is !{tag}, which nobody knows; known are {known}, and those of other packages "
        "once they are installed or their modules imported (--import)"
    )
