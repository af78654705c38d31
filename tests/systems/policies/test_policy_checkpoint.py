import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatpilot.systems.policies.checkpoint import OnnxModel, PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.systems.policies.recurrent_network import RecurrentNetwork, load_network
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


def test_what_is_saved_is_loaded(path):
    loaded = PolicyCheckpoint.load(path, "diffaero", DIFFAERO_NETWORK)
    assert loaded.provenance == {"seed": 3} and loaded.spec == DIFFAERO_NETWORK
    for name, value in some_weights().items():
        np.testing.assert_array_equal(loaded.weights[name], value)


def test_other_files_are_refused_with_the_remedy(path, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no weights at .*none.npz; train them with"):
        load_network(str(tmp_path / "none.npz"), "diffaero", DIFFAERO_NETWORK)
    with pytest.raises(ValueError, match="'diffaero' in format 1, but needed is 'depthnav'"):
        load_network(str(path), "depthnav", DIFFAERO_NETWORK)
    wider = replace(DIFFAERO_NETWORK, hidden_size=96)
    with pytest.raises(ValueError, match=r"another architecture \(hidden_size 128 instead of 96"):
        load_network(str(path), "diffaero", wider)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"policy.npz holds no weights of a policy"):
        load_network(str(path), "diffaero", DIFFAERO_NETWORK)


def test_weights_of_another_kind_name_the_file(path):
    name, weight = next(iter(some_weights().items()))
    for other, message in (
        ({}, "missing, but must be of shape"),
        ({name: weight[:1]}, "but must be of shape"),
        ({name: weight * np.nan}, "not all finite numbers"),
        ({name: weight + np.float32(1e9)}, "not all finite numbers"),
        ({name: weight.astype(complex)}, "not all finite numbers"),
    ):
        weights = {key: value for key, value in some_weights().items() if key != name} | other
        PolicyCheckpoint("diffaero", DIFFAERO_NETWORK, weights, {}).save(path)
        with pytest.raises(ValueError, match=rf"policy.npz: the weights {name} are .*{message}"):
            load_network(str(path), "diffaero", DIFFAERO_NETWORK)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"width": -160}, "width must be .*, got -160"),
        ({"height": 10**9}, "height must be .*, got 1000000000"),
        ({"fov_x": "wide"}, "fov_x must be .*, got wide"),
        ({"observation": "smell"}, "observation must be .*, got smell"),
        ({"nose": 1}, "nose"),
        ([], "no spec"),
    ],
)
def test_architectures_that_cannot_be_are_refused(tmp_path, spec, message):
    path = tmp_path / "student.npz"
    spec = {"way_version": 2} | spec if isinstance(spec, dict) else spec
    about = {"format": 1, "policy": "student_depth", "spec": spec, "provenance": {}}
    np.savez(path, about=json.dumps(about))
    with pytest.raises(ValueError, match=rf"student.npz holds .*{message}"):
        load_student(str(path), "depth")


def test_weights_that_cannot_fly_are_refused():
    weights = some_weights()
    without = {name: value for name, value in weights.items() if name != "head.bias"}
    with pytest.raises(ValueError, match=r"head.bias are missing"):
        RecurrentNetwork(DIFFAERO_NETWORK, without)
    with pytest.raises(ValueError, match=r"head.bias are \(4,\), but must be of shape \(3,\)"):
        RecurrentNetwork(DIFFAERO_NETWORK, weights | {"head.bias": np.zeros(4)})
    with pytest.raises(ValueError, match=r"head.bias are not all finite"):
        RecurrentNetwork(DIFFAERO_NETWORK, weights | {"head.bias": np.full(3, np.nan)})


def test_observations_of_the_wrong_size_are_refused():
    network = RecurrentNetwork(DIFFAERO_NETWORK, some_weights())
    image, state = np.zeros((9, 16)), np.zeros(9)
    with pytest.raises(ValueError, match=r"image has shape \(16, 9\), .* takes \(9, 16\)"):
        network.step(image.T, state, network.initial_hidden())
    with pytest.raises(ValueError, match=r"state has shape \(8,\)"):
        network.step(image, state[:8], network.initial_hidden())


def convolved(x: np.ndarray, weight: np.ndarray, bias: np.ndarray, stride: int) -> np.ndarray:
    outputs, within, kernel, _ = weight.shape
    pad, groups = kernel // 2, x.shape[0] // within
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    height, width = (-(-size // stride) for size in x.shape[1:])
    y = np.zeros((outputs, height, width))
    for o in range(outputs):
        first = (o // (outputs // groups)) * within
        for i in range(height):
            for j in range(width):
                patch = padded[first : first + within, i * stride :, j * stride :]
                y[o, i, j] = (patch[:, :kernel, :kernel] * weight[o]).sum() + bias[o]
    return y


def test_model_computes_what_was_put_in():
    rng = np.random.default_rng(0)
    image = rng.normal(size=(4, 7, 9)).astype(np.float32)
    layers = [(6, 4, 3, 2, 1), (6, 1, 3, 1, 6), (6, 6, 1, 1, 1)]
    model, x = OnnxModel((4, 7, 9)), image.astype(float)
    before, y = "", x
    for n, (outputs, within, kernel, stride, groups) in enumerate(layers):
        weight = rng.normal(size=(outputs, within, kernel, kernel)).astype(np.float32)
        bias = rng.normal(size=outputs).astype(np.float32)
        model.convolution(weight, bias, stride=stride, groups=groups)
        x = convolved(x, weight, bias, stride)
        if n == 0:
            model.clip(0.0, 2.5)
            x = y = np.clip(x, 0.0, 2.5)
            before = model.output
    model.add(before)
    net = cv2.dnn.readNetFromONNX(model.serialize((6, 4, 5)))
    net.setInput(image[None])
    np.testing.assert_allclose(net.forward()[0], x + y, atol=1e-4)
