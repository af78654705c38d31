"""Messages about what a user gave, in one form each."""

import difflib
from collections.abc import Iterable

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


def require_field(config: object, name: str, valid: object, condition: str) -> None:
    """Checks a field of a configuration, named with its type, see `require`."""
    require(valid, f"{type(config).__name__}.{name}", condition, getattr(config, name))


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
