"""What the command line says of itself."""

import argparse
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator

import pytest

from splatpilot.analysis.commands.main import build_parser, main
from splatpilot.analysis.commands.options import EXAMPLES, POLICIES, TRAINERS, SetField
from splatpilot.diagrams.flight import policies
from splatpilot.systems.common.config import load_config
from splatpilot.training.policies import trainer_registry as registry


def verbs_of(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """The parsers of all verbs, and of their actions."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for verb in action.choices.values():
                yield verb
                yield from verbs_of(verb)


VERBS = {verb.prog: verb for verb in verbs_of(build_parser())}


@pytest.mark.parametrize("prog", VERBS)
def test_every_verb_has_a_description_and_examples_that_are_commands(prog):
    """Its help says in sentences what it does, and gives two or three commands of that verb, which
    the command line accepts."""
    verb = VERBS[prog]
    assert verb.description and verb.description.rstrip().endswith(".")
    heading, *examples = (verb.epilog or "").splitlines()
    assert heading == EXAMPLES and 2 <= len(examples) <= 3
    for example in examples:
        assert example.startswith(f"  {prog}")
        options = build_parser().parse_args(shlex.split(example)[1:])
        assert callable(options.verb)


@pytest.mark.parametrize(
    "prog",
    [p for p, verb in VERBS.items() if any(isinstance(a, SetField) for a in verb._actions)],
)
def test_fields_that_help_names_can_be_set(prog):
    """The fields that matter, as the help of --set gives them, are fields of the verb's
    configuration, with values that it takes."""
    verb = VERBS[prog]
    (option,) = (action for action in verb._actions if isinstance(action, SetField))
    named = (option.help or "").partition("for example ")[2].rpartition(" (repeatable)")[0]
    options = argparse.Namespace(
        what=None,
        policies=["student_depth"] if prog.endswith("recover") else ["diffaero"],
        **dict.fromkeys(("scenario", "policy", "speed", "scene", "seed")),
        overrides=[],
    )
    for override in shlex.split(named.replace(", ", " ")):
        load_config(option.configuration(options), overrides=[override])


def test_set_help_lists_every_field(capsys):
    """With type, value and what it is, of the configuration that the other options describe; what
    else the verb requires need not be there."""
    with pytest.raises(SystemExit) as ended:
        main(["fly", "--policy", "reactive", "--speed", "3", "--set", "help"])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert "policy.speed=3.0  (float)\n" in printed
    assert "timeout=60.0  (float)\n    [s] The flight ends after this time.\n" in printed
    assert "policy  (!ReactiveConfig or !PrivilegedPlannerConfig or " in printed
    assert "start=null  (list[float] | None)\n" in printed
    with pytest.raises(SystemExit):
        main(["reconstruct", "--set", "voxel_size=0.2", "--set", "help"])
    assert "voxel_size=" in capsys.readouterr().out


def test_names_that_are_checked_early_are_those_registered():
    """The names that the command line knows without importing policies and trainers are theirs."""
    registered = policies.POLICIES.registered()
    assert registered[: len(POLICIES)] == list(POLICIES)
    assert registry.TRAINERS.registered()[: len(TRAINERS)] == list(TRAINERS)


@pytest.mark.parametrize(
    ("line", "completions"),
    [
        ("splatpilot rep", {"replay "}),
        ("splatpilot fly --ov", {"--overwrite "}),
        ("splatpilot fly --policy diff", {"diffaero", "diffaero_tof", "diffaero_rgb"}),
        ("splatpilot fly --scenario P0", {f"P0{n}" for n in range(1, 10)}),
        ("splatpilot train dep", {"depthnav "}),
    ],
)
def test_shells_complete_words(line, completions, tmp_path):
    """Verbs, options, and the names of policies, scenarios and trainers are completed."""
    out = tmp_path / "completions"
    environment = os.environ | {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(out),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    script = "from splatpilot.analysis.commands.main import main; main()"
    subprocess.run([sys.executable, "-c", script], env=environment, check=False)
    assert set(out.read_text().split("\n")) == completions
