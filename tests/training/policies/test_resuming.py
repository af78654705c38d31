"""What a run goes on from, and what it does not."""

import zipfile

import pytest
from tiny_trainer import TinyTrainer, TinyTraining

from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.progress import CheckpointClock
from splatpilot.training.policies.train import run
from splatpilot.training.policies.trainer_registry import TRAINERS


class Reader(TinyTrainer):
    """Says that it learns from a corpus."""

    learns_from = "one corpus"


class OtherReader(Reader):
    """Learns from something else."""

    learns_from = "another"


class Interrupted(TinyTrainer):
    """Is ended from outside in its sixth update, and tells with which it begins."""

    first: int | None = None

    def begin_update(self, update: int) -> None:
        if Interrupted.first is None:
            Interrupted.first = update
        if update == 5:
            raise KeyboardInterrupt


def test_an_ended_run_says_what_it_kept_and_resumes_there(tmp_path, monkeypatch, capsys):
    config = TinyTraining()
    with pytest.raises(KeyboardInterrupt) as ended:
        run(config=config, out=tmp_path / "at_updates", make=Interrupted)
    kept = f"update 4 of 9 is in {tmp_path / 'at_updates'}; the same command resumes there"
    assert ended.value.__notes__ == [kept]
    monkeypatch.setattr(CheckpointClock, "is_due", True)
    with pytest.raises(KeyboardInterrupt):
        run(config=config, out=tmp_path / "by_time", make=Interrupted)
    capsys.readouterr()
    monkeypatch.setattr(Interrupted, "first", None)
    with pytest.raises(KeyboardInterrupt):
        run(config=config, out=tmp_path / "by_time", make=Interrupted)
    assert Interrupted.first == 5
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == f"resuming {tmp_path / 'by_time'} at update 5 of 9"


def test_a_run_that_kept_nothing_says_so(tmp_path):
    def interrupted(config):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as ended:
        run(config=TinyTraining(), out=tmp_path, make=interrupted)
    [note] = ended.value.__notes__
    assert note == f"no update is in {tmp_path} yet; the same command starts again"


def test_a_run_goes_on_with_what_it_began_with_alone(tmp_path):
    """Files that the trainer learns from and that have changed since are refused, as are a flipped
    byte in the checkpoint and weights that are gone; curves that a kill left behind are mended."""

    config = TinyTraining()
    summary = run(config=config, out=tmp_path, make=Reader)
    curves = (tmp_path / "curves.csv").read_text()
    (tmp_path / "curves.csv").write_text(curves.splitlines()[0])
    assert run(config=config, out=tmp_path, make=Reader) == summary
    assert (tmp_path / "curves.csv").read_text() == curves
    with pytest.raises(ValueError, match="learned from other files: corpora, or the weights"):
        run(config=config, out=tmp_path, make=OtherReader)
    weights = (tmp_path / "diffaero.npz").read_bytes()
    (tmp_path / "diffaero.npz").unlink()
    with pytest.raises(ValueError, match=r"diffaero\.npz is missing, .* delete .*checkpoint"):
        run(config=config, out=tmp_path, make=Reader)
    (tmp_path / "diffaero.npz").write_bytes(weights)
    with zipfile.ZipFile(tmp_path / "checkpoint.pt") as archive:
        largest = max(archive.infolist(), key=lambda entry: entry.file_size)
    content = bytearray((tmp_path / "checkpoint.pt").read_bytes())
    content[largest.header_offset + 500] ^= 1
    (tmp_path / "checkpoint.pt").write_bytes(content)
    with pytest.raises(ValueError, match=r"no checkpoint to go on from .*; delete it to begin"):
        run(config=config, out=tmp_path, make=Reader)


def test_a_mistake_in_what_a_run_names_leaves_its_folder_free(student_corpus, tmp_path):
    """Put right, the same command works in the same folder."""
    trainer = TRAINERS.find("student_depth")
    tiny_student = ["pretrained=false", "frozen=0", "batch=2", "held_out=0.2"]
    tiny_student += ["schedule.updates=1", "schedule.checkpoint_every=1", "validation_samples=2"]
    wrong = load_config(trainer.config(), overrides=["corpora=[nowhere]", *tiny_student])
    with pytest.raises(FileNotFoundError, match="nowhere holds no corpus"):
        run(config=wrong, out=tmp_path / "out", make=trainer.make)
    right = load_config(trainer.config(), overrides=[f"corpora=[{student_corpus}]", *tiny_student])
    run(config=right, out=tmp_path / "out", make=trainer.make)
    with pytest.raises(ValueError, match=r"another configuration, with corpora: .*; choose"):
        run(config=wrong, out=tmp_path / "out", make=trainer.make)
