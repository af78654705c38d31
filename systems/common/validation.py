"""Validation of configurations and options, with one form of message.

A field declares the values it may have where it is defined::

    @dataclass
    class NoiseConfig(Config):
        latency: float = bounded(0.0, "[0, 1] s")
        model: str = bounded("gaussian", "{gaussian, uniform}")

`Config.validate` checks all of them, then the conditions between fields in `Config.check`.
"""

import dataclasses
import difflib
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from numbers import Real
from typing import Any, cast

TYPES = {float: "a number", int: "a whole number", bool: "true or false"}
"""Names of plain types in messages."""

# Suggested names are at least this similar, at most this less similar than the best, and so few.
_MIN_SIMILARITY, _MARGIN, _MAX_NAMES = 0.6, 0.1, 3


def require(valid: object, what: str, condition: str, value: object, remedy: str = "") -> None:
    """Raises ValueError, "<what> must be <condition>, got <value>; <remedy>", unless `valid`.

    The condition is such as "at least 1" or "in (0, 20] m/s".
    """
    if not valid:
        after = f"; {remedy}" if remedy else ""
        raise ValueError(f"{what} must be {condition}, got {value}{after}")


@contextmanager
def errors_about(source: object) -> Iterator[None]:
    """Writes `source`, such as a file, before the message of a ValueError in the block."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


def require_type(value: object, kind: type, what: str, remedy: str = "") -> None:
    """Raises ValueError, see `require`, unless `value` is a `kind`."""
    name = type(value).__name__
    require(isinstance(value, kind), what, f"of type {kind.__name__}", f"a {name}", remedy)


MAX_SEED = 2**31 - 1


def check_seed(seed: int) -> None:
    """Raises ValueError unless a seed is in [0, `MAX_SEED`]."""
    require(0 <= seed <= MAX_SEED, "seed", f"in [0, {MAX_SEED}]", seed)


class FieldError(ValueError):
    """A field of a configuration is out of range; the message names the configuration's type."""

    def __init__(self, config: object, name: str, problem: str) -> None:
        super().__init__(config, name, problem)
        self.config, self.name, self.problem = config, name, problem

    def __str__(self) -> str:
        return f"{type(self.config).__name__}.{self.name} {self.problem}"

    def within(self, whole: object) -> ValueError:
        """Returns the error with the field's path in `whole`, such as `policy.lattice.speed`."""
        path = _path(whole, self.config)
        return ValueError(f"{path}.{self.name} {self.problem}") if path else self


def validate(config: Any) -> None:
    """Validates a configuration; errors name fields as in its file."""
    try:
        config.validate()
    except FieldError as error:
        raise error.within(config) from None


def _path(whole: object, part: object) -> str:
    """Returns the dotted path from one configuration to another in it; empty without one."""
    fields = whole if isinstance(whole, dict) else {}
    for name, value in (vars(whole) if dataclasses.is_dataclass(whole) else fields).items():
        if value is part:
            return str(name)
        if inner := _path(value, part):
            return f"{name}.{inner}"
    return ""


def require_field(config: object, name: str, valid: object, condition: str) -> None:
    """Raises FieldError, see `require`, unless a field of a configuration is valid."""
    if not valid:
        raise FieldError(config, name, f"must be {condition}, got {getattr(config, name)}")


def unknown(what: str, name: str, known: Iterable[str], others: str = "") -> str:
    """Returns a message for an unknown name, with similar names or else all, and `others`."""
    known = list(dict.fromkeys(known))
    listed = ", ".join([*known, *([others] if others else [])])
    return f"there is no {what} {name!r}; {did_you_mean(name, known) or f'there are {listed}'}"


def did_you_mean(name: str, known: Iterable[str], prefix: str = "") -> str:
    """Returns a question with the names most similar to `name`; empty for none or many."""
    ratios = {
        each: difflib.SequenceMatcher(None, name.lower(), each.lower()).ratio() for each in known
    }
    enough = max(_MIN_SIMILARITY, max(ratios.values(), default=0.0) - _MARGIN)
    close = [f"{prefix}{each}" for each, ratio in ratios.items() if ratio >= enough]
    return f"did you mean {' or '.join(close)}?" if 0 < len(close) <= _MAX_NAMES else ""


_DOMAIN = "domain"  # key in a field's metadata
_INTERVAL = re.compile(r"([\[(])(\S+), ([^\])]+)([\])])")


def bounded(default: Any, domain: str) -> Any:
    """Declares a field of a configuration and its valid values.

    Args:
        default: value, or a function that makes it, such as `list`.
        domain: interval with its unit, as "(0, 3600] s", or set of words, as "{3dgs, 2dgs}". It
            applies to each item of a list; None is always valid.
    """
    given: Any = {"default_factory" if callable(default) else "default": default}
    return dataclasses.field(**given, metadata={_DOMAIN: domain})


class Config:
    """Base class of configurations, which are dataclasses."""

    def validate(self) -> None:
        """Raises ValueError unless all fields, the configurations in them and `check` are valid."""
        for field in dataclasses.fields(cast(Any, self)):
            value, domain = getattr(self, field.name), _domain(type(self), field.name)
            if domain:
                require_field(self, field.name, _is_in(value, domain), f"in {domain}")
            for part in _configurations(value):
                part.validate()
        self.check()

    def check(self) -> None:
        """Checks conditions between fields; raises ValueError."""


def _domain(config: type, name: str) -> str | None:
    """Returns the valid values of a field, those of a base class if the class declares none."""
    declared = (vars(base).get("__dataclass_fields__", {}).get(name) for base in config.__mro__)
    domains = (field.metadata.get(_DOMAIN) for field in declared if field is not None)
    return next((domain for domain in domains if domain), None)


def _configurations(value: Any) -> Iterator[Any]:
    """Yields the configurations that a field holds."""
    if dataclasses.is_dataclass(value) and hasattr(value, "validate"):
        yield value
    elif isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _configurations(part)


def _is_in(value: Any, domain: str) -> bool:
    if value is None:
        return True
    if isinstance(value, list | tuple):
        return all(_is_in(item, domain) for item in value)
    if domain.startswith("{"):
        return value in domain.strip("{}").split(", ")
    left, lower, upper, right = cast(re.Match[str], _INTERVAL.match(domain)).groups()
    if not isinstance(value, Real):
        return False
    value = float(value)
    above = value >= float(lower) if left == "[" else value > float(lower)
    return bool(above and (value <= float(upper) if right == "]" else value < float(upper)))
