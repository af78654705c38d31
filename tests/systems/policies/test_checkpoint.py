import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.systems.policies.networks import RecurrentNetwork, load_network
from splatpilot.systems.policies.student import load_network as load_student


def some_weights(spec=DIFFAERO_NETWORK) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        name: rng.normal(scale=0.1, size=shape).astype(np.float32)
        for name, shape in spec.weight_shapes().items()
    }


@pytest.fixture
def path(tmp_path) -> Path:
    path = tmp_path / "policy.npz"
    PolicyCheckpoint("diffaero", DIFFAERO_NETWORK, some_weights(), {"seed": 3}).save(path)
    return path


def test_round_trip(path):
    loaded = PolicyCheckpoint.load(path, "diffaero", DIFFAERO_NETWORK)
    assert loaded.provenance == {"seed": 3} and loaded.spec == DIFFAERO_NETWORK
    for name, value in some_weights().items():
        np.testing.assert_array_equal(loaded.weights[name], value)


def test_other_files_are_refused_with_the_remedy(path, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"No such file .*none.npz; train them with"):
        load_network(str(tmp_path / "none.npz"), "diffaero", DIFFAERO_NETWORK)
    with pytest.raises(ValueError, match="must be 'depthnav' in format 1, got 'diffaero'"):
        load_network(str(path), "depthnav", DIFFAERO_NETWORK)
    wider = replace(DIFFAERO_NETWORK, hidden_size=96)
    with pytest.raises(ValueError, match=r"policy.npz: hidden_size must be 96, got 128"):
        load_network(str(path), "diffaero", wider)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"policy.npz must hold weights of a policy"):
        load_network(str(path), "diffaero", DIFFAERO_NETWORK)


@pytest.mark.parametrize(
    ("change", "condition"),
    [
        (lambda weight: None, "of shape"),
        (lambda weight: weight[:1], "of shape"),
        (lambda weight: weight * np.nan, "finite numbers"),
        (lambda weight: weight + np.float32(1e9), "finite numbers"),
        (lambda weight: weight.astype(complex), "finite numbers"),
    ],
)
def test_invalid_weights_are_refused(path, change, condition):
    weights = some_weights()
    name, weight = next(iter(weights.items()))
    weights |= {name: change(weight)}
    weights = {key: value for key, value in weights.items() if value is not None}
    PolicyCheckpoint("diffaero", DIFFAERO_NETWORK, weights, {}).save(path)
    with pytest.raises(ValueError, match=rf"policy.npz: the weights {name} must be {condition}"):
        load_network(str(path), "diffaero", DIFFAERO_NETWORK)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"width": -160}, "the weights .* must be of shape"),
        ({"nominal_speed": -1.0}, "nominal_speed must be > 0, got -1.0"),
        ({"observation": "smell"}, "observation must be .*, got smell"),
        ({"nose": 1}, "nose"),
        ({"way_version": 1}, "way_version must be 2, got 1"),
        ([], "spec must be of type dict"),
    ],
)
def test_invalid_architectures_are_refused(tmp_path, spec, message):
    path = tmp_path / "student.npz"
    spec = {"way_version": 2} | spec if isinstance(spec, dict) else spec
    about = {"format": 1, "policy": "student_depth", "spec": spec, "provenance": {}}
    np.savez(path, about=json.dumps(about))
    with pytest.raises(ValueError, match=rf"student.npz.*{message}"):
        load_student(str(path), "depth")


def test_observations_of_the_wrong_size_are_refused():
    network = RecurrentNetwork(DIFFAERO_NETWORK, some_weights())
    image, state = np.zeros((9, 16)), np.zeros(9)
    with pytest.raises(ValueError, match=r"image must be \(9, 16\), got \(16, 9\)"):
        network.step(image.T, state, network.initial_hidden())
    with pytest.raises(ValueError, match=r"state must be \(9,\), got \(8,\)"):
        network.step(image, state[:8], network.initial_hidden())
