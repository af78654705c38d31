"""The command line. It stands on the top floor because it may reach every other."""

import argparse
import atexit
import contextlib
import json
import logging
import os
import platform
import re
import shlex
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Collection, Iterator, Sequence
from types import FrameType
from typing import Any, NoReturn

from splatpilot.analysis.commands import COMMANDS
from splatpilot.analysis.commands.options import FailureWithResultError, as_json
from splatpilot.systems.common.extras import missing_extra
from splatpilot.systems.common.validation import TYPES, did_you_mean, unknown


def raised_by(error: BaseException, packages: Collection[str]) -> str:
    """
    The file and line in one of others' `packages` that an exception comes from, if not of ours.

    Args:
        error: what ended the program.
        packages: by name, or modules outside of any.
    """
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        package = frame.f_globals.get("__name__", "").partition(".")[0]
        if package in packages:
            place = f"{frame.f_code.co_filename}, line {line}"
        elif package == "splatpilot":
            place = ""
    return place


def write_report(error: BaseException, arguments: Sequence[str]) -> str:
    """
    Writes what is needed to find a mistake of this program to a file in the folder for temporary
    files.

    Args:
        error: what ended the program.
        arguments: the words after `splatpilot`.

    Returns:
        The file; or, where none can be written, the report.
    """
    from splatpilot.systems.common.provenance import program

    told = [
        f"splatpilot {shlex.join(arguments)}",
        *(f"{name} {version}" for name, version in program().items()),
        f"Python {platform.python_version()} on {platform.platform()}",
        "",
        "".join(traceback.format_exception(error)),
    ]
    text = "\n".join(told)
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="splatpilot-", suffix=".txt", delete=False
        ) as file:
            file.write(text)
    except OSError:
        return text
    return file.name


class _PrintVersion(argparse.Action):
    """Finds the version out only when it is asked for, because that takes as long as the rest."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from splatpilot import __version__

        print(f"{parser.prog} {__version__}")
        parser.exit()


class _ImportModule(argparse.Action):
    """Imports a module before the verb is read, whose help may be of what it registers."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, value: Any, *_: Any
    ) -> None:
        from splatpilot.systems.common.registry import import_modules

        import_modules([value])
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), value])


class _Parser(argparse.ArgumentParser):
    """Asks, for a word that it does not know, which was meant."""

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.option_strings or action.choices is None or value in action.choices:
            super()._check_value(action, value)
        else:
            what = str(action.metavar or action.dest).lower()
            raise argparse.ArgumentError(None, unknown(what, value, action.choices))

    def _get_value(self, action: argparse.Action, arg_string: str) -> Any:
        try:
            return super()._get_value(action, arg_string)
        except argparse.ArgumentError:
            if (expected := TYPES.get(action.type)) is None:
                raise
            what = "/".join(action.option_strings) or action.dest
            problem = f"{what} must be {expected}, got {arg_string!r}"
            raise argparse.ArgumentError(None, problem) from None

    def parse_known_args(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, args: Any = None, namespace: Any = None
    ) -> Any:
        # Of a command, here and not in the parser of all commands: this one knows its options.
        options, words = super().parse_known_args(args, namespace)
        if words:
            setting = f"did you mean --set {words[0]}?" if re.match(r"[\w.]+=", words[0]) else ""
            hint = setting or did_you_mean(words[0], self._option_string_actions)
            self.error(f"unrecognized arguments: {' '.join(words)}" + (f"; {hint}" if hint else ""))
        return options, words

    def error(self, message: str) -> NoReturn:
        remedy = "" if message.endswith("?") else f"; see `{self.prog} --help`"
        self.exit(2, f"{self.prog}: {message}{remedy}\n")


_ENDED = {signal.SIGTERM: ("terminated", 143), signal.SIGINT: ("interrupted", 130)}


class _EndedError(KeyboardInterrupt):
    """A signal has come that ends everything."""

    def __init__(self, number: int):
        super().__init__(number)
        self.number = signal.Signals(number)


def build_parser() -> argparse.ArgumentParser:
    """The parser of `splatpilot`, with all verbs."""
    parser = _Parser(
        prog="splatpilot",
        description="Fly drones by camera inside Gaussian-splat worlds.",
        epilog="exit status: 0 done, 1 an error that one message explains, 2 words that make no "
        "command, 70 a mistake of the program, which leaves a report, 130 and 143 ended by Ctrl-C "
        "and SIGTERM",
    )
    parser.add_argument(
        "--import",
        action=_ImportModule,
        default=[],
        dest="modules",
        metavar="MODULE",
        help="import a module that registers policies, worlds, sensors, ... (repeatable)",
    )
    parser.add_argument(
        "--version", action=_PrintVersion, nargs=0, help="show the version and exit"
    )
    verbs = parser.add_subparsers(required=True, metavar="COMMAND", dest="verb_name")
    for command in COMMANDS:
        command.add_to(verbs)
    return parser


def run() -> NoReturn:
    """The command `splatpilot`: `main`, before and after which signals end the process in the same
    way, but at once."""
    heeded = _heeded()
    for number in heeded:
        signal.signal(number, _leave)
    # Registered first, it is done last: Python then takes modules apart, and answers no signal. To
    # block them would do for this thread alone.
    atexit.register(_ignore, heeded)
    sys.exit(main())


def main(arguments: list[str] | None = None) -> int:
    """
    Runs `splatpilot COMMAND ...`.

    Args:
        arguments: the words after `splatpilot`; those of the process when None.

    Returns:
        The exit status: 0; 1 after an error that one line on standard error explains; 70 after a
        mistake of this program, with a line that says which file has a report of it; 130 and 143
        after Ctrl-C and SIGTERM.
    """
    parser = build_parser()
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)
    logging.getLogger("drake").addFilter(_is_warning)
    verb, options = "splatpilot", argparse.Namespace(modules=[])
    try:
        with _ended_by_signals():
            options = parser.parse_args(arguments)
            verb = options.verb_name
            if not getattr(options, "json", False):
                options.verb(options)
                return 0
            try:
                with contextlib.redirect_stdout(sys.stderr):
                    result = options.verb(options)
            except FailureWithResultError as failure:
                print(json.dumps(as_json(failure.result), indent=2))
                raise
            print(json.dumps(as_json(result), indent=2))
            return 0
    except BrokenPipeError:  # who read what is printed has had enough, as `head` does
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _say("what it prints was not read to its end", 1)
    except (ValueError, OSError) as error:
        place = _place_of(error)
        return _say(f"{error} ({place})" if place else str(error), 1)
    except MemoryError as error:
        needed = f" ({error})" if str(error) else ""
        return _say(
            f"{verb} needs more memory than there is{needed}; make the world, the images or the "
            "voxels of a smaller size, or use fewer --jobs",
            1,
        )
    except OverflowError as error:
        return _say(f"a number given to {verb} is too large ({error}); give a smaller one", 1)
    except KeyboardInterrupt as ended:
        message, status = _ENDED[getattr(ended, "number", signal.SIGINT)]
        return _say("; ".join([message, *getattr(ended, "__notes__", ())]), status)
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and (missing := missing_extra(error, verb)):
            return _say(missing, 1)
        report = write_report(error, sys.argv[1:] if arguments is None else arguments)
        kind = type(error).__name__
        if place := _place_of(error):
            return _say(f"{place}: {kind}: {error}; the traceback is in {report}", 1)
        return _say(f"{verb} met a mistake of the program ({kind}); the report is {report}", 70)


def _place_of(error: Exception) -> str:
    """Where in code of others an exception comes from, if not from ours."""
    registry = sys.modules.get(
        "splatpilot.systems.common.registry"
    )  # else nothing of theirs is there
    return raised_by(error, registry.plugin_packages()) if registry is not None else ""


def _heeded() -> list[int]:
    """The signals that end this process. Whoever started it may have it ignore them, as shells do
    with what runs behind them."""
    return [number for number in _ENDED if signal.getsignal(number) is not signal.SIG_IGN]


def _ignore(numbers: list[int]) -> None:
    for number in numbers:
        signal.signal(number, signal.SIG_IGN)


def _imports(frame: FrameType | None) -> bool:
    """Whether a module is being imported: native ones abort, or say that they cannot be imported,
    where an exception of others goes through them."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    """Ends the process at once. What it was writing goes when the next begins in that folder."""
    message, status = _ENDED[signal.Signals(number)]
    with contextlib.suppress(RuntimeError, OSError):  # it may be in the midst of printing
        sys.stdout.flush()
    line = "\n" if _progress_bars() else ""
    os.write(2, f"{line}splatpilot: {message}\n".encode())
    os._exit(status)


def _say(message: str, status: int) -> int:
    """Prints a message as one line, the last; returns the status."""
    for bar in _progress_bars():
        bar.close()
    print(f"splatpilot: {' '.join(message.split())}", file=sys.stderr)
    return status


def _progress_bars() -> list[Any]:
    """Those of tqdm that are open: they end when somebody lets go of them, which may be later."""
    return list(getattr(getattr(sys.modules.get("tqdm"), "tqdm", None), "_instances", ()))


def _is_warning(record: logging.LogRecord) -> bool:
    """A filter in the place of a level, which Drake sets anew when it is imported."""
    return record.levelno >= logging.WARNING


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Within, SIGTERM and Ctrl-C raise `_EndedError`; signals reach the main thread alone."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        if _imports(frame):
            _leave(number, frame)
        raise _EndedError(number)

    before = {number: signal.signal(number, end) for number in _heeded()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
