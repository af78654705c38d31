import argparse
import os
import shlex
import subprocess
import sys

import pytest

from splatpilot.analysis.commands import COMMANDS
from splatpilot.analysis.commands.checks import POLICY_NAMES, TRAINER_NAMES
from splatpilot.analysis.commands.main import build_parser, find_command, main
from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.systems.common.config import load_config
from splatpilot.training.policies.train import TRAINERS


@pytest.mark.parametrize("name", [name for name, (module, _) in COMMANDS.items() if module])
def test_examples_parse_and_fields_in_the_help_can_be_set(name):
    command = find_command(name)
    defaults = {option.name: option.keywords.get("default") for option in command.options}
    defaults |= {"policies": ["diffaero"]}
    if command.name == "recover":
        defaults |= {"policy": "student_depth"}
    for example in command.examples:
        assert example.startswith(command.name)
        assert build_parser().parse_args(shlex.split(example)).command is command
    for option in command.options:
        if option.name == "overrides":
            fields = option.keywords["help"].partition("for example ")[2].partition(" (rep")[0]
            for override in shlex.split(fields.replace(", ", " ")):
                config = option.keywords["configuration"](argparse.Namespace(**defaults))
                load_config(config, overrides=[override])


def test_set_help_lists_the_fields_of_the_configuration(capsys):
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


@pytest.mark.parametrize(
    ("registry", "names"), [(POLICIES, POLICY_NAMES), (TRAINERS, TRAINER_NAMES)]
)
def test_names_that_are_checked_early_are_those_of_the_registries(registry, names):
    found = {name: registry.find(name).config.__module__ for name in registry.registered()}
    ours = {name for name, module in found.items() if module.startswith("splatpilot.")}
    assert ours == set(names)


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
def test_shells_complete_commands_options_and_names(line, completions, tmp_path):
    out = tmp_path / "completions"
    shell = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "COMP_POINT": str(len(line))}
    shell |= {"_ARGCOMPLETE_STDOUT_FILENAME": str(out), "COMP_LINE": line}
    script = "from splatpilot.analysis.commands.main import main; main()"
    subprocess.run([sys.executable, "-c", script], env=os.environ | shell, check=False)
    assert set(out.read_text().split("\n")) == completions


@pytest.mark.parametrize(
    ("words", "file"),
    [("scene measure scene", "scene/metrics.json"), ("view scene --out page.html", "page.html")],
)
def test_existing_output_stays_unless_overwritten(words, file, room, monkeypatch, capsys):
    monkeypatch.chdir(room.folder)
    room.scene("scene")
    (room.folder / file).write_text("old")
    assert main(words.split()) == 1
    assert "is there already; choose another --out, or replace it" in capsys.readouterr().err
    assert (room.folder / file).read_text() == "old"
    assert main([*words.split(), "--overwrite"]) == 0
    assert (room.folder / file).read_text() != "old"
