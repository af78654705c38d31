import csv
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpilot.systems.common.config import load_config
from splatpilot.training.policies.train import TRAINERS, run
from splatpilot.training.policies.train_student import (
    StudentTraining,
    cost_targets,
    hypothesis_errors,
    imitation_terms,
    missing_clearances,
    penalties,
)

OVERRIDES = ["pretrained=false", "frozen=0", "held_out=0.2", "batch=8", "schedule.updates=25"]
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


def random(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_error_of_a_shifted_trajectory():
    expert = straight((2, 0, 0))[:, 0]
    errors = hypothesis_errors(expert, (expert + torch.tensor([0.0, 0.3, 0.4]))[:, None])
    assert errors.item() == pytest.approx(10 / 3 * 0.25)


def test_gradients_are_those_of_finite_differences():
    expert, waypoints = random(0, 2, 3, 3), random(1, 2, 3, 3, 3).requires_grad_()
    distances = (1.0 + 0.3 * random(2, 2, 3, 3)).requires_grad_()
    check, kept = torch.autograd.gradcheck, 0.8 + 0.3 * random(5, 2, 3)
    assert check(lambda w: imitation_terms(hypothesis_errors(expert, w), 0.05), waypoints)
    assert check(lambda d: missing_clearances(d, kept), distances)
    assert check(lambda w, d: penalties(hypothesis_errors(expert, w), d), (waypoints, distances))
