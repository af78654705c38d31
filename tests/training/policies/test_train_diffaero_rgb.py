import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from pydrake.math import RollPitchYaw

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.simulation import fly
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.systems.policies.diffaero_rgb import encode_view, load_network
from splatpilot.systems.vehicle.state import rotation_matrices
from splatpilot.training.policies import train_diffaero_rgb
from splatpilot.training.policies.train import TRAINERS, run


def training(corpus: Path, *overrides: str) -> train_diffaero_rgb.DiffAeroRgbTraining:
    settings = [f"corpora=[{corpus}]", "held_out=0.2", "batch=8", "schedule.updates=40"]
    settings += ["schedule.validate_every=40", "schedule.checkpoint_every=20"]
    return load_config(train_diffaero_rgb.DiffAeroRgbTraining(), overrides=[*settings, *overrides])


@pytest.fixture(scope="module")
def trained(wide_corpus, tmp_path_factory) -> Path:
    """The folder of a run."""
    out = tmp_path_factory.mktemp("trained")
    run(config=training(wide_corpus), out=out, make=TRAINERS.find("diffaero_rgb").make)
    return out


def test_training_views_are_those_of_flight(wide_corpus):
    trainer = train_diffaero_rgb.DiffAeroRgbTrainer(training(wide_corpus))
    numbers = np.array([3, 20])
    color, rays, target = trainer._samples(numbers)
    data = trainer._data
    for n, number in enumerate(numbers):
        label = data.labels(numbers).X_WB[n].numpy()
        R_WB = rotation_matrices(label[None, :4].astype(float))[0]
        image = data.pixels(np.array([number]), "color")[0]
        view = encode_view(image, R_WB)
        np.testing.assert_allclose(rays[n].numpy(), view[3:], atol=1e-5)
        shown = color[n].movedim(2, 0).numpy() / 127.5 - 1.0
        np.testing.assert_allclose(shown, view[:3], atol=1e-5)
        depth = data.pixels(np.array([number]), "depth")[0][15:105].astype(float)
        cell = depth[20:30, 50:60].min()
        assert target[n, 2, 5] == pytest.approx(3.0 / np.clip(cell, 0.3, 12.0) - 0.6, rel=1e-5)


def test_flipped_views_have_flipped_rays():
    color = np.random.default_rng(4).integers(0, 256, (90, 160, 3)).astype(np.uint8)
    mirror = np.diag([1.0, -1.0, 1.0])
    R_WB = RollPitchYaw(0.2, 0.3, 0.0).ToRotationMatrix().matrix()
    views = [encode_view(color, R_WB), encode_view(color[:, ::-1], mirror @ R_WB @ mirror)]
    view = torch.from_numpy(np.stack([views[0], views[0]]))
    found = train_diffaero_rgb.flip(view, torch.tensor([True, False])).numpy()
    np.testing.assert_allclose(found[0], views[1], atol=1e-5)
    np.testing.assert_array_equal(found[1], views[0])


def test_trained_network_predicts_depth_and_flies(trained):
    rows = list(csv.DictReader((trained / "curves.csv").open()))
    curve = [{name: float(value) for name, value in row.items() if value} for row in rows]
    assert curve[-1]["likelihood"] < curve[0]["likelihood"] - 0.3
    assert curve[-1]["error"] < 0.8 * curve[0]["error"]
    file = str(trained / "diffaero_rgb.npz")
    shipped = PolicyCheckpoint.load(None, "diffaero", DIFFAERO_NETWORK).weights
    with np.load(file) as weights:
        for name, values in shipped.items():
            np.testing.assert_array_equal(weights[f"policy.{name}"], values)
    assert load_network(file).policy.initial_hidden().shape == (128,)
    world = make_world(ForestConfig(length=12.0, width=8.0, height=4.0), 1_000_000)
    scenario = Scenario(seed=1_000_000, policy=policy_named(file, 3.0), timeout=1.0)
    flight = fly(BuildFlightDiagram(scenario, world, camera=False))
    assert np.linalg.norm(flight.states[-1, :3] - flight.states[0, :3]) > 0.1


def test_training_continues_from_given_weights(trained, wide_corpus, student_corpus, tmp_path):
    file = trained / "diffaero_rgb.npz"
    trainer = train_diffaero_rgb.DiffAeroRgbTrainer(training(wide_corpus, f"begin={file}"))
    with np.load(file) as weights:
        for name, values in trainer.network.state_dict().items():
            np.testing.assert_array_equal(values.numpy(), weights[name])
    curve = list(csv.DictReader((trained / "curves.csv").open()))
    best = max(float(row["success"]) for row in curve if row["success"])
    assert trainer.evaluate()["success"] == pytest.approx(best, abs=1e-6)
    other = tmp_path / "diffaero.npz"
    PolicyCheckpoint.load(None, "diffaero", DIFFAERO_NETWORK).save(other)
    with pytest.raises(ValueError, match="got 'diffaero'"):
        train_diffaero_rgb.DiffAeroRgbTrainer(training(wide_corpus, f"begin={other}"))
    with pytest.raises(ValueError, match=r"160 pixels wide.* got 32x24"):
        train_diffaero_rgb.DiffAeroRgbTrainer(training(student_corpus))
