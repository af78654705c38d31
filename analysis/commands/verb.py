"""How a verb of the command line is shown: what it does, and examples of it."""

import argparse
import dataclasses
import math
import shutil
import textwrap
from collections.abc import Callable, Sequence
from typing import Any

EXAMPLES = "examples:"


def add_verb(
    verbs: argparse._SubParsersAction,
    name: str,
    run: Callable[[argparse.Namespace], Any] | None,
    *,
    help: str,
    description: str,
    examples: Sequence[str],
) -> argparse.ArgumentParser:
    """
    Adds a verb, or an action of one.

    Args:
        name: of it.
        run: is called with the options, and returns what `--json` prints where the verb has that
            option; None for a verb that has actions.
        help: half a sentence, for the list of verbs.
        description: whole sentences.
        examples: commands, what comes behind `splatpilot`.
    """
    width = max(shutil.get_terminal_size().columns - 2, 40)
    lines = [EXAMPLES, *(f"  splatpilot {example}" for example in examples)]
    parser = verbs.add_parser(
        name,
        help=help,
        description=textwrap.fill(description, width),
        epilog="\n".join(lines),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if run is not None:
        parser.set_defaults(verb=run)
    return parser


def add_named(
    parser: argparse.ArgumentParser, *flags: str, names: Sequence[str], **keywords: Any
) -> None:
    """Adds an option or argument for which shells complete these names, and files."""
    option: Any = parser.add_argument(*flags, **keywords)
    option.completer = lambda **_: names


def add_json(parser: argparse.ArgumentParser, what: str) -> None:
    """Adds `--json`, which prints what the verb's function returns, and nothing else, on standard
    output."""
    parser.add_argument(
        "--json", action="store_true", help=f"print {what} as JSON; all else goes to standard error"
    )


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Adds `--overwrite`."""
    parser.add_argument(
        "--overwrite", action="store_true", help="replace what is there; else it is an error"
    )


class FailureWithResultError(ValueError):
    """A failure of which there is something to print nevertheless, with `--json`."""

    def __init__(self, message: str, result: Any) -> None:
        super().__init__(message)
        self.result = result


def as_json(value: Any) -> Any:
    """A result as what JSON can hold; numbers that are none, which it cannot, as null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return as_json(dataclasses.asdict(value))
    if isinstance(value, dict):
        return {str(name): as_json(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(one) for one in value]
    value = getattr(value, "item", lambda: value)()  # of a number of numpy
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | None) else str(value)
