import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpilot.diagrams.flight.simulation import fly
from splatpilot.systems.common.config import load_config
from splatpilot.systems.policies.checkpoint import checkpoint_policy
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.training.corpus import collect
from splatpilot.training.corpus.corpus import Corpus, CorpusConfig
from splatpilot.training.corpus.expert import ExpertConfig
from splatpilot.training.corpus.library import LibraryConfig
from splatpilot.training.corpus.samples import EXPERT, RECOVERY
from splatpilot.training.policies import recover as recovery
from splatpilot.training.policies.student_data import StudentData
from splatpilot.training.policies.train_diffaero_rgb import DiffAeroRgbTrainer, DiffAeroRgbTraining
from splatpilot.training.policies.train_student import StudentDepthTraining, StudentTrainer

TINY = [
    "pretrained=false",
    "frozen=0",
    "held_out=0.5",
    "batch=2",
    "schedule.updates=2",
    "schedule.checkpoint_every=2",
]


def collect_corpus(folder: Path, worlds: Path, camera: OnboardCamera) -> None:
    """Collects one short flight in each of two small forests."""
    grove = worlds / "grove.yaml"
    grove.write_text("world: !ForestConfig {length: 10, width: 8, height: 4}\n")
    config = CorpusConfig(
        worlds=LibraryConfig(kinds=[str(grove)]),
        expert=ExpertConfig(period=0.5, speed=1.5),
        flights=1,
        camera=camera,
    )
    collect.run(config=config, out=folder, worlds=2, jobs=1)


@pytest.fixture(scope="module")
def expert(tmp_path_factory) -> Path:
    """The folder of a corpus in depth and colors for students."""
    folder = tmp_path_factory.mktemp("expert")
    collect_corpus(folder, tmp_path_factory.mktemp("worlds"), OnboardCamera(width=32, height=24))
    return folder


def both_stages(expert: Path, out: Path) -> dict:
    config = load_config(StudentDepthTraining(), overrides=[f"corpora=[{expert}]", *TINY])
    return recovery.run(config=config, make=StudentTrainer, out=out, flights=1, jobs=1)


@pytest.fixture(scope="module")
def recovered(expert, tmp_path_factory) -> Path:
    """The folder of both stages."""
    out = tmp_path_factory.mktemp("recovered")
    both_stages(expert, out)
    return out


def weights(out: Path) -> dict[str, np.ndarray]:
    with np.load(out / "stage_2" / "student_depth.npz") as file:
        return {name: file[name] for name in file.files if name != "about"}


def test_student_flies_and_trains_again_with_recovery_samples(
    expert, recovered, tmp_path, monkeypatch
):
    ledger = json.loads((recovered / "recovery.json").read_text())
    corpus = Corpus(recovered / "corpora" / "0")
    samples = corpus.samples(np.arange(len(corpus)))
    assert ledger["expert_samples"] == (samples.source == EXPERT).sum() == len(Corpus(expert))
    assert ledger["recovery_samples"] == (samples.source == RECOVERY).sum() > 0
    assert sum(ledger["flights"].values()) == 1 <= ledger["near_misses"]
    assert len(set(samples.world[samples.source == RECOVERY])) == 1
    assert len(list((recovered / "flights" / "0").iterdir())) == 1

    before = {path: path.stat().st_mtime_ns for path in expert.rglob("*")}
    for module, step in ((recovery, "_fly_world"), (recovery, "_count")):
        with monkeypatch.context() as patch:
            patch.setattr(module, step, interrupt)
            with pytest.raises(KeyboardInterrupt):
                both_stages(expert, tmp_path)
    config = load_config(StudentDepthTraining(), overrides=[f"corpora=[{expert}]", *TINY])
    with pytest.raises(ValueError, match=r"recovery.yaml holds another configuration"):
        recovery.run(config=config, make=StudentTrainer, out=tmp_path, flights=2, jobs=1)
    monkeypatch.setattr(recovery, "_fly_world", interrupt)  # which has been done
    again = both_stages(expert, tmp_path)
    for each in (again["stage_1"], again["stage_2"], ledger["stage_1"], ledger["stage_2"]):
        del each["cpu_minutes"]
    assert again == ledger
    assert {path: path.stat().st_mtime_ns for path in expert.rglob("*")} == before
    expected, found = weights(recovered), weights(tmp_path)
    assert all(np.array_equal(found[name], value) for name, value in expected.items())


def test_next_round_is_flown_by_the_weights_of_the_last(expert, recovered, tmp_path, monkeypatch):
    flown = []

    def watched(diagram):
        flown.append(diagram.GetSubsystemByName("monitor").scenario.policy)
        return fly(diagram)

    monkeypatch.setattr(recovery, "fly", watched)
    corpus, out = recovered / "corpora" / "0", tmp_path / "second"
    flown_by = str(recovered / "stage_2" / "student_depth.npz")
    config = load_config(StudentDepthTraining(), overrides=[f"corpora=[{corpus}]", *TINY])
    round_of = {"config": config, "make": StudentTrainer, "out": out, "flights": 1, "jobs": 1}
    ledger = recovery.run(**round_of, flown_by=flown_by)
    assert [(policy.weights, policy.camera.width) for policy in flown] == [(flown_by, 32)]
    assert ledger["flown_by"] == flown_by and not (out / "stage_1").exists()
    before = Corpus(corpus)
    earlier = (before.samples(np.arange(len(before))).source == RECOVERY).sum()
    assert ledger["recovery_samples"] > earlier > 0
    with pytest.raises(ValueError, match=r"recovery.yaml holds another configuration"):
        recovery.run(**round_of)
    others = load_config(StudentDepthTraining(), overrides=[f"corpora=[{expert}]", *TINY])
    with pytest.raises(ValueError, match=r"holds another configuration, with .*/corpora/0"):
        recovery.run(**round_of | {"config": others}, flown_by=flown_by)
    with pytest.raises(FileNotFoundError, match="nowhere holds no corpus"):
        nowhere = load_config(StudentDepthTraining(), overrides=["corpora=[nowhere]", *TINY])
        recovery.run(
            **round_of | {"config": nowhere, "out": tmp_path / "fourth"}, flown_by=flown_by
        )
    assert not (tmp_path / "fourth").exists()
    with pytest.raises(ValueError, match="unknown"):
        recovery.run(**round_of | {"out": tmp_path / "third"}, flown_by="unknown")
    assert not (tmp_path / "third").exists()


def test_lost_and_damaged_files_are_made_again(expert, tmp_path, capsys):
    source = tmp_path / "source"
    shutil.copytree(expert, source)
    ledger = both_stages(source, tmp_path / "out")
    expected = weights(tmp_path / "out")
    [flights] = (tmp_path / "out" / "flights" / "0").iterdir()
    flights.write_bytes(flights.read_bytes()[:-50])
    lost = sorted((tmp_path / "out" / "corpora" / "0" / "shards").glob("expert-*"))[0]
    shutil.rmtree(lost)
    assert both_stages(source, tmp_path / "out") == ledger
    assert lost.exists() and "flown again" in capsys.readouterr().err
    assert all(np.array_equal(expected[k], v) for k, v in weights(tmp_path / "out").items())
    about = source / "shards" / lost.name / "shard.json"
    about.write_text(about.read_text().replace('"revision": "', '"revision": "0'))
    with pytest.raises(ValueError, match=r"learned from other files|has changed since"):
        both_stages(source, tmp_path / "out")


def test_recovery_share_is_the_fraction_of_recovery_samples(expert, recovered):
    data = StudentData([Corpus(recovered / "corpora" / "0")], 0.5)
    generator = torch.Generator().manual_seed(0)
    natural = len(data.recovered) / len(data.training)
    assert 0.0 < natural < 1.0
    for share, part in ((0.0, natural), (0.25, 0.25), (0.8, 0.8), (1.0, 1.0)):
        drawn = data.draw(4000, generator, share)
        assert set(drawn) <= set(data.training)
        assert np.isin(drawn, data.recovered).mean() == pytest.approx(part, abs=0.03)
    plain = StudentData([Corpus(expert)], 0.5)
    assert set(plain.draw(4000, generator, 0.5)) == set(plain.training)


def test_rgb_policy_recovers_too(tmp_path, monkeypatch):
    speeds = []

    def watched(diagram):
        speeds.append(diagram.GetSubsystemByName("monitor").scenario.policy.speed)
        return fly(diagram)

    monkeypatch.setattr(recovery, "fly", watched)
    collect_corpus(tmp_path / "expert", tmp_path, OnboardCamera(width=160, height=90))
    tiny = [setting for setting in TINY if not setting.startswith(("pretrained", "frozen"))]
    overrides = [f"corpora=[{tmp_path / 'expert'}]", *tiny]
    config = load_config(DiffAeroRgbTraining(), overrides=overrides)
    out = tmp_path / "out"
    ledger = recovery.run(config=config, make=DiffAeroRgbTrainer, out=out, flights=1, jobs=1)
    assert sum(ledger["flights"].values()) == 1 and ledger["recovery_samples"] > 0
    assert speeds == [1.5]
    assert checkpoint_policy(out / "stage_2" / "diffaero_rgb.npz") == "diffaero_rgb"


def interrupt(*_args) -> None:
    raise KeyboardInterrupt


def test_counts_out_of_range_are_refused(expert, tmp_path):
    config = load_config(StudentDepthTraining(), overrides=[f"corpora=[{expert}]", *TINY])
    with pytest.raises(ValueError, match=r"--flights .* got 0"):
        recovery.run(config=config, make=StudentTrainer, out=tmp_path, flights=0, jobs=1)
    with pytest.raises(ValueError, match=r"--jobs .* got -1"):
        recovery.run(config=config, make=StudentTrainer, out=tmp_path, flights=1, jobs=-1)
    assert not list(tmp_path.iterdir())
