"""Reports of exceptions that are nobody's fault but this program's."""

import platform
import shlex
import tempfile
import traceback
from collections.abc import Collection, Sequence


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
    from splatpilot.systems.provenance import program

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
