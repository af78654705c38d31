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
from splatpilot.diagrams.worlds.appearance import randomize_appearance
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.policies.base import observation
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.systems.policies.diffaero_rgb import (
    DISTILLED_RGB_NETWORK,
    DiffAeroRgb,
    DistilledRgbConfig,
    encode_view,
    load_network,
)
from splatpilot.systems.vehicle.state import pose_from_state, rotation_matrices
from splatpilot.training.corpus.library import scenario_world
from splatpilot.training.policies.train import TRAINERS, run
from splatpilot.training.policies.train_diffaero_rgb import (
    DiffAeroRgbTrainer,
    DiffAeroRgbTraining,
    DistilledRgbLearner,
    DistilledRgbModule,
    DistilledRgbTrainer,
    DistilledRgbTraining,
    flip,
)
from splatpilot.training.policies.training_worlds import WorldSelection, WorldViews
from splatpilot.training.policies.vehicles import BodyRate, Observation, PointMass, map_tensors


def of_corpus(corpus: Path, *overrides: str) -> DiffAeroRgbTraining:
    settings = [f"corpora=[{corpus}]", "held_out=0.05", "batch=8", "schedule.updates=40"]
    settings += ["schedule.validate_every=40", "schedule.checkpoint_every=10"]
    return load_config(DiffAeroRgbTraining(), overrides=[*settings, *overrides])


@pytest.fixture(scope="module")
def trained(wide_corpus, tmp_path_factory) -> Path:
    """The folder of a run."""
    out = tmp_path_factory.mktemp("trained")
    run(config=of_corpus(wide_corpus), out=out, make=TRAINERS.find("diffaero_rgb").make)
    return out


def test_training_views_are_those_of_flight(wide_corpus):
    trainer = DiffAeroRgbTrainer(of_corpus(wide_corpus))
    numbers = np.array([3, 20])
    color, R_HB, target = trainer._samples(numbers)
    views, data = trainer.network.encode(color, R_HB), trainer._data
    attitudes = rotation_matrices(data.labels(numbers).X_WB[:, :4].double()).numpy()
    for n, number in enumerate(numbers):
        image = data.pixels(np.array([number]), "color")[0]
        np.testing.assert_allclose(views[n], encode_view(image, attitudes[n]), atol=1e-5)
        depth = data.pixels(np.array([number]), "depth")[0][15:105].astype(float)
        cell = depth[20:30, 50:60].min()
        assert target[n, 2, 5] == pytest.approx(3.0 / np.clip(cell, 0.3, 12.0) - 0.6, rel=1e-5)


def test_flipped_views_have_flipped_rays():
    color = np.random.default_rng(4).integers(0, 256, (90, 160, 3)).astype(np.uint8)
    mirror = np.diag([1.0, -1.0, 1.0])
    R_WB = RollPitchYaw(0.2, 0.3, 0.0).ToRotationMatrix().matrix()
    views = [encode_view(color, R_WB), encode_view(color[:, ::-1], mirror @ R_WB @ mirror)]
    view = torch.from_numpy(np.stack([views[0], views[0]]))
    found = flip(view, torch.tensor([True, False])).numpy()
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
    trainer = DiffAeroRgbTrainer(of_corpus(wide_corpus, f"begin={file}"))
    with np.load(file) as weights:
        for name, values in trainer.network.state_dict().items():
            np.testing.assert_array_equal(values.numpy(), weights[name])
    curve = list(csv.DictReader((trained / "curves.csv").open()))
    best = max(float(row["success"]) for row in curve if row["success"])
    assert trainer.evaluate()["success"] == pytest.approx(best, abs=1e-6)
    other = tmp_path / "diffaero.npz"
    PolicyCheckpoint.load(None, "diffaero", DIFFAERO_NETWORK).save(other)
    with pytest.raises(ValueError, match="got 'diffaero'"):
        DiffAeroRgbTrainer(of_corpus(wide_corpus, f"begin={other}"))
    with pytest.raises(ValueError, match=r"160 pixels wide.* got 32x24"):
        DiffAeroRgbTrainer(of_corpus(student_corpus))


def in_flight(*more: str) -> DistilledRgbTraining:
    settings = ["worlds.kinds=[P10]", "worlds.count=1", "worlds.held_out=1"]
    settings += ["worlds.voxel_size=0.5", "rollout.environments=4", "rollout.steps=3"]
    settings += ["appearance.exposure=0", "noise.color_noise=0", "noise.brightness_jitter=0"]
    return load_config(DistilledRgbTraining(), overrides=[*settings, *more])


def random_module() -> DistilledRgbModule:
    """A module in which features matter."""
    torch.manual_seed(0)
    module = DistilledRgbModule()
    with torch.no_grad():
        module.policy.convolutions[0].weight[:, 1:].normal_(std=0.3)
        module.monocular.head.weight.normal_(std=0.1)
    return module


def seen_by(count: int = 2) -> Observation:
    """Vehicles in different states with different images."""
    rng = np.random.default_rng(0)

    def normal(*size: int) -> torch.Tensor:
        return torch.from_numpy(rng.normal(size=size)).float()

    state = (normal(count, 3), normal(count, 3), normal(count, 3), normal(count))
    vehicle = PointMass(*state, torch.ones(count, 1))
    color = torch.from_numpy(rng.integers(0, 256, (count, 90, 160, 3)).astype(np.uint8))
    depth = 5.0 + normal(count, 144).abs()
    return Observation(depth, vehicle, 5.0 * normal(count, 3), torch.full((count,), 2.0), color)


def test_it_begins_as_the_shipped_policy():
    torch.manual_seed(3)
    module, network = DistilledRgbModule(), load_network(None)
    rng = np.random.default_rng(0)
    view = rng.uniform(-1, 1, (6, 90, 160)).astype(np.float32)
    state, hidden = rng.normal(size=(1, 9)), rng.normal(size=(1, 128))
    with torch.no_grad():
        image, _ = module.see(torch.from_numpy(view)[None], bfloat16=False)
        inputs = (torch.from_numpy(x).float() for x in (state, hidden))
        found, memory = module.policy(image, *inputs)
    expected, expected_memory = network.policy.step(network.monocular(view)[0], *state, *hidden)
    np.testing.assert_allclose(found[0], expected, atol=1e-4)
    np.testing.assert_allclose(memory[0], expected_memory, atol=1e-5)


def test_flight_decides_as_training_does(tmp_path):
    learner, file = DistilledRgbLearner(in_flight()), tmp_path / "distilled_rgb.npz"
    learner.network = random_module()
    weights = {name: w.numpy() for name, w in learner.network.state_dict().items()}
    PolicyCheckpoint("distilled_rgb", DISTILLED_RGB_NETWORK, weights, {}).save(file)
    policy = DiffAeroRgb(DistilledRgbConfig(weights=str(file)))
    seen, states = seen_by(), np.random.default_rng(1).normal(size=(2, 13))
    states[:, 6:10] /= np.linalg.norm(states[:, 6:10], axis=1, keepdims=True)
    vehicle = BodyRate(torch.from_numpy(states).float(), torch.zeros(2, 3))
    memory, flown = learner.initial_memory(2), [np.zeros(128, np.float32)] * 2
    for _ in range(3):
        with torch.no_grad():
            a_cmd, _, memory = learner.decide(seen._replace(vehicle=vehicle), memory)
        for n in range(2):
            observed = observation(0.0, states[n], seen.p_WG[n].numpy(), seen.color[n].numpy())
            decided, flown[n] = policy.decide(observed, np.zeros(3), flown[n])
            np.testing.assert_allclose(a_cmd[n], decided, atol=1e-3)


def test_every_second_vehicle_learns_in_the_mirror_image():
    learner = DistilledRgbLearner(in_flight())
    learner.network = random_module()
    mirror, one = torch.tensor([1.0, -1.0, 1.0]), seen_by(1)
    both = map_tensors(lambda x: x.repeat(2, *[1] * (x.ndim - 1)), one)
    for vector in (both.vehicle.p, both.vehicle.v, both.vehicle.a, both.p_WG):
        vector[1] *= mirror
    both.vehicle.yaw[1] *= -1.0
    both.color[1] = one.color[0].flip(1)
    both.depth[1] = one.depth.reshape(9, 16).flip(1).flatten()
    memory = learner.initial_memory(2)
    for _ in range(2):
        a_cmd, _, memory = learner.decide(both, memory)
    torch.testing.assert_close(a_cmd[0], mirror * a_cmd[1], atol=1e-3, rtol=0)
    assert memory[:, -1].tolist() == [1.0, -1.0]
    torch.testing.assert_close(memory[0, :128], memory[1, :128], atol=1e-4, rtol=0)


def test_imitation_has_no_gradient_through_the_flight_and_is_learned():
    learner, seen = DistilledRgbLearner(in_flight()), seen_by(2)
    v = seen.vehicle.v.requires_grad_()
    optimizer, curve = torch.optim.Adam(learner.network.parameters(), lr=3e-4), []
    for _ in range(6):
        a_cmd, _, _ = learner.decide(seen, learner.initial_memory(2))
        imitation, likelihood = learner._terms.pop()
        (through_flight,) = torch.autograd.grad(a_cmd.sum(), v, retain_graph=True)
        assert through_flight.abs().max() > 0.1
        loss = imitation + likelihood
        assert torch.autograd.grad(loss, v, allow_unused=True, retain_graph=True) == (None,)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        curve.append(imitation.item())
    assert curve[-1] < 0.9 * curve[0]


def test_views_are_those_of_the_camera_in_flight():
    selection, camera = WorldSelection(kinds=["P10", "P01"]), DistilledRgbConfig().camera
    views = WorldViews(selection, 2, 2_000_000, camera)
    views.looks[1] = torch.tensor([5.0, 0.7])
    views.restore(views.looks)
    p_WB, yaw = torch.tensor([[2.0, 0.3, 1.5], [3.0, -0.5, 1.2]]), torch.tensor([0.3, -0.4])
    vehicle = BodyRate.hovering(p_WB, yaw)
    found = views.render(vehicle, torch.tensor([0, 1]))
    info = camera.camera_info()
    for n, kind in enumerate(selection.kinds):
        world = make_world(scenario_world(kind), 2_000_000 + n)
        world = randomize_appearance(world, *((0.7, 5) if n else (0.0, 0)))
        X_WC = pose_from_state(vehicle.state[n].double().numpy()) @ camera.mount()
        color = world.baked.render_color(
            info.intrinsic_matrix(), info.width(), info.height(), X_WC, background=world.background
        )
        error = np.abs(found[n].numpy().astype(float) - 255.0 * np.clip(color, 0.0, 1.0))
        assert error.mean() < 0.6 and np.quantile(error, 0.999) < 3.0


def test_worlds_change_their_appearance():
    trainer, again = (DistilledRgbTrainer(in_flight("repaint=0.8")) for _ in "ab")

    def shown(trainer_of_views) -> torch.Tensor:
        vehicle = trainer._current.episodes.vehicle
        return trainer_of_views._views.render(vehicle, torch.zeros(4, dtype=int)).float()

    before = shown(trainer)
    trainer.begin_update(0)
    assert (before - shown(trainer)).abs().mean() > 2.0
    again.load_state_dict(trainer.state_dict())
    assert torch.equal(shown(again), shown(trainer))
