import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatpilot.diagrams.worlds import splits
from splatpilot.diagrams.worlds.inserted import InsertedConfig
from splatpilot.systems.policies.student import StudentSpec
from splatpilot.training.corpus.corpus import Corpus, CorpusConfig
from splatpilot.training.corpus.library import world_source
from splatpilot.training.policies.networks import StudentModule
from splatpilot.training.policies.student_data import (
    FrozenFeatures,
    StudentData,
    encode_images,
    held_out_worlds,
    is_held_out,
)

HELD_OUT = 0.2  # of three worlds, which holds out one


@pytest.fixture(scope="module")
def two(student_corpus, tmp_path_factory) -> list[Corpus]:
    """The corpus of 72 samples, and a copy without the 24 of one of its three worlds."""
    part = tmp_path_factory.mktemp("part") / "corpus"
    shutil.copytree(student_corpus, part)
    shutil.rmtree(part / "shards" / "expert-pillars-1")
    return [Corpus(student_corpus), Corpus(part)]


def test_worlds_stay_held_out_as_corpora_grow(two):
    alone, joined = StudentData(two[1:], HELD_OUT), StudentData(two[::-1], HELD_OUT)
    assert alone.held_out_worlds == joined.held_out_worlds and len(alone.held_out_worlds) == 1
    for data, count in ((alone, 48), (joined, 72)):
        assert sorted([*data.training, *data.held_out]) == list(range(count))
        outside = {data.worlds[w] for w in data.labels(data.held_out).world}
        inside = {data.worlds[w] for w in data.labels(data.training).world}
        assert outside == set(data.held_out_worlds) and not outside & inside


def test_samples_keep_their_order_and_world(two):
    data = StudentData(two[::-1], HELD_OUT)
    numbers = np.array([60, 3, 47, 48, 5, 71])
    depth, color = data.pixels(numbers, "depth"), data.pixels(numbers, "color")
    labels = data.labels(numbers)
    first = len(two[0].shards[0])
    for row, number in enumerate(numbers):
        corpus, within = (two[1], number) if number < 48 else (two[0], first + number - 48)
        one = corpus.samples(np.array([within]))
        np.testing.assert_array_equal(depth[row], one.depth[0])
        np.testing.assert_array_equal(color[row], one.color[0])
        np.testing.assert_array_equal(labels.trajectories_B[row], one.trajectories_B[0])
        np.testing.assert_array_equal(labels.goal_B[row], one.goal_B[0])
        assert data.worlds[labels.world[row]] == corpus.worlds[one.world[0]].name


def test_distances_along_trajectories_are_those_of_the_world(two):
    data = StudentData(two, HELD_OUT)
    labels = data.labels(np.arange(0, 72, 5))
    found = data.distance_along(labels.trajectories_B, labels)
    fields = {world.name: world.esdf.conservative() for world in two[0].worlds}
    for n, world in enumerate(labels.world):
        q_WB, p_WB = labels.X_WB[n, :4].double().numpy(), labels.X_WB[n, 4:].double().numpy()
        points_B = labels.trajectories_B[n].double().numpy()
        twice = 2.0 * np.cross(q_WB[1:], points_B)
        points_W = p_WB + points_B + q_WB[0] * twice + np.cross(q_WB[1:], twice)
        expected = fields[data.worlds[world]].distance(points_W)
        np.testing.assert_allclose(found[n], expected, atol=2e-4)


def test_distances_change_as_waypoints_do(two):
    data = StudentData(two, HELD_OUT)
    labels = data.labels(np.arange(0, 72, 5))
    waypoints = labels.trajectories_B.nan_to_num().requires_grad_()
    data.distance_along(waypoints, labels).sum().backward()
    gradient = waypoints.grad
    assert gradient is not None and gradient.norm(dim=-1).median() > 0.5
    with torch.no_grad():
        ahead, behind = (
            data.distance_along(waypoints + step * gradient, labels) for step in (1e-3, -1e-3)
        )
    expected = 2e-3 * gradient.square().sum(-1)
    assert ((ahead - behind - expected).abs() < 2e-5).float().mean() > 0.9


@pytest.mark.parametrize(
    ("digest", "message"),
    [([], "missing source_digest"), (["0123456789abcdef"], "shows hospital, in which")],
)
def test_corpora_of_test_scenes_are_refused(two, monkeypatch, digest, message):
    monkeypatch.setattr(splits, "load_test_sources", lambda: {"hospital": ["0123456789abcdef"]})
    source = two[0].worlds[0].source
    monkeypatch.setattr(source, "world", InsertedConfig(path="corridor"))
    monkeypatch.setattr(source, "source_digest", digest)
    with pytest.raises(ValueError, match=message):
        StudentData(two, 0.3)


def test_worlds_of_one_scene_are_on_one_side(two, monkeypatch):
    records = {record.name: record for record in two[0].worlds}
    assert 0 < len(held_out_worlds(records, HELD_OUT)) < len(records)
    for record in records.values():
        monkeypatch.setattr(record.source, "source_digest", ["0123456789abcdef"])
    assert len(held_out_worlds(records, 0.01)) in (0, len(records))
    assert len(held_out_worlds(records, 1.0)) == len(records)


def test_corpora_for_validation_are_not_trained_on(two, monkeypatch):
    monkeypatch.setattr(two[0].config.worlds, "held_out", True)
    with pytest.raises(ValueError, match=r"must be a corpus to train with, got one of worlds.held"):
        StudentData(two, 0.3)


def test_held_out_worlds_depend_only_on_their_names():
    library = CorpusConfig().worlds
    names = [world_source(library, seed, k).name for seed in (0, 3) for k in range(400)]
    sides = {name: is_held_out(name, 0.1) for name in names}
    assert sides == {name: is_held_out(name, 0.1) for name in reversed(names)}
    assert 0.07 < sum(sides.values()) / len(sides) < 0.13
    more = {name for name in names if is_held_out(name, 0.2)}
    assert {name for name, held_out in sides.items() if held_out} < more


def test_corpora_that_differ_or_hold_out_too_many_or_few_worlds_are_refused(two, tmp_path):
    other = Corpus(shutil.copytree(two[0].folder, tmp_path / "corpus"))
    assert StudentData([two[0], other], HELD_OUT).worlds == [w.name for w in two[0].worlds]
    record, config = other.worlds[1], two[0].config
    esdf = record.esdf
    replace(esdf, distances=esdf.distances + 0.5).save(record.path / "esdf.npz")
    wide = Corpus(two[1].folder)
    wide.config = replace(config, camera=replace(config.camera, fov_x=100.0))
    for corpora, held_out, message in (
        ([two[0], Corpus(other.folder)], HELD_OUT, r"pillars-1 and .*pillars-1 are different wor"),
        ([two[0], wide], HELD_OUT, "cameras of the corpora must be equal"),
        (two[:1], 0.16, r"0 of 3 worlds are held out, .* set held_out to 0\.17"),
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
        expected = network.features[:FROZEN](encode_images(data.pixels(indices, "depth")))
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
