"""Verbs that torchrun started several times."""

import pytest

from splatpilot.analysis.commands.main import main


@pytest.mark.parametrize(
    ("command", "what"),
    [
        ("train diffaero depthnav", "several trainings"),
        ("train student_rgb --fly P01", "--fly"),
        ("recover student_rgb", "recover"),
    ],
)
def test_commands_for_one_process_are_refused(command, what, monkeypatch, tmp_path, capsys):
    """What several processes would do several times, in each other's way, says so before it
    begins."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out" / "corpus" / "shards").mkdir(parents=True)
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "test")
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert main([*command.split(), "--out", "trained"]) == 1
    assert f"run {what} without torchrun" in capsys.readouterr().err
    assert not (tmp_path / "trained").exists()
