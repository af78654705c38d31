"""The command line. It stands on the top floor because it may reach every other."""

import argparse
import sys
from typing import Any

from splatpilot.analysis.commands import COMMANDS
from splatpilot.systems.extras import missing_extra


class _PrintVersion(argparse.Action):
    """Finds the version out only when it is asked for, because that takes as long as the rest."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from splatpilot import __version__

        print(f"{parser.prog} {__version__}")
        parser.exit()


def main(arguments: list[str] | None = None) -> int:
    """
    Runs `splatpilot VERB ...`.

    Args:
        arguments: the words after `splatpilot`; those of the process when None.

    Returns:
        The exit status: 0, or 1 after an error that one message on standard error explains.
    """
    parser = argparse.ArgumentParser(
        prog="splatpilot", description="Fly drones by camera inside Gaussian-splat worlds."
    )
    parser.add_argument(
        "--import",
        action="append",
        default=[],
        dest="modules",
        metavar="MODULE",
        help="import a module that registers policies, worlds, sensors, ... (repeatable)",
    )
    parser.add_argument(
        "--version", action=_PrintVersion, nargs=0, help="show the version and exit"
    )
    verbs = parser.add_subparsers(required=True, metavar="VERB", dest="verb_name")
    for command in COMMANDS:
        command.add_to(verbs)
    options = parser.parse_args(arguments)
    try:
        if options.modules:
            from splatpilot.systems.registry import import_modules

            import_modules(options.modules)
        options.verb(options)
    except (ValueError, OSError) as error:
        print(f"splatpilot: {error}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        missing = missing_extra(error, options.verb_name)
        if missing is None:
            raise
        print(f"splatpilot: {missing}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("splatpilot: interrupted", file=sys.stderr)
        return 130
    return 0
