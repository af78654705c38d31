"""Several processes that train one policy."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatpilot.systems.common.config import load_config
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.student import StudentSpec
from splatpilot.training.policies.torchrun import (
    Processes,
    require_one_process,
    torchrun_processes,
)
from splatpilot.training.policies.train import run
from splatpilot.training.policies.trainer_registry import TRAINERS

PROGRAM = (
    "from splatpilot.analysis.commands.main import main; import sys; sys.exit(main(sys.argv[1:]))"
)


def fields(corpus: Path, *overrides: str) -> list[str]:
    schedule = ("updates=3", "validate_every=3", "checkpoint_every=1", "learning_rate=1e-5")
    return [
        *(f"corpora=[{corpus}]", "pretrained=false", "frozen=0", "held_out=0.2", "batch=6"),
        *(f"schedule.{value}" for value in schedule),
        *overrides,
    ]


def train_with_two(fields: list[str], out: Path) -> subprocess.CompletedProcess:
    launcher = ["torch.distributed.run", "--standalone", "--nproc-per-node", "2", "--no-python"]
    command = [sys.executable, "-m", *launcher, sys.executable, "-c", PROGRAM]
    sets = [argument for field in fields for argument in ("--set", field)]
    return subprocess.run(
        [*command, "train", "student_depth", "--out", str(out), *sets],
        capture_output=True,
        text=True,
    )


def test_two_processes_learn_what_one_does(student_corpus, tmp_path):
    """Three steps with halves of each batch are three steps with the whole: the same losses, votes
    and success, each written once; also where some images are seen in a mirror."""
    ended = train_with_two(fields(student_corpus, "mirrored=true"), tmp_path / "two")
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.count("weights in") == 1
    kind = TRAINERS.find("student_depth")
    config = load_config(kind.config(), overrides=fields(student_corpus, "mirrored=true"))
    run(config=config, out=tmp_path / "one", make=kind.make)
    curves = {}
    for name in ("one", "two"):
        path = tmp_path / name / "student_depth.npz"
        PolicyCheckpoint.load(str(path), "student_depth", StudentSpec)
        curves[name] = np.genfromtxt(tmp_path / name / "curves.csv", delimiter=",", names=True)
    assert len(curves["one"]) == 3
    for name in curves["one"].dtype.names:
        np.testing.assert_allclose(curves["two"][name], curves["one"][name], rtol=1e-4)


def test_parts_that_are_not_equal_are_refused(student_corpus, tmp_path):
    """Five samples have no halves."""
    ended = train_with_two(fields(student_corpus, "batch=5"), tmp_path / "odd")
    assert ended.returncode != 0
    assert "batch is 5, of which 2 processes cannot have equal parts" in ended.stderr


def test_what_cannot_be_shared_is_refused(monkeypatch):
    """A trainer whose batches have no parts, and one certain GPU for all."""
    diffaero = TRAINERS.find("diffaero")
    trainer = diffaero.make(load_config(diffaero.config(), overrides=["worlds.count=1"]))
    Processes().share_batches(trainer)
    with pytest.raises(ValueError, match="2 processes, but diffaero learns in one alone"):
        Processes(1, 2).share_batches(trainer)
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "test")
    with (
        pytest.raises(ValueError, match="device is 'cuda:1', one GPU for all"),
        torchrun_processes("cuda:1"),
    ):
        pass


def test_what_is_for_one_process_is_refused_to_several(monkeypatch):
    """One process may, of torchrun's too; several are told how to."""
    require_one_process("recover")
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "test")
    monkeypatch.setenv("WORLD_SIZE", "1")
    require_one_process("recover")
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(ValueError, match=r"started 2 processes, .*; run recover without torchrun"):
        require_one_process("recover")
