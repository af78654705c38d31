"""The command line `splatpilot COMMAND ...`."""

import argparse
import atexit
import contextlib
import json
import locale
import logging
import os
import re
import shlex
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator, Sequence
from importlib import import_module
from types import FrameType
from typing import Any, NoReturn

from splatpilot.analysis.commands import COMMANDS
from splatpilot.analysis.commands.options import Command, FailureWithResultError, as_json
from splatpilot.systems.common.extras import missing_extra
from splatpilot.systems.common.validation import TYPES, did_you_mean, unknown

_SIGNALS = {signal.SIGTERM: ("terminated", 143), signal.SIGINT: ("interrupted", 130)}
"""Message and exit status of signals that end a command."""


class _PrintVersion(argparse.Action):
    """Prints the version, which is slow to find."""

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

        with contextlib.redirect_stdout(sys.stderr):  # Standard output may be JSON.
            import_modules([value])


class _Parser(argparse.ArgumentParser):
    """Parser that suggests similar words for unknown ones; `command` is added when it is called."""

    command = ""

    def __init__(self, *args: Any, **keywords: Any) -> None:
        super().__init__(*args, **keywords)
        # Points and axes may begin with a minus sign; argparse takes only numbers for values.
        self._negative_number_matcher = re.compile(r"-([\d.]|[xyz]$)")

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
        if self.command:
            find_command(self.command).fill(self)
            self.command = ""
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


def build_parser() -> argparse.ArgumentParser:
    """Builds the parser of `splatpilot` with all commands."""
    parser = _Parser(
        prog="splatpilot",
        description="Fly drones by camera inside Gaussian-splat worlds.",
        epilog="exit status: 0 done, 1 an error that one message explains, 2 invalid command line, "
        "70 an internal error, which writes a report, 130 and 143 ended by Ctrl-C and SIGTERM",
    )
    parser.add_argument(
        "--import",
        action=_ImportModule,
        dest="modules",
        metavar="MODULE",
        help="import a module that registers policies, worlds, sensors, ... (repeatable)",
    )
    parser.add_argument(
        "--version", action=_PrintVersion, nargs=0, help="show the version and exit"
    )
    groups: dict[str, Any] = {"": parser.add_subparsers(required=True, metavar="COMMAND")}
    for name, (module, text) in COMMANDS.items():
        group, _, word = name.rpartition(" ")
        added = groups[group].add_parser(word, help=text)
        if not module:
            added.description = f"{text[0].upper()}{text[1:]}."
            groups[name] = added.add_subparsers(required=True, metavar="SUBCOMMAND")
        elif "_ARGCOMPLETE" in os.environ:  # it takes the options before it parses
            find_command(name).fill(added)
        else:
            added.command = name
    return parser


def find_command(name: str) -> Command:
    """Imports a command."""
    module = import_module(f"splatpilot.analysis.commands.{COMMANDS[name][0]}")
    commands = (each for each in vars(module).values() if isinstance(each, Command))
    return next(command for command in commands if command.name == name)


def run() -> NoReturn:
    """Runs `main`; signals before and after it end the process at once, alike."""
    # pydrake cannot be imported in locales without UTF-8.
    is_utf8 = sys.flags.utf8_mode or locale.getencoding().upper() == "UTF-8"
    if not is_utf8 and "PYTHONUTF8" not in os.environ:
        again = [sys.executable, *sys.orig_argv[1:]]
        os.execve(sys.executable, again, os.environ | {"PYTHONUTF8": "1"})
    heeded = _heeded_signals()
    for number in heeded:
        signal.signal(number, _exit_at_once)
    # Registered first, it runs last: Python then unloads modules and must not handle signals.
    atexit.register(lambda: [signal.signal(number, signal.SIG_IGN) for number in heeded])
    sys.exit(main())


def main(arguments: list[str] | None = None) -> int:
    """Runs `splatpilot COMMAND ...` and returns its exit status, see `splatpilot --help`.
    `arguments` are the words after `splatpilot`; those of the process if None."""
    parser = build_parser()
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)
    logging.getLogger("drake").addFilter(_is_warning)
    name = "splatpilot"
    try:
        with _interrupted_by_signals():
            options = parser.parse_args(arguments)
            name = options.command.name.partition(" ")[0]
            if not getattr(options, "json", False):
                options.command.run(options)
                return 0
            try:
                with contextlib.redirect_stdout(sys.stderr):
                    result = options.command.run(options)
            except FailureWithResultError as failure:
                print(json.dumps(as_json(failure.result), indent=2))
                raise
            print(json.dumps(as_json(result), indent=2))
            return 0
    except BrokenPipeError:
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _report("its output was not read to the end", 1)
    except (ValueError, OSError) as error:
        line = _plugin_line(error)
        return _report(f"{error} ({line})" if line else str(error), 1)
    except MemoryError as error:
        size = f" ({error})" if str(error) else ""
        return _report(
            f"{name} needs more memory than there is{size}; make the world, the images or the "
            "voxels of a smaller size, or use fewer --jobs",
            1,
        )
    except OverflowError as error:
        return _report(f"a number given to {name} is too large ({error}); give a smaller one", 1)
    except KeyboardInterrupt as interruption:
        terminated = signal.SIGTERM in interruption.args
        message, status = _SIGNALS[signal.SIGTERM if terminated else signal.SIGINT]
        notes = getattr(interruption, "__notes__", ())
        return _report("; ".join([message, *notes]), status)
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and (missing := missing_extra(error, name)):
            return _report(missing, 1)
        file = _write_report(error, sys.argv[1:] if arguments is None else arguments)
        kind = type(error).__name__
        if line := _plugin_line(error):
            return _report(f"{line}: {kind}: {error}; the traceback is in {file}", 1)
        return _report(f"internal error in {name} ({kind}); the report is {file}", 70)


def _report(message: str, status: int) -> int:
    """Prints a message as one line, the last; returns the status."""
    for bar in _progress_bars():
        bar.close()
    print(f"splatpilot: {' '.join(message.split())}", file=sys.stderr)
    return status


def _write_report(error: BaseException, arguments: Sequence[str]) -> str:
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


def _plugin_line(error: BaseException) -> str:
    """Returns the file and line in a plugin that raised an exception, empty for our code."""
    registry = sys.modules.get("splatpilot.systems.common.registry")
    plugins = registry.plugin_packages() if registry is not None else ()
    found = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        package = frame.f_globals.get("__name__", "").partition(".")[0]
        if package in plugins:
            found = f"{frame.f_code.co_filename}, line {line}"
        elif package == "splatpilot":
            found = ""
    return found


def _progress_bars() -> list[Any]:
    return list(getattr(getattr(sys.modules.get("tqdm"), "tqdm", None), "_instances", ()))


def _is_warning(record: logging.LogRecord) -> bool:
    """Filters warnings; Drake resets the level when it is imported."""
    return record.levelno >= logging.WARNING


@contextlib.contextmanager
def _interrupted_by_signals() -> Iterator[None]:
    """Lets SIGTERM and Ctrl-C raise KeyboardInterrupt in the block, if this is the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if _is_importing(frame):
            _exit_at_once(number, frame)
        raise KeyboardInterrupt(signal.Signals(number))

    before = {number: signal.signal(number, interrupt) for number in _heeded_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _heeded_signals() -> list[int]:
    """Returns the signals that end this process; shells let background processes ignore some."""
    return [number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]


def _is_importing(frame: FrameType | None) -> bool:
    """Returns True while a module is imported: an exception in a native one may abort."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _exit_at_once(number: int, frame: FrameType | None) -> NoReturn:
    """Ends the process at once; the next run in the folder removes its leftovers."""
    message, status = _SIGNALS[signal.Signals(number)]
    with contextlib.suppress(RuntimeError, OSError):  # it may be printing
        sys.stdout.flush()
    line = "\n" if _progress_bars() else ""
    os.write(2, f"{line}splatpilot: {message}\n".encode())
    os._exit(status)
