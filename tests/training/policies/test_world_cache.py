import os
from pathlib import Path

import numpy as np
import pytest

from splatpilot.systems.collision.shapes import Capsule, HalfSpace
from splatpilot.systems.common.files import cache_folder
from splatpilot.training.corpus.library import scenario_world
from splatpilot.training.policies import training_worlds as world_cache
from splatpilot.training.policies.training_worlds import TrainingWorld, WorldCache

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


def test_what_was_made_is_read_again(folder, monkeypatch):
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
    [file] = folder.iterdir()
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    assert_same(arrival(), made)
    assert file.read_bytes() == content


def test_a_cache_that_cannot_be_written_keeps_nothing(folder, tmp_path, monkeypatch):
    made = arrival()
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert_same(arrival(), made)


def test_what_was_not_used_for_longest_goes_first(folder, monkeypatch):
    cache = WorldCache()
    for goal in (1.2, 1.3, 1.4):
        arrival(goal)
    files = sorted(folder.iterdir())
    for time, file in enumerate(files):
        os.utime(file, (time, time))
    monkeypatch.setattr(world_cache, "_LIMIT", 2 * files[0].stat().st_size)
    cache.prune()
    assert sorted(folder.iterdir()) == files[1:]


@pytest.mark.parametrize("kind", ["P02", "P05", "P10", "P11"])
def test_generated_worlds_are_read_again(folder, monkeypatch, kind):
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
