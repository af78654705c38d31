import os
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpilot.diagrams.worlds import splits
from splatpilot.diagrams.worlds.scene_folder import SceneConfig
from splatpilot.diagrams.worlds.splits import part_digests, source_digest
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import Capsule, HalfSpace
from splatpilot.systems.common.files import cache_folder
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.corpus.library import scenario_world
from splatpilot.training.policies import training_worlds as world_cache
from splatpilot.training.policies.ray_casting import EsdfGeometry, PixelRays
from splatpilot.training.policies.rollouts import DifferentiableRollout, RolloutConfig
from splatpilot.training.policies.train_diffaero import DiffAeroLearner, DiffAeroLoss
from splatpilot.training.policies.training_worlds import (
    TrainingWorld,
    WorldCache,
    WorldSelection,
    training_worlds,
    validation_worlds,
)

UPPER = np.array([12.0, 7.0, 4.0])


@pytest.fixture(scope="module")
def yard(write_scene, tmp_path_factory) -> str:
    return write_scene(tmp_path_factory.mktemp("scenes") / "yard")


@pytest.fixture(scope="module")
def field(yard) -> Esdf:
    return make_world(SceneConfig(path=yard), seed=0).esdf


@pytest.fixture(scope="module")
def selection(yard) -> WorldSelection:
    return WorldSelection(kinds=["P02"], scenes=[yard], count=4, held_out=2, voxel_size=0.5)


@pytest.fixture(scope="module")
def worlds(selection):
    return training_worlds(selection, seed=3)


def test_kinds_and_scenes_take_turns(field, selection, worlds):
    held_out = validation_worlds(selection)
    for batch, number, seed in ((worlds, 2, 1_003_002), (held_out, 0, 2_000_000)):
        generated = WorldCache().world(scenario_world("P02"), seed)
        np.testing.assert_allclose(batch.p_WS[number], generated.p_WS, rtol=1e-6)
        np.testing.assert_allclose(batch.p_WG[number], generated.p_WG, rtol=1e-6)
    np.testing.assert_allclose(worlds.upper_W[1::2], [UPPER] * 2, atol=1e-5)
    starts = torch.cat([b.p_WS[1::2] for b in (worlds, held_out)]).numpy()
    goals = torch.cat([b.p_WG[1::2] for b in (worlds, held_out)]).numpy()
    assert len(np.unique(starts.round(3), axis=0)) == len(starts) == 3
    assert (np.linalg.norm(goals - starts, axis=1) > 3.0).all()
    assert (field.distance(np.concatenate([starts, goals]).astype(float)) > VEHICLE_RADIUS).all()


def test_images_of_scenes_show_their_distance_field(field, worlds):
    alone = EsdfGeometry([field.conservative()])
    rays = PixelRays.of(16, 9, 90.0)
    p = torch.tensor([[2.0, 3.0, 1.5], [3.0, 2.0, 1.0], [9.0, 4.0, 2.0], [2.0, 3.5, 2.0]])
    R = torch.tensor([[[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]]).expand(4, 3, 3)
    world, first = torch.tensor([1, 0, 3, 1]), torch.zeros(4, dtype=torch.long)
    depth = worlds.geometry.depth(p, R, rays, world)
    distances, normals = worlds.geometry.nearest(p, world, 4)
    expected = alone.depth(p, R, rays, first)
    nearest, gradients = alone.nearest(p, first, 1)
    for n in (0, 2, 3):
        assert torch.equal(depth[n], expected[n])
        assert distances[n].tolist() == [nearest[n, 0].item(), *[torch.inf] * 3]
        assert torch.equal(normals[n, 0], gradients[n, 0]) and not normals[n, 1:].any()
    assert not torch.equal(depth[1], expected[1])
    assert distances[1].isfinite().all()  # a forest has more than four trees


def test_paths_in_scenes_lead_around_obstacles(field, worlds):
    p, world = torch.tensor([[3.0, 3.5, 1.5]]), torch.tensor([1])
    for _ in range(300):
        p = p + 0.05 * worlds.direction(p, world)
        assert field.distance(p[0].double().numpy()) > 0.2
    assert (p - worlds.p_WG[1]).norm() < 0.2


def test_policies_learn_in_scenes(worlds):
    config = RolloutConfig(environments=8, steps=6)
    for batch in (worlds, worlds.without_obstacles()):
        learner = DiffAeroLearner(DiffAeroLoss())
        rollout = DifferentiableRollout(learner, batch, config, torch.Generator().manual_seed(0))
        torch.stack(list(rollout.losses().values())).sum().backward()
        gradients = [weight.grad for weight in learner.network.parameters()]
        assert all(g is not None and g.isfinite().all() and g.any() for g in gradients)


def test_bad_selections_are_refused(tmp_path, write_scene, monkeypatch):
    map_file = tmp_path / "renamed.bt"
    map_file.write_bytes(b"a map")
    # Other scenarios than the benchmark's are kinds.
    WorldSelection(kinds=["office"], scenes=[str(map_file)]).validate()
    monkeypatch.setattr(
        splits, "load_test_sources", lambda: {"lab": source_digest(part_digests([b"a map"]))}
    )
    tested = write_scene(tmp_path / "warehouse", split="test")
    for fields, message in (
        ({"kinds": ["R13"]}, "worlds.kinds must be of generated worlds, got R13"),
        ({"scenes": [tested]}, "split of .*warehouse must be train, got 'test'"),
        ({"count": 1001}, r"count must be in \[1, 1000\], got 1001"),
        ({"scenes": [str(map_file)]}, "renamed.bt shows lab, in which the benchmark tests"),
    ):
        with pytest.raises(ValueError, match=message):
            WorldSelection(**fields).validate()


GROUND = HalfSpace([0, 0, 1], 0.0)
VOLUME = np.zeros(3), np.array([6.0, 4.0, 3.0])


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return cache_folder("worlds")


def arrival(goal: float = 1.5, radius: float = 0.3):
    post = Capsule([3.0, 2.0, 0.0], [3.0, 2.0, 3.0], radius)
    world = TrainingWorld([GROUND, post], *VOLUME, np.ones(3), np.array([5.0, 2.0, goal]))
    return WorldCache().arrival(world, 0.25)


def assert_same(a, b) -> None:
    for name in ("distances", "states", "lower_W", "voxel_size", "occupied_outside"):
        np.testing.assert_array_equal(getattr(a[0], name), getattr(b[0], name))
    for name in ("p_WG", "times", "reachable", "lower_W", "voxel_size"):
        np.testing.assert_array_equal(getattr(a[1], name), getattr(b[1], name))


def test_arrival_is_read_from_the_cache(folder, monkeypatch):
    made = arrival()
    with monkeypatch.context() as patch:
        patch.setattr(world_cache, "time_of_arrival", None)
        assert_same(arrival(), made)
        for other in ({"goal": 1.4}, {"radius": 0.4}):
            with pytest.raises(TypeError):
                arrival(**other)
        patch.setattr(world_cache, "program", lambda: {"splatpilot": "another"})
        with pytest.raises(TypeError):
            arrival()
    [file] = folder.rglob("output.pkl")
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    assert_same(arrival(), made)
    assert file.read_bytes() == content
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))  # where none can be written
    assert_same(arrival(), made)


def test_least_recently_used_files_are_removed_first(folder, monkeypatch):
    cache = WorldCache()
    for goal in (1.2, 1.3, 1.4):
        arrival(goal)
    files = sorted(folder.rglob("output.pkl"))
    for time, file in enumerate(files):
        os.utime(file, (time, time))
    # Sizes differ by some bytes, since each entry notes its duration.
    size = sum(file.stat().st_size for file in files[0].parent.iterdir())
    monkeypatch.setattr(world_cache, "_LIMIT", int(2.5 * size))
    cache.prune()
    assert sorted(folder.rglob("output.pkl")) == files[1:]


@pytest.mark.parametrize("kind", ["P02", "P05", "P10", "P11"])
def test_generated_worlds_are_read_from_the_cache(folder, monkeypatch, kind):
    made = WorldCache().world(scenario_world(kind), 7)
    monkeypatch.setattr(world_cache, "make_spec", None)
    again = WorldCache().world(scenario_world(kind), 7)
    for a, b in zip(again.surfaces, made.surfaces, strict=True):
        assert type(a) is type(b)
        for x, y in zip(a.parameters(), b.parameters(), strict=True):
            np.testing.assert_array_equal(x, y)
    for point in ("lower_W", "upper_W", "p_WS", "p_WG"):
        np.testing.assert_array_equal(getattr(again, point), getattr(made, point))
    with pytest.raises(TypeError):
        WorldCache().world(scenario_world(kind), 8)
