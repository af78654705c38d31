from math import inf

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.diagrams.worlds.inserted import InsertedConfig
from splatpilot.diagrams.worlds.splits import load_test_sources
from splatpilot.systems.common.provenance import SEEDS_PER_RUN, TRAINING_SEEDS, VALIDATION_SEEDS
from splatpilot.training.corpus.library import (
    LibraryConfig,
    PerturbationConfig,
    perturb_pose,
    scenario_world,
    world_source,
)


def test_seeds_are_those_of_training_or_validation_and_never_shared():
    def seeds(seed, **changes):
        library = LibraryConfig(**changes)
        return {world_source(library, seed, k).seed for k in (0, 1, SEEDS_PER_RUN - 1)}

    first, second, held_out = seeds(0), seeds(1), seeds(0, held_out=True)
    assert not first & second
    assert TRAINING_SEEDS <= min(first | second) <= max(first | second) < VALIDATION_SEEDS
    assert min(held_out) >= VALIDATION_SEEDS
    for index in (-1, SEEDS_PER_RUN):
        with pytest.raises(ValueError, match="at most 1000 worlds"):
            world_source(LibraryConfig(), 0, index)


def test_kinds_and_scenes_come_in_turn(tmp_path, write_scene):
    scene = write_scene(tmp_path / "attic", 0.25)
    library = LibraryConfig(kinds=["P02", "P06"], scenes=[scene])
    library.validate()
    sources = [world_source(library, 0, k) for k in range(4)]
    assert [s.name for s in sources] == [
        f"{kind}-{TRAINING_SEEDS + k}" for k, kind in enumerate(["P02", "P06", "attic", "P02"])
    ]
    assert [s.perturbation_bound for s in sources] == [inf, inf, 0.25, inf]
    assert sources[1].world == scenario_world("P06")
    assert sources[2].world == InsertedConfig(path=scene, draw_ends=True)
    assert sources[2].source_digest == ["0123456789abcdef"]


HOSPITAL = load_test_sources()["hospital"][3:5]


@pytest.mark.parametrize(
    ("scene", "library", "message"),
    [
        ({"bound": None}, {}, r"attic/scene.yaml .* scene fidelity .*attic`"),
        ({"digest": HOSPITAL}, {}, "attic shows hospital, in which the benchmark tests"),
        ({"digest": HOSPITAL, "split": "test"}, {}, "attic shows hospital, in which the"),
        ({"digest": ()}, {}, r"attic is missing source_digest.*reconstruct"),
        ({"split": "test"}, {}, "split of .*attic must be train, got 'test'"),
        ({"split": "validation"}, {}, "split of .*attic must be train, got 'validation'"),
        ({"split": ""}, {}, "split of .*attic must be train, got ''"),
        ({}, {"held_out": True}, "split of .*attic must be validation, got 'train'"),
        ({}, {"scenes": ["nowhere"]}, r"No such file .* expected a scene"),
        ({}, {"scenes": ["{}/gaussians.ply"]}, "must be scene folders or OctoMaps"),
        ({}, {"scenes": [], "kinds": []}, "must be one kind or more"),
        ({}, {"kinds": ["R13"]}, "must be of generated worlds, got R13"),
        ({}, {"kinds": ["P99"]}, "there is no scenario 'P99'"),
    ],
)
def test_invalid_libraries_are_refused(tmp_path, write_scene, scene, library, message):
    path = write_scene(tmp_path / "attic", **{"bound": 0.2} | scene)
    scenes = [text.format(path) for text in library.get("scenes", ["{}"])]
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        LibraryConfig(**library | {"scenes": scenes}).validate()


def test_copies_of_scenes_that_the_benchmark_finds_are_not_learned_in(
    tmp_path, write_scene, monkeypatch
):
    monkeypatch.setenv("SPLATPILOT_SCENES", str(tmp_path))
    scene = write_scene(tmp_path / "shop", 0.2)
    LibraryConfig(kinds=[], scenes=[scene]).validate()
    write_scene(tmp_path / "bookstore", 0.2, split="test")
    with pytest.raises(ValueError, match="shop shows bookstore, in which the benchmark tests"):
        LibraryConfig(scenes=[scene]).validate()


X_WB = RigidTransform(RollPitchYaw(0.3, -0.2, 2.0), np.array([1.0, 2.0, 3.0]))


@pytest.mark.parametrize(("distance", "reach"), [(0.3, 1.0), (0.5, 0.2), (0.5, -0.1)])
def test_displacements_fill_the_smaller_sphere(distance, reach):
    config = PerturbationConfig(distance=distance, yaw=0.0, tilt=0.0)
    rng = np.random.default_rng(0)
    poses = [perturb_pose(X_WB, config, reach, rng) for _ in range(2000)]
    radius = max(0.0, min(distance, reach))
    offsets = np.array([X.translation() - X_WB.translation() for X in poses])
    lengths = np.linalg.norm(offsets, axis=1)
    assert lengths.max() <= radius + 1e-12
    if radius:
        assert np.mean(lengths < radius * 0.5 ** (1 / 3)) == pytest.approx(0.5, abs=0.04)
        np.testing.assert_allclose(offsets.mean(axis=0), 0.0, atol=0.04 * radius)
    np.testing.assert_allclose(poses[0].rotation().matrix(), X_WB.rotation().matrix(), atol=1e-12)


def test_rotations_keep_their_limits_about_the_vertical_and_the_horizontal():
    rng = np.random.default_rng(1)
    yaw, tilt = PerturbationConfig(yaw=0.4, tilt=0.0), PerturbationConfig(yaw=0.0, tilt=0.1)
    turns, leans = [], []
    for _ in range(200):
        R = perturb_pose(X_WB, yaw, 1.0, rng).rotation() @ X_WB.rotation().inverse()
        np.testing.assert_allclose(R.matrix() @ [0, 0, 1], [0, 0, 1], atol=1e-12)
        turns.append(R.ToAngleAxis().angle())
        z = perturb_pose(X_WB, tilt, 1.0, rng).rotation().matrix()[:, 2]
        leans.append(np.arccos(min(z @ X_WB.rotation().matrix()[:, 2], 1.0)))
    assert 0.35 < max(turns) <= 0.4 + 1e-12
    assert 0.08 < max(leans) <= 0.1 * np.sqrt(2) + 1e-9
