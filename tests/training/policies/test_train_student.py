import csv
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpilot.diagrams.worlds import splits
from splatpilot.diagrams.worlds.inserted import InsertedConfig
from splatpilot.systems.common.config import load_config
from splatpilot.systems.policies.student import StudentSpec
from splatpilot.systems.vehicle.state import rotation_matrices
from splatpilot.training.corpus.corpus import Corpus
from splatpilot.training.policies.networks import StudentModule
from splatpilot.training.policies.train import TRAINERS, run
from splatpilot.training.policies.train_student import (
    FrozenFeatures,
    StudentData,
    StudentTraining,
    cost_targets,
    encode_images,
    held_out_worlds,
    hypothesis_errors,
    imitation_terms,
    missing_clearances,
    penalties,
    rank,
)

HELD_OUT = 0.05  # which holds out the second of three worlds


@pytest.fixture(scope="module")
def two(student_corpus, tmp_path_factory) -> list[Corpus]:
    """The corpus of three worlds, and a copy without the samples of the last."""
    part = tmp_path_factory.mktemp("part") / "corpus"
    shutil.copytree(student_corpus, part)
    shutil.rmtree(part / "shards" / "expert-grove-1000002")
    return [Corpus(student_corpus), Corpus(part)]


def test_worlds_stay_held_out_as_corpora_grow(two):
    alone, joined = StudentData(two[1:], HELD_OUT), StudentData(two[::-1], HELD_OUT)
    assert alone.held_out_worlds == joined.held_out_worlds and len(alone.held_out_worlds) == 1
    for data, corpus in ((alone, two[1]), (joined, two[0])):
        assert sorted([*data.training, *data.held_out]) == list(range(len(corpus)))
        outside = {data.worlds[w] for w in data.labels(data.held_out).world}
        inside = {data.worlds[w] for w in data.labels(data.training).world}
        assert outside == set(data.held_out_worlds) and not outside & inside


def test_samples_keep_their_order_and_world(two):
    data = StudentData(two[::-1], HELD_OUT)
    shared = len(two[1])
    numbers = np.array([shared + 12, 3, shared - 1, shared, 5, len(two[0]) - 1])
    depth, color = data.pixels(numbers, "depth"), data.pixels(numbers, "color")
    labels = data.labels(numbers)
    for row, number in enumerate(numbers):
        corpus = two[int(number < shared)]
        one = corpus.samples(np.array([number]))
        np.testing.assert_array_equal(depth[row], one.depth[0])
        np.testing.assert_array_equal(color[row], one.color[0])
        np.testing.assert_array_equal(labels.trajectories_B[row], one.trajectories_B[0])
        np.testing.assert_array_equal(labels.goal_B[row], one.goal_B[0])
        assert data.worlds[labels.world[row]] == corpus.worlds[one.world[0]].name


def test_distances_along_trajectories_are_those_of_the_world_and_change_as_waypoints_do(two):
    data = StudentData(two, HELD_OUT)
    labels = data.labels(np.arange(0, 72, 5))
    found = data.distance_along(labels.trajectories_B, labels)
    fields = {world.name: world.esdf.conservative() for world in two[0].worlds}
    R_WB, p_WB = rotation_matrices(labels.X_WB[:, :4]), labels.X_WB[:, None, 4:]
    for n, world in enumerate(labels.world):
        points_W = (labels.trajectories_B[n] @ R_WB[n].mT + p_WB[n]).double().numpy()
        expected = fields[data.worlds[world]].distance(points_W)
        np.testing.assert_allclose(found[n], expected, atol=2e-4)

    waypoints = labels.trajectories_B.nan_to_num().requires_grad_()
    data.distance_along(waypoints, labels).sum().backward()
    gradient = waypoints.grad
    assert gradient is not None and gradient.norm(dim=-1).median() > 0.5
    moved = (waypoints.detach() + step * gradient for step in (1e-3, -1e-3))
    ahead, behind = (data.distance_along(each, labels) for each in moved)
    expected = 2e-3 * gradient.square().sum(-1)
    assert ((ahead - behind - expected).abs() < 2e-5).float().mean() > 0.9


def test_corpora_of_test_scenes_or_for_validation_are_refused(two, monkeypatch):
    def refused(changed, name: str, value, message: str) -> None:
        monkeypatch.setattr(changed, name, value)
        with pytest.raises(ValueError, match=message):
            StudentData(two, 0.3)

    monkeypatch.setattr(splits, "load_test_sources", lambda: {"hospital": ["0123456789abcdef"]})
    source = two[0].worlds[0].source
    refused(source, "world", InsertedConfig(path="corridor"), "missing source_digest")
    refused(source, "source_digest", ["0123456789abcdef"], "shows hospital, in which")
    refused(two[0].config.worlds, "held_out", True, "must be a corpus to train with, got one of")


def test_worlds_of_one_scene_are_on_one_side(two, monkeypatch):
    records = {record.name: record for record in two[0].worlds}
    first, second, _ = records
    sides = [held_out_worlds(records, fraction) for fraction in np.linspace(0.0, 1.0, 50)]
    assert any((first in held_out) != (second in held_out) for held_out in sides)
    for name in (first, second):
        monkeypatch.setattr(records[name].source, "source_digest", ["0123456789abcdef"])
    sides = [held_out_worlds(records, fraction) for fraction in np.linspace(0.0, 1.0, 50)]
    assert all((first in held_out) == (second in held_out) for held_out in sides)
    assert {len(held_out) for held_out in sides} == {0, 1, 3}


def test_ranks_of_names_are_uniform():
    ranks = np.array([rank(f"P{k % 12:02}-{k}") for k in range(1_000_000, 1_000_800)])
    assert 0.0 <= ranks.min() and ranks.max() <= 1.0
    assert np.histogram(ranks, 10, (0.0, 1.0))[0] == pytest.approx([80] * 10, abs=25)
    assert rank("P04-1000000") == ranks[0]


def test_corpora_that_differ_or_hold_out_too_many_or_few_worlds_are_refused(two, tmp_path):
    other = Corpus(shutil.copytree(two[0].folder, tmp_path / "corpus"))
    assert StudentData([two[0], other], HELD_OUT).worlds == [w.name for w in two[0].worlds]
    record, config = other.worlds[1], two[0].config
    esdf = record.esdf
    replace(esdf, distances=esdf.distances + 0.5).save(record.path / "esdf.npz")
    wide = Corpus(two[1].folder)
    wide.config = replace(config, camera=replace(config.camera, fov_x=100.0))
    for corpora, held_out, message in (
        ([two[0], Corpus(other.folder)], HELD_OUT, r"grove-1000001 and .*grove-1000001 are diff"),
        ([two[0], wide], HELD_OUT, "cameras of the corpora must be equal"),
        (two[:1], 0.005, r"0 of 3 worlds are held out, .* set held_out to 0\.01"),
        (two[:1], 1.0, "3 of 3 worlds are held out, which leaves 0 samples"),
    ):
        with pytest.raises(ValueError, match=message):
            StudentData(corpora, held_out)


FROZEN = 7


def test_features_are_computed_once_for_the_same_weights(student_corpus, tmp_path):
    torch.manual_seed(0)
    network = StudentModule(StudentSpec("depth", 32, 24))
    data = StudentData([Corpus(student_corpus)], HELD_OUT)
    indices = np.concatenate([data.held_out[[3, 0]], data.training[[5, 30]]])
    features = FrozenFeatures(tmp_path, data, network, FROZEN)(indices)
    with torch.no_grad():
        expected = network.features[:FROZEN](
            encode_images(torch.from_numpy(data.pixels(indices, "depth")).float())
        )
    torch.testing.assert_close(features, expected, atol=4e-3, rtol=4e-3)
    made = {file: (file.stat().st_mtime_ns, file.read_bytes()) for file in tmp_path.iterdir()}
    assert len(made) == len(data.shards)
    lost = min(made)
    content = made[lost][1]
    for damaged in (None, b"", b"junk", content[:-100]):
        lost.unlink() if damaged is None else lost.write_bytes(damaged)
        again = FrozenFeatures(tmp_path, data, network, FROZEN)(indices)
        torch.testing.assert_close(again, features, atol=0, rtol=0)
        for file, (time, content) in made.items():
            assert file.read_bytes() == content
            assert (file == lost) != (file.stat().st_mtime_ns == time)
    with torch.no_grad():
        network.features[0][0].weight[0, 0, 0, 0] += 1.0
    FrozenFeatures(tmp_path, data, network, FROZEN)
    assert len(list(tmp_path.iterdir())) == 2 * len(made)


OVERRIDES = ["pretrained=false", "frozen=0", "held_out=0.05", "batch=8", "schedule.updates=25"]
OVERRIDES += ["schedule.validate_every=25", "schedule.checkpoint_every=5"]
OVERRIDES += ["schedule.learning_rate=0.002"]
ONE_STEP = [f"schedule.{name}=1" for name in ("updates", "validate_every", "checkpoint_every")]


def configure(corpus: Path, observation: str, *overrides: str) -> StudentTraining:
    config = TRAINERS.find(f"student_{observation}").config()
    return load_config(config, overrides=[f"corpora=[{corpus}]", *OVERRIDES, *overrides])


def train(config: StudentTraining, out: Path) -> dict[str, np.ndarray]:
    """Trains a student and returns its weights."""
    name = f"student_{config.observation}"
    run(config=config, out=out, make=TRAINERS.find(name).make)
    with np.load(out / f"{name}.npz") as file:
        return {key: file[key] for key in file.files if key != "about"}


def curves(out: Path) -> list[dict[str, float]]:
    rows = csv.DictReader((out / "curves.csv").open())
    return [{name: float(value) for name, value in row.items() if value} for row in rows]


@pytest.fixture(scope="module")
def trained(student_corpus, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("trained")
    train(configure(student_corpus, "depth"), out)
    return out


def straight(*ends) -> torch.Tensor:
    """(1, n, 10, 3) [m] straight paths to these ends."""
    along = torch.linspace(0.1, 1.0, 10, dtype=torch.float64)[:, None]
    return torch.stack([along * torch.tensor(end, dtype=torch.float64) for end in ends])[None]


def test_the_closest_takes_nearly_all_of_the_pull():
    waypoints = straight((2, 0.1, 0), (2, 1, 0), (0, 0, 2))
    closest, others = imitation_terms(hypothesis_errors(straight((2, 0, 0))[:, 0], waypoints), 0.05)
    mean_square = sum((k / 10) ** 2 for k in range(1, 11)) / 10
    assert closest.item() == pytest.approx(0.95 * 10 / 3 * mean_square * 0.1**2)
    assert others.item() == pytest.approx(0.025 * 10 / 3 * mean_square * (1**2 + 8))


def test_cost_targets_are_those_of_equation_4():
    distances = torch.tensor([[[1.354] * 10, [100.0] * 10]], dtype=torch.float64)
    errors = torch.tensor([[0.3, 0.1]], dtype=torch.float64)
    found = penalties(errors, distances)
    assert found[0].tolist() == pytest.approx([0.3 + math.log(2.0) / 4.0, 0.1])
    targets = cost_targets(found)
    assert targets[0].tolist() == pytest.approx((found / found.mean())[0].tolist(), rel=1e-5)
    assert cost_targets(torch.zeros(1, 3)).tolist() == [[0.0, 0.0, 0.0]]


def test_missing_clearance_counts_up_to_the_cap():
    distances = torch.tensor([0.3, 0.9], dtype=torch.float64)[:, None].expand(2, 2, 10)
    expert = torch.tensor([0.5, 3.0], dtype=torch.float64)[:, None].expand(2, 10)
    found = missing_clearances(distances, expert)
    assert found[:, 0].tolist() == pytest.approx([10 / 3 * 0.2**2, 10 / 3 * 0.5**2])
    assert found[:, 1].tolist() == [0.0, 0.0]


def test_student_learns(trained):
    curve = curves(trained)
    assert curve[-1]["winners"] < 0.9 * curve[0]["winners"]
    votes = [[row[f"votes_{m}"] for m in range(3)] for row in curve]
    np.testing.assert_allclose(np.sum(votes, axis=1), 1.0, atol=1e-5)
    terms = sum(curve[-1][name] for name in ("winners", "unvoted", "cost", "clearance"))
    assert curve[-1]["loss"] == pytest.approx(terms, rel=1e-5)
    best = max(row["success"] for row in curve if "success" in row)
    assert f"| success | {best:.2f} |" in (trained / "student_depth.md").read_text()


def test_frozen_modules_keep_their_weights_and_train_as_images_do(
    trained, student_corpus, tmp_path
):
    began, features, losses = trained / "student_depth.npz", tmp_path / "features", []
    for frozen, trainable in ((0, ["features."]), (18, ["features.18."]), (20, [])):
        overrides = [f"begin={began}", f"frozen={frozen}", f"features={features}", *ONE_STEP]
        out = tmp_path / str(frozen)
        after = train(configure(student_corpus, "depth", *overrides), out)
        cells = ["cell_layer."] if frozen < 20 else []
        with np.load(began) as before:
            for name, values in after.items():
                free = name.startswith((*trainable, *cells, "state_", "hidden_", "head."))
                assert np.array_equal(before[name], values) != free, name
        losses.append(curves(out)[0]["loss"])
    assert losses == pytest.approx([losses[0]] * 3, rel=2e-3)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("corpora=[]", r"corpora must be one folder"),
        ("held_out=1", r"held_out must be in \[0, 0\.9\], got 1\.0"),
        ("frozen=21", r"frozen must be in \[0, 20\], got 21"),
        ("frozen=20", "frozen must be at most 0 without `begin`"),
        ("noise.latency=0.1", r"noise\.latency must be left out, got 0\.1"),
        ("noise.color_noise=2", r"noise\.color_noise must be in \[0, 1\], got 2"),
        ("appearance.hue=200", r"appearance\.hue must be in \[0, 180\] deg, got 200"),
        ("seed=-1", r"seed must be in .*, got -1"),
        ("corpora=[absent]", r"absent holds no corpus"),
        ("schedule.updates=0", r"schedule\.updates must be in \[1, inf\), got 0"),
        ("pretrained=true frozen=7 noise.color_noise=0.1", "frozen must be 0 with noise or app"),
        ("pretrained=true frozen=7 appearance.hue=10", "frozen must be 0 with noise or appearance"),
        ("depth appearance.hue=10", "appearance must be left out"),
    ],
)
def test_configurations_out_of_range_are_refused(override, message, student_corpus, tmp_path):
    observation = "depth" if override.startswith("depth ") else "rgb"
    config = configure(student_corpus, observation, *override.removeprefix("depth ").split())
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        train(config, tmp_path)


def test_gradients_are_those_of_finite_differences():
    def random(seed: int, *shape: int) -> torch.Tensor:
        return torch.from_numpy(np.random.default_rng(seed).normal(size=shape))

    expert, waypoints = random(0, 2, 3, 3), random(1, 2, 3, 3, 3).requires_grad_()
    distances = (1.0 + 0.3 * random(2, 2, 3, 3)).requires_grad_()
    check, kept = torch.autograd.gradcheck, 0.8 + 0.3 * random(5, 2, 3)
    assert check(lambda w: imitation_terms(hypothesis_errors(expert, w), 0.05), waypoints)
    assert check(lambda d: missing_clearances(d, kept), distances)
    assert check(lambda w, d: penalties(hypothesis_errors(expert, w), d), (waypoints, distances))
