"""The student from a corpus to a flight."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from torchvision.models import mobilenet_v2

from splatpilot.diagrams.flight.flight import fly
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.policies.student import StudentNetwork, mobilenet_blocks, plan
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.training.corpus.corpus import Corpus
from splatpilot.training.policies.student_config import StudentTraining
from splatpilot.training.policies.student_network import imagenet_weights
from splatpilot.training.policies.train import run
from splatpilot.training.policies.trainer_registry import TRAINERS

OVERRIDES = [
    "pretrained=false",
    "frozen=0",
    "held_out=0.2",
    "batch=12",
    "schedule.updates=50",
    "schedule.validate_every=50",
    "schedule.checkpoint_every=25",
    "schedule.learning_rate=0.001",
]


def training(corpus: Path, observation: str, *overrides: str) -> StudentTraining:
    config = TRAINERS.find(f"student_{observation}").config()
    return load_config(config, overrides=[f"corpora=[{corpus}]", *OVERRIDES, *overrides])


@pytest.fixture(scope="module")
def trained(student_corpus, tmp_path_factory) -> Path:
    """The folder of a run that saw depth."""
    out = tmp_path_factory.mktemp("trained")
    config = training(student_corpus, "depth")
    run(config=config, out=out, make=TRAINERS.find("student_depth").make)
    return out


def test_student_learns_what_it_is_shown(trained):
    """A minute's worth of samples is imitated better and better, every hypothesis keeps votes, and
    what is chosen is measured on the held-out world."""
    rows = list(csv.DictReader((trained / "curves.csv").open()))
    curve = [{name: float(value) for name, value in row.items() if value} for row in rows]
    assert curve[-1]["winners"] < 0.8 * curve[0]["winners"]
    votes = [[row[f"votes_{m}"] for m in range(3)] for row in curve]
    np.testing.assert_allclose(np.sum(votes, axis=1), 1.0, atol=1e-5)
    assert min(votes[-1]) > 0.05
    terms = sum(curve[-1][name] for name in ("winners", "unvoted", "cost", "clearance"))
    assert curve[-1]["loss"] == pytest.approx(terms, rel=1e-5)
    best = max(row["success"] for row in curve if "success" in row)
    assert f"| success | {best:.2f} |" in (trained / "student_depth.md").read_text()


def test_student_flies_by_its_weights(trained):
    """Named by its file, it flies through a generated world on plans that lead towards the goal."""
    config = replace(
        policy_named(str(trained / "student_depth.npz")),
        camera=OnboardCamera(width=32, height=24),
    )
    world = make_world(ForestConfig(length=12.0, width=8.0, height=4.0), 1_000_000)
    scenario = Scenario(seed=1_000_000, policy=config, timeout=1.0)
    flight = fly(BuildFlightDiagram(scenario, world, camera=False), scenario, world)
    plans = [Hypotheses.from_vector(row, 3) for row in flight.hypotheses]
    first, to_goal = plans[0], world.p_WG - flight.states[0, :3]
    assert len(plans) >= 15 and first is not None
    ahead = first.waypoints_W[first.best, -1] - flight.states[0, :3]
    assert ahead @ to_goal > 0.5 * np.linalg.norm(ahead) * np.linalg.norm(to_goal) > 0.0
    assert np.linalg.norm(flight.states[-1, :3] - flight.states[0, :3]) > 0.1


def test_interrupted_training_ends_as_whole(student_corpus, tmp_path):
    """A run that was interrupted between two checkpoints ends with the same weights and curves, bit
    for bit."""
    kind = TRAINERS.find("student_rgb")
    overrides = ["schedule.updates=4", "schedule.validate_every=4", "schedule.checkpoint_every=2"]
    config = training(student_corpus, "rgb", "batch=2", *overrides)

    def make_interrupted(config):
        trainer = kind.make(config)

        def interrupt(update: int) -> None:
            if update == 3:
                raise KeyboardInterrupt

        trainer.begin_update = interrupt
        return trainer

    run(config=config, out=tmp_path / "whole", make=kind.make)
    with pytest.raises(KeyboardInterrupt):
        run(config=config, out=tmp_path / "again", make=make_interrupted)
    run(config=config, out=tmp_path / "again", make=kind.make)
    with (
        np.load(tmp_path / "whole" / "student_rgb.npz") as whole,
        np.load(tmp_path / "again" / "student_rgb.npz") as again,
    ):
        for name in whole.files:
            np.testing.assert_array_equal(whole[name], again[name])
    curves = [(tmp_path / name / "curves.csv").read_text() for name in ("whole", "again")]
    assert curves[0] == curves[1]


def test_training_goes_on_from_weights_that_are_given(trained, student_corpus, tmp_path):
    """After one step too small to matter the weights are those of the file, not the seed's."""
    steps = ["schedule.updates=1", "schedule.validate_every=1", "schedule.checkpoint_every=1"]
    began = trained / "student_depth.npz"
    config = training(
        student_corpus, "depth", *steps, "schedule.learning_rate=1e-9", f"begin={began}"
    )
    run(config=config, out=tmp_path / "run", make=TRAINERS.find("student_depth").make)
    with np.load(began) as before, np.load(tmp_path / "run" / "student_depth.npz") as after:
        for name in set(before.files) - {"about"}:
            np.testing.assert_allclose(after[name], before[name], atol=1e-3)


def test_students_learn_to_keep_clear(trained, student_corpus, tmp_path):
    """What one lacks of its expert's clearance shrinks, from its weights on."""
    began = trained / "student_depth.npz"
    config = training(student_corpus, "depth", f"begin={began}", "clearance_weight=50.0")
    run(config=config, out=tmp_path, make=TRAINERS.find("student_depth").make)
    rows = list(csv.DictReader((tmp_path / "curves.csv").open()))
    lacking = [float(row["clearance"]) for row in rows]
    assert lacking[-1] < 0.7 * lacking[0]


def test_a_head_of_another_shape_begins_anew(trained, student_corpus, tmp_path):
    """What the encoder and the layer of its cells learned stays, frozen, and only the head and what
    it is told change; of another encoder weights are refused."""
    steps = ["schedule.updates=2", "schedule.validate_every=2", "schedule.checkpoint_every=2"]
    began = trained / "student_depth.npz"
    another = *steps, f"begin={began}", "frozen=20", "head_features=7"
    config = training(student_corpus, "depth", *another)
    config.features = str(tmp_path / "features")
    run(config=config, out=tmp_path / "run", make=TRAINERS.find("student_depth").make)
    with np.load(began) as before, np.load(tmp_path / "run" / "student_depth.npz") as after:
        for name in set(after.files) - {"about"}:
            seeing = name.startswith(("features.", "cell_layer."))
            same = before[name].shape == after[name].shape and (before[name] == after[name]).all()
            assert same == seeing, name
        assert after["hidden_layer.weight"].shape[0] == 7


def test_as_many_trajectories_vote_as_asked(student_corpus, tmp_path):
    """The pull of a sample is the sum over those that vote: where only the cheapest does it is less
    than half that of all three, which are much alike."""
    pulls = []
    for experts in (0, 1):
        steps = ["schedule.updates=1", "schedule.validate_every=1", "schedule.checkpoint_every=1"]
        config = training(student_corpus, "depth", *steps, f"experts={experts}")
        out = tmp_path / str(experts)
        run(config=config, out=out, make=TRAINERS.find("student_depth").make)
        (row,) = csv.DictReader((out / "curves.csv").open())
        pulls.append(float(row["winners"]))
    assert 0.2 * pulls[0] < pulls[1] < 0.5 * pulls[0]


def test_half_is_learned_in_a_mirror(student_corpus):
    """The pull of one sample is that of the waypoints that would be planned in flight, of the image
    as it is or in a mirror and mirrored back; over some samples it is of either."""
    overrides = ["batch=1", "mirrored=true", "epsilon=0"]
    trainer = TRAINERS.find("student_rgb").make(training(student_corpus, "rgb", *overrides))
    weights = {name: w.numpy() for name, w in trainer.network.state_dict().items()}
    network = StudentNetwork(trainer.spec, weights)
    pulls = []
    for shard in Corpus(student_corpus).shards:
        samples = shard.arrays
        for n in range(len(shard)):
            X_WB = RigidTransform(Quaternion(samples["X_WB"][n, :4]), samples["X_WB"][n, 4:])
            seen = samples["color"][n], X_WB, X_WB.rotation() @ samples["v_B"][n].astype(float)
            goal = X_WB @ samples["goal_B"][n].astype(float)
            plans = [plan(network, 0.0, *seen, goal, mirrored=side) for side in (False, True)]
            apart = [view.waypoints_B - samples["trajectories_B"][n, 0] for view in plans]
            pulls.append([np.square(a).sum((1, 2)).min() * 10.0 / 30.0 for a in apart])
    found = [float(trainer.losses()["winners"].detach()) for _ in range(20)]
    closest = np.abs(np.array(pulls)[..., None] / found - 1.0).reshape(-1, 2, 20).min(0)
    assert (closest.min(0) < 1e-3).all()
    assert 4 <= (closest.argmin(0) == 1).sum() <= 16


def test_frozen_modules_keep_the_weights_they_began_with(student_corpus, tmp_path):
    """Of an encoder read from a file all modules but the last are, in the weights that fly, what
    they were in the file, in half precision."""
    torch.manual_seed(0)
    encoder = mobilenet_v2().state_dict()
    for layer in (layer for block in mobilenet_blocks() for layer in block):
        torch.nn.init.kaiming_normal_(encoder[layer.weight])
    torch.save(encoder, tmp_path / "encoder.pt")
    overrides = [
        "pretrained=true",
        "frozen=18",
        f"encoder={tmp_path / 'encoder.pt'}",
        f"features={tmp_path / 'features'}",
        "schedule.updates=3",
        "schedule.checkpoint_every=2",
    ]
    config = training(student_corpus, "depth", *overrides)
    run(config=config, out=tmp_path / "run", make=TRAINERS.find("student_depth").make)
    began = imagenet_weights(str(tmp_path / "encoder.pt"))
    with np.load(tmp_path / "run" / "student_depth.npz") as weights:
        for name, value in began.items():
            same = np.array_equal(weights[name], value.half())
            assert same == (not name.startswith("features.18"))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("corpora=[]", "corpora is empty"),
        ("held_out=1", r"held_out is 1\.0; it must be 0 to 0\.9"),
        ("worlds=-1", "worlds is -1; it must be at least 0"),
        ("frozen=21", "frozen is 21; there are 0 to 20 modules"),
        ("frozen=20", "set begin to a file of weights"),
        ("draws=0", "draws is 0; it must be at least 1"),
        ("handicap=0.5", "handicap is 0.5; it must be at least 1"),
        ("frozen=3", "set pretrained=true or frozen=0"),
        ("noise.latency=0.1", r"noise\.latency must be left out, got 0\.1"),
        ("appearance.hue=200", r"appearance\.hue is 200"),
        ("corpora=[absent]", r"absent holds no corpus"),
    ],
)
def test_configurations_out_of_range_are_refused(override, message, student_corpus, tmp_path):
    """The field, its value and the remedy are named, before anything is trained."""
    config = training(student_corpus, "rgb", override)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        run(config=config, out=tmp_path / "out", make=TRAINERS.find("student_rgb").make)
