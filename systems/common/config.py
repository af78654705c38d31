"""Configurations: dataclasses whose fields a YAML file or the command line may set."""

import ast
import dataclasses
import functools
import inspect
import operator
import re
import textwrap
from collections.abc import Callable
from itertools import zip_longest
from pathlib import Path
from textwrap import indent
from types import NoneType, UnionType
from typing import Any, cast, get_args, get_origin

import yaml
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed

from splatpilot.systems.common.readers import read_text, reason_of, require_shallow
from splatpilot.systems.common.registry import Registry
from splatpilot.systems.common.validation import TYPES, did_you_mean, require

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
