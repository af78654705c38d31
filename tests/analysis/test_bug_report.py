"""What the command line says of exceptions that are no user's fault, and of want of memory."""

import argparse
import sys
import tempfile

import pytest

from splatpilot.analysis.commands import main as cli
from splatpilot.analysis.commands.main import main
from splatpilot.systems.common.registry import import_modules


@pytest.fixture
def failing(monkeypatch, tmp_path):
    """Makes `splatpilot fly` raise."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def fail(error: BaseException) -> None:
        class Command:
            @staticmethod
            def add_to(verbs: argparse._SubParsersAction) -> None:
                def run(options: argparse.Namespace) -> None:
                    raise error

                verbs.add_parser("fly").set_defaults(verb=run)

        monkeypatch.setattr(cli, "COMMANDS", [Command])

    return fail


def test_mistakes_of_the_program_leave_a_report(failing, tmp_path, capsys):
    """What is no user's fault ends with one line and a file that has all that is needed."""
    failing(KeyError("of our own"))
    assert main(["fly"]) == 70
    said = capsys.readouterr().err
    [report] = tmp_path.iterdir()
    assert said == (f"splatpilot: internal error in fly (KeyError); the report is {report}\n")
    text = report.read_text()
    assert ": fly\n" in text and "Traceback" in text and "of our own" in text


def test_mistakes_of_imported_modules_are_theirs(failing, tmp_path, monkeypatch, capsys):
    """What a module that --import names raises is told with its file, line and words, however deep
    in a library; what our own code raises when it calls us is ours."""
    (tmp_path / "buggy.py").write_text("import json\ndef fail():\n    json.loads(3)\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    import_modules(["buggy"])
    with pytest.raises(TypeError) as raised:
        sys.modules["buggy"].fail()
    failing(raised.value)
    assert main(["--import", "buggy", "fly"]) == 1
    said = capsys.readouterr().err
    assert f"splatpilot: {tmp_path / 'buggy.py'}, line 3: TypeError: the JSON object" in said
    assert "the traceback is in" in said
    failing(KeyError("of our own"))
    assert main(["--import", "buggy", "fly"]) == 70


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (MemoryError("Unable to allocate 9 TiB"), r"more memory than there is (Unable to allocate"),
        (MemoryError(), "needs more memory than there is; make"),
        (OverflowError("too large for C long"), "a number given to fly is too large (too large"),
        (ValueError("first\n  second"), "splatpilot: first second"),
        (BrokenPipeError(), "was not read to the end"),
        (KeyboardInterrupt(), "splatpilot: interrupted"),
    ],
)
def test_what_users_can_do_is_one_line(failing, error, message, tmp_path, capsys):
    """Want of memory, numbers too large, and messages of several lines are one line each, and no
    report."""
    failing(error)
    assert main(["fly"]) in (1, 130)
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_errors_of_packages_of_others_are_told_with_their_place(
    failing, tmp_path, monkeypatch, capsys
):
    """A ValueError says no less than others do, in whichever module of their package it is."""
    package = tmp_path / "faulty"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "parts.py").write_text(
        "import numpy as np\ndef fail():\n    np.ones(3) + np.ones(2)\n"
    )
    (package / "policy.py").write_text("from faulty.parts import fail\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    import_modules(["faulty.policy"])
    with pytest.raises(ValueError, match="operands") as raised:
        sys.modules["faulty.policy"].fail()
    failing(raised.value)
    assert main(["fly"]) == 1
    said = capsys.readouterr().err
    assert "operands could not be broadcast" in said
    assert said.endswith(f"({package / 'parts.py'}, line 3)\n")
