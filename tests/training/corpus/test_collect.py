import csv
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.seeds import TRAINING_SEEDS
from splatpilot.training.corpus import collect as make
from splatpilot.training.corpus.corpus import Corpus
from splatpilot.training.corpus.samples import EXPERT, OFF_PATH


def all_bytes(folder: Path) -> dict[str, bytes]:
    """Every file of a folder by its path in it."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_interrupted_and_run_again_leaves_the_same_bytes(small, gathered, tmp_path, monkeypatch):
    whole = all_bytes(gathered.shards[0].path.parents[1])
    write_shard = make.collect_world.__globals__["write_shard"]

    def killed(path, *args, **kwargs):
        (path.parent / f".{path.name}.1.partial").mkdir()
        raise KeyboardInterrupt

    make.run(config=small, out=tmp_path, worlds=1, jobs=1)
    monkeypatch.setitem(make.collect_world.__globals__, "write_shard", killed)
    with pytest.raises(KeyboardInterrupt):
        make.run(config=small, out=tmp_path, worlds=2, jobs=1)
    monkeypatch.setitem(make.collect_world.__globals__, "write_shard", write_shard)
    make.run(config=small, out=tmp_path, worlds=2, jobs=1)
    assert all_bytes(tmp_path) == whole


def test_what_is_damaged_is_gathered_again(small, gathered, tmp_path, monkeypatch):
    folder = gathered.shards[0].path.parents[1]
    out = shutil.copytree(folder, tmp_path / "corpus")
    asked = []
    gather = make.collect_world
    monkeypatch.setattr(make, "collect_world", lambda *a: (asked.append(a[2]), gather(*a)))
    make.run(config=small, out=out, worlds=2, jobs=1)
    assert asked == []
    depth = out / "shards" / gathered.shards[1].path.name / "depth.npy"
    depth.write_bytes(depth.read_bytes()[:-1])
    (out / "worlds" / gathered.worlds[0].name / "esdf.npz").unlink()
    make.run(config=small, out=out, worlds=2, jobs=1)
    assert asked == [0, 1]
    assert all_bytes(out) == all_bytes(folder)


def test_what_another_version_gathered_stays(small, gathered, tmp_path):
    out = shutil.copytree(gathered.shards[0].path.parents[1], tmp_path / "corpus")
    about = out / "shards" / gathered.shards[0].path.name / "shard.json"
    about.write_text(about.read_text().replace('"format_version": 2', '"format_version": 3'))
    before = all_bytes(out)
    with pytest.raises(ValueError, match="must be 2, got 3; use the version"):
        make.run(config=small, out=out, worlds=2, jobs=1)
    assert all_bytes(out) == before


def test_distances_that_are_damaged_are_recorded_again(small, gathered, tmp_path):
    folder = gathered.shards[0].path.parents[1]
    out = shutil.copytree(folder, tmp_path / "corpus")
    esdf = out / "worlds" / gathered.worlds[0].name / "esdf.npz"
    content = bytearray(esdf.read_bytes())
    content[len(content) // 2] ^= 1
    esdf.write_bytes(content)
    with pytest.raises(ValueError, match="esdf"):
        Corpus(out).verify()
    make.run(config=small, out=out, worlds=2, jobs=1)
    assert all_bytes(out) == all_bytes(folder)


def test_states_off_the_path_have_shards_of_their_own(small, gathered, tmp_path):
    config = replace(small, off_path=70)
    corpus = make.run(config=config, out=tmp_path, worlds=1, jobs=1)
    beside, shard = corpus.shards[1], corpus.shards[0]
    assert (shard.source, beside.source) == (EXPERT, OFF_PATH)
    np.testing.assert_array_equal(shard.arrays["depth"], gathered.shards[0].arrays["depth"])
    assert 35 <= len(beside) <= 70 and not np.isnan(beside.arrays["trajectories_B"][:, 0]).any()
    before = all_bytes(tmp_path)
    with (beside.path / "color.npy").open("r+b") as file:
        file.seek(5000)
        file.write(b"damage")
    make.run(config=config, out=tmp_path, worlds=1, jobs=1)
    assert all_bytes(tmp_path) == before
    rows = list(csv.DictReader((tmp_path / "ledger.csv").open()))
    assert [(row["source"], row["states"]) for row in rows][-1] == ("off_path", str(len(beside)))


def test_the_ledger_accounts_for_every_sample(gathered):
    folder = gathered.shards[0].path.parents[1]
    rows = list(csv.DictReader((folder / "ledger.csv").open()))
    assert len(rows) == 4
    assert 2 * sum(int(row["states"]) for row in rows) == len(gathered) > 0
    assert {int(row["seed"]) for row in rows} == {TRAINING_SEEDS, TRAINING_SEEDS + 1}
    assert all(row["outcome"] == "goal" and float(row["least_clearance_m"]) > 0 for row in rows)


def test_looks_differ_between_flights_of_one_world(gathered):
    shard = gathered.shards[0]
    first = 2 * shard.flights[0]["states"]
    means = [c.mean(axis=(0, 1, 2)) for c in np.split(shard.arrays["color"], [first])]
    assert np.abs(means[0] - means[1]).max() > 5


def test_worlds_that_cannot_be_flown_are_left_out(small, gathered, tmp_path, monkeypatch, capsys):
    def gather(folder, config, index, revision):
        if index == 0:
            raise InfeasibleFlightError("no way")
        shutil.copytree(gathered.shards[0].path.parents[1], folder, dirs_exist_ok=True)

    monkeypatch.setattr(make, "collect_world", gather)
    make.run(config=small, out=tmp_path, worlds=2, jobs=1)
    assert "world 0 is left out: no way" in "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("appearance=1.5", r"appearance must be in \[0, 1\], got 1.5"),
        ("flights=0", "flights must be .*, got 0"),
        ("seed=1000", "seed must be .* got 1000"),
        ("expert.period=0.8", "expert.period must be .*, got 0.8"),
        ("expert.policy=nobody", "no policy 'nobody'"),
        ("perturbation.distance=-1", "perturbation.distance must be .*, got -1"),
        ("perturbation.copies=-1", "perturbation.copies must be .*, got -1"),
        ("worlds.kinds=[R13]", "worlds.kinds must be of generated worlds, got R13"),
    ],
)
def test_values_out_of_range_are_named(small, tmp_path, override, message):
    config = load_config(small, overrides=[override])
    with pytest.raises(ValueError, match=message):
        make.run(config=config, out=tmp_path / "c", worlds=1)
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize("number", ["worlds", "jobs"])
def test_numbers_below_one_are_refused(small, tmp_path, number):
    with pytest.raises(ValueError, match=f"--{number} must be at least 1, got 0"):
        make.run(config=small, out=tmp_path, **{"worlds": 1, "jobs": 1} | {number: 0})


def test_another_program_adds_no_worlds(small, gathered, tmp_path, monkeypatch):
    out = shutil.copytree(gathered.folder, tmp_path / "corpus")
    before = all_bytes(out)
    monkeypatch.setattr(make, "revision", lambda: "another")
    assert len(make.run(config=small, out=out, worlds=2, jobs=1)) == len(gathered)
    depth = out / "shards" / gathered.shards[1].path.name / "depth.npy"
    content = depth.read_bytes()
    for wrong in (content, content[:-1]):
        depth.write_bytes(wrong)
        with pytest.raises(ValueError, match="must be that of the program, another, got"):
            make.run(config=small, out=out, worlds=2 + (wrong == content), jobs=1)
    depth.write_bytes(content)
    assert all_bytes(out) == before


def test_a_kind_that_has_changed_is_not_added_to(small, gathered, tmp_path):
    grove = tmp_path / "grove.yaml"
    grove.write_text(Path(small.worlds.kinds[0]).read_text())
    config = replace(small, worlds=replace(small.worlds, kinds=[str(grove)]))
    make.run(config=config, out=tmp_path / "corpus", worlds=1, jobs=1)
    grove.write_text("world: !ForestConfig {length: 11, width: 8, height: 4}\n")
    with pytest.raises(ValueError, match="grove-1000000 is a world of another definition"):
        make.run(config=config, out=tmp_path / "corpus", worlds=2, jobs=1)


def test_what_an_interruption_left_of_a_world_is_not_used(small, gathered, tmp_path):
    out = shutil.copytree(gathered.folder, tmp_path / "corpus")
    other, world = (record.path.name for record in gathered.worlds)
    shutil.rmtree(out / "shards" / gathered.shards[1].path.name)
    shutil.copy(out / "worlds" / other / "esdf.npz", out / "worlds" / world / "esdf.npz")
    make.run(config=small, out=out, worlds=2, jobs=1)
    assert all_bytes(out) == all_bytes(gathered.folder)


def test_another_corpus_is_not_added_to(small, gathered):
    folder = gathered.shards[0].path.parents[1]
    other = load_config(small, overrides=["flights=3"])
    with pytest.raises(ValueError, match="another configuration"):
        make.run(config=other, out=folder, worlds=1)
