import os
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpilot.diagrams.worlds import splits
from splatpilot.diagrams.worlds.scene_folder import SceneConfig, write_scene_folder
from splatpilot.diagrams.worlds.splits import part_digests, source_digest
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Capsule, HalfSpace
from splatpilot.systems.common.files import cache_folder
from splatpilot.systems.splats.scene import GaussianScene
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


def write_yard(folder: Path, split: str = "train") -> str:
    """A captured yard with a post in it."""
    shapes = [HalfSpace([0, 0, 1], 0.0), Capsule([6.0, 3.5, 0.0], [6.0, 3.5, 5.0], 0.5)]
    esdf = esdf_from_distance_field(AnalyticDistanceField(shapes, np.zeros(3), UPPER), 0.2)
    one = np.ones((1, 3))
    world = World(
        name=folder.name,
        gaussians=GaussianScene.from_colors(one, [[1, 0, 0, 0]], one, [0.5], one),
        distance_field=esdf,
        esdf=esdf,
        background=(0.0, 0.0, 0.0),
        p_WS=np.ones(3),
        p_WG=2 * np.ones(3),
    )
    digest = ["0123456789abcdef"]
    write_scene_folder(folder, world, provenance="", split=split, source_digest=digest)
    return str(folder)


@pytest.fixture(scope="module")
def yard(tmp_path_factory) -> str:
    return write_yard(tmp_path_factory.mktemp("scenes") / "yard")


def selection(yard: str, **fields) -> WorldSelection:
    return WorldSelection(kinds=["P02"], scenes=[yard], count=4, held_out=2, **fields)


def field_of(yard: str) -> Esdf:
    return make_world(SceneConfig(path=yard), seed=0).esdf


def test_kinds_and_scenes_take_turns(yard):
    worlds = training_worlds(selection(yard, voxel_size=0.5), seed=3)
    held_out = validation_worlds(selection(yard))
    for batch, number, seed in ((worlds, 2, 1_003_002), (held_out, 0, 2_000_000)):
        generated = WorldCache().world(scenario_world("P02"), seed)
        np.testing.assert_allclose(batch.p_WS[number], generated.p_WS, rtol=1e-6)
        np.testing.assert_allclose(batch.p_WG[number], generated.p_WG, rtol=1e-6)
    np.testing.assert_allclose(worlds.upper_W[1::2], [UPPER] * 2, atol=1e-5)
    ends = torch.cat([b.p_WS[1::2] for b in (worlds, held_out)]).numpy()
    goals = torch.cat([b.p_WG[1::2] for b in (worlds, held_out)]).numpy()
    assert len(np.unique(ends.round(3), axis=0)) == len(ends) == 3
    assert (np.linalg.norm(goals - ends, axis=1) > 3.0).all()
    field = field_of(yard)
    assert (field.distance(np.concatenate([ends, goals]).astype(float)) > VEHICLE_RADIUS).all()


def test_images_of_scenes_show_their_distance_field(yard):
    worlds = training_worlds(selection(yard, voxel_size=0.5), seed=0)
    alone = EsdfGeometry([field_of(yard).conservative()])
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


def test_paths_in_scenes_lead_around_obstacles(yard):
    worlds = training_worlds(selection(yard), seed=0)
    p, world = torch.tensor([[3.0, 3.5, 1.5]]), torch.tensor([1])
    field = field_of(yard)
    for _ in range(300):
        p = p + 0.05 * worlds.direction(p, world)
        assert field.distance(p[0].double().numpy()) > 0.2
    assert (p - worlds.p_WG[1]).norm() < 0.2


def test_policies_learn_in_scenes(yard):
    worlds = training_worlds(WorldSelection(kinds=["P02"], scenes=[yard], count=2), seed=0)
    for batch in (worlds, worlds.without_obstacles()):
        learner = DiffAeroLearner(DiffAeroLoss())
        rollout = DifferentiableRollout(
            learner, batch, RolloutConfig(environments=8, steps=6), torch.Generator().manual_seed(0)
        )
        torch.stack(list(rollout.losses().values())).sum().backward()
        gradients = [weight.grad for weight in learner.network.parameters()]
        assert all(g is not None and g.isfinite().all() and g.any() for g in gradients)


def test_bad_selections_are_refused(yard, tmp_path):
    WorldSelection(kinds=["office"]).validate()  # other scenarios than the benchmark's are kinds
    tested = write_yard(tmp_path / "warehouse", "test")
    for fields, message in (
        ({"kinds": ["R13"]}, "worlds.kinds must be of generated worlds, got R13"),
        ({"scenes": [tested]}, "split of .*warehouse must be train, got 'test'"),
        ({"count": 1001}, r"count must be in \[1, 1000\], got 1001"),
    ):
        with pytest.raises(ValueError, match=message):
            WorldSelection(**fields).validate()


def test_octomap_of_a_test_source_is_refused(tmp_path, monkeypatch):
    map_file = tmp_path / "renamed.bt"
    map_file.write_bytes(b"a map")
    WorldSelection(scenes=[str(map_file)]).validate()
    tested = {"lab": source_digest(part_digests([b"a map"]))}
    monkeypatch.setattr(splits, "load_test_sources", lambda: tested)
    with pytest.raises(ValueError, match=r"renamed.bt shows lab, in which the benchmark tests"):
        WorldSelection(scenes=[str(map_file)]).validate()


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
    monkeypatch.setattr(world_cache, "time_of_arrival", None)
    assert_same(arrival(), made)
    for other in ({"goal": 1.4}, {"radius": 0.4}):
        with pytest.raises(TypeError):
            arrival(**other)
    monkeypatch.setattr(world_cache, "program", lambda: {"splatpilot": "another"})
    with pytest.raises(TypeError):
        arrival()


def test_damaged_files_are_made_again(folder):
    made = arrival()
    [file] = folder.rglob("output.pkl")
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    assert_same(arrival(), made)
    assert file.read_bytes() == content


def test_unwritable_cache_is_not_used(folder, tmp_path, monkeypatch):
    made = arrival()
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
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
