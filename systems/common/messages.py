"""Messages about what a user gave, in one form each."""

import dataclasses
import difflib
from collections.abc import Iterable

TYPES = {float: "a number", int: "a whole number", bool: "true or false"}
"""What plain values of these types are called."""

_MIN_LIKENESS, _NO_LESS, _MAX_NAMES = 0.6, 0.1, 3
"""[-] Of names that are suggested: at least, less than the most alike at most, and how many."""


def require(valid: object, what: str, condition: str, value: object, remedy: str = "") -> None:
    """
    Checks a value that a user gave.

    Args:
        valid: whether it is as it must be.
        what: the field or option.
        condition: what must hold, as in "at least 1" or "in (0, 20] m/s".
        remedy: what to do, if that is not obvious.

    Raises:
        ValueError: "<what> must be <condition>, got <value>", unless it is valid.
    """
    if not valid:
        raise ValueError(
            f"{what} must be {condition}, got {value}" + (f"; {remedy}" if remedy else "")
        )


class FieldError(ValueError):
    """A field of a configuration is out of range; the message names the configuration's type."""

    def __init__(self, config: object, name: str, problem: str) -> None:
        super().__init__(config, name, problem)
        self.config, self.name, self.problem = config, name, problem

    def __str__(self) -> str:
        return f"{type(self.config).__name__}.{self.name} {self.problem}"

    def within(self, whole: object) -> ValueError:
        """The same error, naming the field as it is written in a file of the configuration `whole`,
        for example `policy.lattice.speed`."""
        path = _path(whole, self.config)
        return ValueError(f"{path}.{self.name} {self.problem}") if path else self


def _path(whole: object, part: object) -> str:
    """The names of the fields that lead from one configuration to another, empty if none do."""
    fields = whole if isinstance(whole, dict) else {}
    for name, value in (vars(whole) if dataclasses.is_dataclass(whole) else fields).items():
        if value is part:
            return str(name)
        if inner := _path(value, part):
            return f"{name}.{inner}"
    return ""


def require_field(config: object, name: str, valid: object, condition: str) -> None:
    """Checks a field of a configuration, see `require`.

    Raises:
        FieldError: unless it is valid.
    """
    if not valid:
        raise FieldError(config, name, f"must be {condition}, got {getattr(config, name)}")


def unknown(what: str, name: str, known: Iterable[str], others: str = "") -> str:
    """Says that there is no `what` of a name, and which was meant or else which there are.

    Args:
        others: what else may be given.
    """
    known = list(dict.fromkeys(known))
    listed = ", ".join([*known, *([others] if others else [])])
    return f"there is no {what} {name!r}; {did_you_mean(name, known) or f'there are {listed}'}"


def did_you_mean(name: str, known: Iterable[str], prefix: str = "") -> str:
    """Asks whether one of the known names that resemble `name` most was meant, with a prefix; empty
    if none does, or too many do."""
    likeness = {
        each: difflib.SequenceMatcher(None, name.lower(), each.lower()).ratio() for each in known
    }
    enough = max(_MIN_LIKENESS, max(likeness.values(), default=0.0) - _NO_LESS)
    close = [f"{prefix}{each}" for each, ratio in likeness.items() if ratio >= enough]
    return f"did you mean {' or '.join(close)}?" if 0 < len(close) <= _MAX_NAMES else ""
