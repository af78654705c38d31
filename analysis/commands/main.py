"""The command line `splatpilot COMMAND ...`."""

import argparse
import atexit
import contextlib
import json
import logging
import os
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

from splatpilot.analysis.commands import COMMANDS, MOVED
from splatpilot.analysis.commands.options import FailureWithResultError, as_json
from splatpilot.systems.common.extras import missing_extra
from splatpilot.systems.common.validation import TYPES, did_you_mean, unknown


def raised_by(error: BaseException, packages: Collection[str]) -> str:
    """Returns the file and line in one of `packages` that raised an exception, if not our code."""
    raised = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        package = frame.f_globals.get("__name__", "").partition(".")[0]
        if package in packages:
            raised = f"{frame.f_code.co_filename}, line {line}"
        elif package == "splatpilot":
            raised = ""
    return raised


def write_report(error: BaseException, arguments: Sequence[str]) -> str:
    """Writes the command and the traceback to a temporary file; returns its path, or the text."""
    from importlib.metadata import version

    command = f"splatpilot {version('splatpilot')}: {shlex.join(arguments)}"
    text = f"{command}\n\n{''.join(traceback.format_exception(error))}"
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="splatpilot-", suffix=".txt", delete=False
        ) as file:
            file.write(text)
    except OSError:
        return text
    return file.name


class _PrintVersion(argparse.Action):
    """Prints the version, which takes as long to find as all else to import."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from splatpilot import __version__

        print(f"{parser.prog} {__version__}")
        parser.exit()


class _ImportModule(argparse.Action):
    """Imports a module before the command is parsed, whose help may list its entries."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, value: Any, *_: Any
    ) -> None:
        from splatpilot.systems.common.registry import import_modules

        import_modules([value])
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), value])


class _Parser(argparse.ArgumentParser):
    """Parser that suggests similar words for unknown ones."""

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.option_strings or action.choices is None or value in action.choices:
            super()._check_value(action, value)
        else:
            what = str(action.metavar or action.dest).lower()
            message = unknown(what, value, action.choices)
            if value in MOVED and self.prog == "splatpilot":
                message = f"`splatpilot {value}` is now `splatpilot {MOVED[value]}`"
            raise argparse.ArgumentError(None, message)

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
        # The parser of the command, not that of all commands, knows the options to suggest.
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
    """A signal that ends the command."""

    def __init__(self, number: int):
        super().__init__(number)
        self.number = signal.Signals(number)


def build_parser() -> argparse.ArgumentParser:
    """Builds the parser of `splatpilot` with all commands."""
    parser = _Parser(
        prog="splatpilot",
        description="Fly drones by camera inside Gaussian-splat worlds.",
        epilog="exit status: 0 done, 1 an error that one message explains, 2 invalid command line, "
        "70 an internal error, which leaves a report, 130 and 143 ended by Ctrl-C and SIGTERM",
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
    """Runs `main`; signals before and after it end the process at once, in the same way."""
    heeded = _heeded()
    for number in heeded:
        signal.signal(number, _leave)
    # Registered first, it runs last: Python then unloads modules and must not handle signals.
    atexit.register(_ignore, heeded)
    sys.exit(main())


def main(arguments: list[str] | None = None) -> int:
    """
    Runs `splatpilot COMMAND ...`.

    Args:
        arguments: the words after `splatpilot`; those of the process if None.

    Returns:
        The exit status, see `splatpilot --help`.
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
    except BrokenPipeError:
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _say("its output was not read to the end", 1)
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
        return _say(f"internal error in {verb} ({kind}); the report is {report}", 70)


def _place_of(error: Exception) -> str:
    """Returns the file and line in a plugin that raised an exception, if not our code."""
    registry = sys.modules.get("splatpilot.systems.common.registry")
    return raised_by(error, registry.plugin_packages()) if registry is not None else ""


def _heeded() -> list[int]:
    """Returns the signals that end this process; shells let background processes ignore some."""
    return [number for number in _ENDED if signal.getsignal(number) is not signal.SIG_IGN]


def _ignore(numbers: list[int]) -> None:
    for number in numbers:
        signal.signal(number, signal.SIG_IGN)


def _imports(frame: FrameType | None) -> bool:
    """Returns True while a module is imported: an exception in a native one may abort."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    """Ends the process at once; the next run in the folder removes its leftovers."""
    message, status = _ENDED[signal.Signals(number)]
    with contextlib.suppress(RuntimeError, OSError):  # it may be printing
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
    """Returns the open progress bars of tqdm."""
    return list(getattr(getattr(sys.modules.get("tqdm"), "tqdm", None), "_instances", ()))


def _is_warning(record: logging.LogRecord) -> bool:
    """Filters warnings; Drake resets the level when it is imported."""
    return record.levelno >= logging.WARNING


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Lets SIGTERM and Ctrl-C raise `_EndedError` in the block, if this is the main thread."""
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
