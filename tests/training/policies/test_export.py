import cv2
import numpy as np
import pytest

from splatpilot.systems.policies import diffaero_rgb, student
from splatpilot.systems.policies.agile_autonomy import AGILE_NETWORK, TrajectoryNetwork
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint, shipped_weights
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.systems.policies.networks import leaky_relu
from splatpilot.training.policies.export import export


def distilled(view, state, hidden):
    network = diffaero_rgb.load_network(None, "distilled_rgb")
    inverse, _, *features = network.monocular(view)
    return network.policy.step(np.stack([inverse, *leaky_relu(np.array(features))]), state, hidden)


# The network of flights, which runs without torch, and the sizes of its inputs.
FLOWN = {
    "distilled_rgb": (lambda: distilled, (6, 90, 160), (9,), (DIFFAERO_NETWORK.hidden_size,)),
    "agile_autonomy": (
        lambda: PolicyCheckpoint.load("", "agile_autonomy", AGILE_NETWORK).build(TrajectoryNetwork),
        (24, 32),
        (18,),
    ),
    "student_rgb": (lambda: student.load_network("", "rgb"), (3, 120, 160), (9,)),
}


@pytest.mark.parametrize("policy", FLOWN)
def test_exported_network_computes_as_in_flight(policy, tmp_path):
    file, (load, *sizes) = tmp_path / "policy.onnx", FLOWN[policy]
    export(shipped_weights(policy), file)
    net, rng = cv2.dnn.readNetFromONNX(str(file)), np.random.default_rng(0)
    inputs = [rng.uniform(-0.5, 0.5, size).astype(np.float32) for size in sizes]
    for name, value in zip(("image", "state", "hidden"), inputs, strict=False):
        net.setInput(value[None], name)
    recurrent = len(sizes) == 3
    outputs = net.forward(["output", "next_hidden"] if recurrent else ["waypoints", "costs"])
    for found, expected in zip(outputs, load()(*inputs), strict=True):
        np.testing.assert_allclose(found[0], expected, atol=1e-4)


def test_policy_without_an_export_is_refused(tmp_path):
    with pytest.raises(ValueError, match="the policy 'diffaero_rgb' has no export"):
        export(shipped_weights("diffaero_rgb"), tmp_path / "policy.onnx")
