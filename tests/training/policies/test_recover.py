import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpilot.diagrams.flight.simulation import fly
from splatpilot.systems.common.config import load_config
from splatpilot.systems.policies.checkpoint import checkpoint_policy
from splatpilot.training.corpus.corpus import EXPERT, RECOVERY, Corpus
from splatpilot.training.policies import recover as recovery
from splatpilot.training.policies.train_diffaero_rgb import DiffAeroRgbTrainer, DiffAeroRgbTraining
from splatpilot.training.policies.train_student import (
    StudentData,
    StudentDepthTraining,
    StudentTrainer,
)

TINY = ["pretrained=false", "frozen=0", "held_out=0.5", "batch=2"]
TINY += ["schedule.updates=2", "schedule.checkpoint_every=2"]


@pytest.fixture(scope="module")
def expert(collected, tmp_path_factory) -> Path:
    """The folder of a copy of the corpus of two worlds."""
    return shutil.copytree(collected.folder, tmp_path_factory.mktemp("expert") / "corpus")


def configure(corpus: Path | str) -> StudentDepthTraining:
    return load_config(StudentDepthTraining(), overrides=[f"corpora=[{corpus}]", *TINY])


def both_stages(expert: Path, out: Path, flights: int = 1) -> dict:
    config, make = configure(expert), StudentTrainer
    return recovery.run(config=config, make=make, out=out, flights=flights, jobs=1)


@pytest.fixture(scope="module")
def recovered(expert, tmp_path_factory) -> Path:
    """The folder of both stages."""
    out = tmp_path_factory.mktemp("recovered")
    both_stages(expert, out)
    return out


def test_student_flies_and_trains_again_with_recovery_samples(expert, recovered):
    ledger = json.loads((recovered / "recovery.json").read_text())
    corpus = Corpus(recovered / "corpora" / "0")
    samples = corpus.samples(np.arange(len(corpus)))
    assert ledger["expert_samples"] == (samples.source == EXPERT).sum() == len(Corpus(expert))
    assert ledger["recovery_samples"] == (samples.source == RECOVERY).sum() > 0
    assert sum(ledger["flights"].values()) == 1 <= ledger["near_misses"]
    assert len(set(samples.world[samples.source == RECOVERY])) == 1
    assert len(list((recovered / "flights" / "0").iterdir())) == 1


def interrupt(*_args) -> None:
    raise KeyboardInterrupt


def test_interrupted_and_damaged_runs_are_completed(
    expert, recovered, tmp_path, monkeypatch, capsys
):
    def complete() -> dict:
        ledger = both_stages(expert, tmp_path)
        for stage in ("stage_1", "stage_2"):
            del ledger[stage]["cpu_minutes"]
        with np.load(tmp_path / file) as found, np.load(recovered / file) as expected:
            for name in set(expected.files) - {"about"}:
                np.testing.assert_array_equal(found[name], expected[name])
        return ledger

    file = Path("stage_2/student_depth.npz")
    before = {path: path.stat().st_mtime_ns for path in expert.rglob("*")}
    for module, step in ((recovery, "_fly_world"), (recovery, "_count")):
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(module, step, interrupt)
            both_stages(expert, tmp_path)
    with pytest.raises(ValueError, match=r"recovery.yaml holds another configuration"):
        both_stages(expert, tmp_path, flights=2)
    with monkeypatch.context() as patch:
        patch.setattr(recovery, "_fly_world", interrupt)  # which has been done
        ledger = complete()
    expected = json.loads((recovered / "recovery.json").read_text())
    for stage in ("stage_1", "stage_2"):
        del expected[stage]["cpu_minutes"]
    assert ledger == expected
    assert {path: path.stat().st_mtime_ns for path in expert.rglob("*")} == before

    [flights] = (tmp_path / "flights" / "0").iterdir()
    flights.write_bytes(flights.read_bytes()[:-50])
    lost = sorted((tmp_path / "corpora" / "0" / "shards").glob("expert-*"))[0]
    shutil.rmtree(lost)
    assert complete() == ledger
    assert lost.exists() and "flown again" in capsys.readouterr().err
    about = expert / "shards" / lost.name / "shard.json"
    text = about.read_text()
    about.write_text(text.replace('"revision": "', '"revision": "0'))
    with pytest.raises(ValueError, match=r"learned from other files|has changed since"):
        both_stages(expert, tmp_path)
    about.write_text(text)


@pytest.fixture
def flown(monkeypatch) -> list:
    """The policies that have flown."""
    flown = []

    def watched(diagram):
        flown.append(diagram.GetSubsystemByName("monitor").scenario.policy)
        return fly(diagram)

    monkeypatch.setattr(recovery, "fly", watched)
    return flown


def test_next_round_is_flown_by_the_weights_of_the_last(expert, recovered, tmp_path, flown):
    corpus, out = recovered / "corpora" / "0", tmp_path / "second"
    flown_by = str(recovered / "stage_2" / "student_depth.npz")
    round_of = {"config": configure(corpus), "make": StudentTrainer, "out": out}
    round_of |= {"flights": 1, "jobs": 1, "flown_by": flown_by}
    ledger = recovery.run(**round_of)
    assert [(policy.weights, policy.camera.width) for policy in flown] == [(flown_by, 32)]
    assert ledger["flown_by"] == flown_by and not (out / "stage_1").exists()
    before = Corpus(corpus)
    earlier = (before.samples(np.arange(len(before))).source == RECOVERY).sum()
    assert ledger["recovery_samples"] > earlier > 0
    new = {"out": tmp_path / "third"}
    for change, message in (
        ({"flown_by": ""}, r"recovery.yaml holds another configuration"),
        ({"config": configure(expert)}, r"holds another configuration, with .*/corpora/0"),
        (new | {"config": configure("nowhere")}, "nowhere holds no corpus"),
        (new | {"flown_by": "unknown"}, "unknown"),
        (new | {"flights": 0}, r"--flights .* got 0"),
        (new | {"jobs": -1}, r"--jobs .* got -1"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            recovery.run(**round_of | change)
    assert not (tmp_path / "third").exists()


def test_recovery_share_is_the_fraction_of_recovery_samples(expert, recovered):
    data, plain = (
        StudentData([Corpus(folder)], 0.5) for folder in (recovered / "corpora" / "0", expert)
    )
    generator = torch.Generator().manual_seed(0)
    natural = len(data.recovered) / len(data.training)
    assert 0.0 < natural < 1.0
    for share, fraction in ((0.0, natural), (0.25, 0.25), (0.8, 0.8), (1.0, 1.0)):
        drawn = data.draw(4000, generator, share)
        assert set(drawn) <= set(data.training)
        assert np.isin(drawn, data.recovered).mean() == pytest.approx(fraction, abs=0.03)
    assert set(plain.draw(4000, generator, 0.5)) == set(plain.training)


def test_rgb_policy_recovers_too(wide_corpus, tmp_path, flown):
    tiny = [setting for setting in TINY if not setting.startswith(("pretrained", "frozen"))]
    overrides = [f"corpora=[{wide_corpus}]", *tiny]
    config = load_config(DiffAeroRgbTraining(), overrides=overrides)
    out = tmp_path / "out"
    ledger = recovery.run(config=config, make=DiffAeroRgbTrainer, out=out, flights=1, jobs=1)
    assert sum(ledger["flights"].values()) == 1 and ledger["recovery_samples"] > 0
    assert [policy.speed for policy in flown] == [2.0]
    assert checkpoint_policy(out / "stage_2" / "diffaero_rgb.npz") == "diffaero_rgb"
