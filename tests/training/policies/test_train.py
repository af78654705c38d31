import csv
import json
import os
import re
import shutil
import sys
import zipfile
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_trainer import TinyTrainer, TinyTraining

from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.progress import CheckpointClock
from splatpilot.systems.common.provenance import TRAINING_SEEDS
from splatpilot.systems.policies import checkpoint as policy_checkpoint
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint, checkpoint_policy
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.training.policies import train, training_worlds
from splatpilot.training.policies.rollouts import evaluate_agent
from splatpilot.training.policies.train import TRAINERS, run
from splatpilot.training.policies.train_diffaero import DiffAeroLearner, DiffAeroTraining
from splatpilot.training.policies.training_worlds import WorldCache

CARDS = sorted((Path(policy_checkpoint.__file__).parent / "weights").glob("*.md"))

SMALL = ["worlds.kinds=[P10]", "worlds.count=1", "worlds.held_out=1", "worlds.voxel_size=0.5"]
SMALL += ["schedule.updates=6", "schedule.validate_every=3", "schedule.checkpoint_every=2"]
SMALL += ["validation.patience=0.1"]
FEW = ["rollout.environments=4", "rollout.steps=4"]
OF_POLICY = {
    "diffaero": FEW,
    "depthnav": [*FEW, "empty=0.5", "rollout.noise.latency=0.1"],
    "distilled_rgb": ["rollout.environments=2", "rollout.steps=2"],
    "agile_autonomy": ["rounds=2", "round_updates=3", "environments=4", "steps=16", "batch=8"],
}


def read_network(out: Path) -> dict[str, torch.Tensor]:
    return torch.load(out / "checkpoint.pt", weights_only=True)["network"]


@pytest.mark.parametrize("policy", OF_POLICY)
def test_killed_training_ends_in_the_same_weights(policy, tmp_path):
    trainer_kind = TRAINERS.find(policy)
    config = load_config(trainer_kind.config(), overrides=[*SMALL, *OF_POLICY[policy]])
    whole, again = tmp_path / "whole", tmp_path / "again"

    def make(config):
        trainer = trainer_kind.make(config)
        begin_update = trainer.begin_update

        def copy_before(update: int) -> None:
            if update == 5:
                shutil.copytree(whole, again)  # as a kill leaves it
            begin_update(update)

        trainer.begin_update = copy_before
        return trainer

    run(config=config, out=whole, make=make)
    run(config=config, out=again, make=trainer_kind.make)
    for name, value in read_network(again).items():
        assert torch.equal(value, read_network(whole)[name])
    assert (again / "curves.csv").read_text() == (whole / "curves.csv").read_text()
    assert policy_named(str(whole / f"{policy}.npz")).rate > 0.0
    assert load_config(trainer_kind.config(), whole / "config.yaml") == config
    rows = list(csv.DictReader((whole / "curves.csv").open()))
    measured = {float(row["update"]): row["success"] != "" for row in rows}
    assert measured == {2.0: True, 3.0: True, 4.0: False, 6.0: True}


@pytest.mark.parametrize("card", CARDS, ids=lambda card: card.stem)
def test_model_cards_hold_configurations_that_train(card, tmp_path, monkeypatch):
    config = tmp_path / "config.yaml"
    config.write_text(re.search("```yaml\n(.*?)```", card.read_text(), re.DOTALL)[1])
    trainer = TRAINERS.find(checkpoint_policy(card.with_suffix(".npz")))
    made_with = load_config(trainer.config(), config)
    if scenes := getattr(getattr(made_with, "worlds", None), "scenes", ()):
        if "SPLATPILOT_DATA" not in os.environ:
            pytest.skip("SPLATPILOT_DATA is not set")
        monkeypatch.chdir(os.environ["SPLATPILOT_DATA"])
        # Reconstructed scenes are not part of the data.
        made_with.worlds.scenes = [scene for scene in scenes if Path(scene).exists()]
    made_with.validate()


class FragileTrainer(TinyTrainer):
    def losses(self) -> dict[str, torch.Tensor]:
        assert torch.get_num_threads() == 1
        size = super().losses()["size"]
        return {"first": size, "second": size * (torch.nan if self.update >= 5 else 1.0)}


def test_loss_that_is_not_a_number_ends_a_run_which_keeps_weights_and_curves(tmp_path, monkeypatch):
    rows = []

    @contextmanager
    def event_log(folder):
        assert folder == str(tmp_path)
        try:
            yield lambda update, row: rows.append((update, row["success"]))
        finally:
            rows.append("closed")

    monkeypatch.setattr(train, "event_log", event_log)
    config = TinyTraining()
    config.schedule.tensorboard = True
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(ValueError, match="update 5: the term 'second' of the loss became nan"):
            run(config=config, out=tmp_path, make=FragileTrainer)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert rows == [(2, 0.5), (4, 0.5), "closed"]
    checkpoint = PolicyCheckpoint.load(tmp_path / "diffaero.npz", "diffaero", DIFFAERO_NETWORK)
    assert all(np.isfinite(value).all() for value in checkpoint.weights.values())
    assert checkpoint.provenance["best"]["update"] == 4
    assert torch.load(tmp_path / "checkpoint.pt", weights_only=True)["progress"]["update"] == 4


def test_training_seeds_are_not_those_of_the_benchmark(monkeypatch):
    asked: list[int] = []
    monkeypatch.setattr(training_worlds.library, "scenario_world", str)
    monkeypatch.setattr(WorldCache, "world", lambda self, config, seed: asked.append(seed))
    monkeypatch.setattr(training_worlds, "WorldBatch", lambda *_: None)
    selection = training_worlds.WorldSelection(count=1000, held_out=1000)
    for seed in (0, 1, 999):
        training_worlds.training_worlds(selection, seed)
    training_worlds.validation_worlds(selection)
    assert len(asked) == len(set(asked)) == 4000
    assert min(asked) >= TRAINING_SEEDS
    with pytest.raises(ValueError, match=r"seed must be .*, got 1000"):
        training_worlds.training_worlds(selection, 1000)


def interrupt() -> None:
    raise KeyboardInterrupt


class Interrupted(TinyTrainer):
    first: int | None = None

    def begin_update(self, update: int) -> None:
        if Interrupted.first is None:
            Interrupted.first = update
        if update == 5:
            interrupt()


def test_stopped_run_reports_its_checkpoint_and_resumes_there(tmp_path, monkeypatch, capsys):
    def stopped(out: str, make=Interrupted) -> str:
        with pytest.raises(KeyboardInterrupt) as ended:
            run(config=TinyTraining(), out=tmp_path / out, make=make)
        [note] = ended.value.__notes__
        return note.replace(str(tmp_path), "")

    none = stopped("none", make=lambda config: interrupt())
    assert none == "no update is in /none yet; the same command starts again"
    assert stopped("a") == "update 4 of 9 is in /a; the same command resumes there"
    monkeypatch.setattr(CheckpointClock, "is_due", True)
    stopped("by_time")
    capsys.readouterr()
    monkeypatch.setattr(Interrupted, "first", None)
    stopped("by_time")
    assert Interrupted.first == 5
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == f"resuming {tmp_path / 'by_time'} at update 5 of 9"


class Reader(TinyTrainer):
    learns_from = "one corpus"


def test_run_with_changed_inputs_is_not_resumed(tmp_path, monkeypatch):
    def refused(message: str) -> None:
        with pytest.raises(ValueError, match=message):
            run(config=TinyTraining(), out=tmp_path, make=Reader)

    with monkeypatch.context() as patch:
        patch.setattr(
            Reader, "begin_update", lambda self, update: interrupt() if update == 6 else None
        )
        with pytest.raises(KeyboardInterrupt):
            run(config=TinyTraining(), out=tmp_path, make=Reader)
    with monkeypatch.context() as patch:
        patch.setattr(train, "revision", lambda: "another")
        refused("revision of .*checkpoint.pt must be another, got .*; choose another --out")
    summary = run(config=TinyTraining(), out=tmp_path, make=Reader)
    curves = (tmp_path / "curves.csv").read_text()
    (tmp_path / "curves.csv").write_text(curves.splitlines()[0])
    assert run(config=TinyTraining(), out=tmp_path, make=Reader) == summary
    assert (tmp_path / "curves.csv").read_text() == curves
    with monkeypatch.context() as patch:
        patch.setattr(Reader, "learns_from", "another")
        refused("learned from other files: corpora, scenes, or the first weights")
    weights = (tmp_path / "diffaero.npz").rename(tmp_path / "weights")
    refused(r"No such file: .*diffaero\.npz, .* delete .*checkpoint")
    weights.rename(tmp_path / "diffaero.npz")
    with zipfile.ZipFile(tmp_path / "checkpoint.pt") as archive:
        largest = max(archive.infolist(), key=lambda entry: entry.file_size)
    content = bytearray((tmp_path / "checkpoint.pt").read_bytes())
    content[largest.header_offset + 500] ^= 1
    (tmp_path / "checkpoint.pt").write_bytes(content)
    refused(r"must be a checkpoint .*; delete .* to start again")


def test_run_with_an_invalid_input_leaves_its_folder_free(tmp_path):
    def refuse(config):
        raise ValueError("no corpus")

    other = TinyTraining(seed=1)
    with pytest.raises(ValueError, match="no corpus"):
        run(config=other, out=tmp_path, make=refuse)
    run(config=TinyTraining(), out=tmp_path, make=TinyTrainer)
    with pytest.raises(ValueError, match=r"another configuration, with seed: 0; choose"):
        run(config=other, out=tmp_path, make=TinyTrainer)


def test_miniature_learns_to_fly(tmp_path):
    overrides = [
        "worlds.kinds=[P01]",
        "worlds.count=3",
        "worlds.held_out=4",
        "validation.patience=4",
    ]
    overrides += ["rollout.environments=16", "rollout.steps=20", "worlds.voxel_size=0.5"]
    overrides += [f"schedule.{name}=45" for name in ("updates", "validate_every")]
    overrides.append("schedule.learning_rate=0.002")
    config = load_config(DiffAeroTraining(), overrides=overrides)
    held_out = training_worlds.validation_worlds(config.worlds)
    torch.manual_seed(0)
    untrained = DiffAeroLearner(config.loss)
    before = evaluate_agent(untrained, held_out, config.validation, config.rollout.noise)
    summary = run(config=config, out=tmp_path, make=TRAINERS.find("diffaero").make)
    assert before.metrics()["success"] == 0.0
    assert summary["best"]["success"] >= 0.5


PACKAGE = """
from tiny_trainer import TinyTrainer, TinyTraining

from splatpilot import register_trainer


class MeanTraining(TinyTraining):
    pass


register_trainer("mean", MeanTraining, TinyTrainer)
"""


def test_command_trains_seeds_by_the_trainer_of_another_package(tmp_path, monkeypatch):
    (tmp_path / "mean_package.py").write_text(PACKAGE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(TRAINERS, "_entries", dict(TRAINERS._entries))
    command = ["train", "mean_package:MeanTraining", "--out", str(tmp_path), "--seeds", "3", "4"]
    assert main([*command, "--set", "schedule.updates=5"]) == 0
    for seed in (3, 4):
        out = tmp_path / f"seed_{seed}"
        checkpoint = PolicyCheckpoint.load(out / "diffaero.npz", "diffaero", DIFFAERO_NETWORK)
        assert f"seed: {seed}" in checkpoint.provenance["config"]
        assert checkpoint.provenance["revision"]
        summary = json.loads((out / "summary.json").read_text())
        assert (summary["updates"], summary["seed"]) == (5, seed)
    sys.modules.pop("mean_package")


def test_policy_without_a_trainer_is_refused_with_the_known_ones(tmp_path, capsys):
    assert main(["train", "planner", "--out", str(tmp_path / "out")]) == 1
    message = capsys.readouterr().err
    assert "no trainer 'planner'" in message
    assert all(name in message for name in ("diffaero", "depthnav", "agile_autonomy"))
    assert not (tmp_path / "out").exists()
