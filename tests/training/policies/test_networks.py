from pathlib import Path

import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform, RollPitchYaw
from torchvision.models import mobilenet_v2

from splatpilot.systems.policies import agile_autonomy, base, depthnav, diffaero, student
from splatpilot.systems.policies.networks import RecurrentNetwork
from splatpilot.systems.policies.velocity import tracking_acceleration
from splatpilot.systems.sensing.time_of_flight import equivalent_sensor, time_of_flight_grid
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state
from splatpilot.training.policies import networks, train_depthnav
from splatpilot.training.policies.train_agile_autonomy import AgileAutonomyAgent
from splatpilot.training.policies.train_diffaero import (
    DiffAeroLearner,
    DiffAeroLoss,
    DiffAeroTofLearner,
)
from splatpilot.training.policies.train_student import encode_images
from splatpilot.training.policies.vehicles import BodyRate, Observation

P_WG = np.array([9.0, 2.0, 1.5])
STATE = np.random.default_rng(0).normal(size=13)
STATE[6:10] = RollPitchYaw(0.3, -0.2, 2.0).ToQuaternion().wxyz()
STATE = STATE.astype(np.float32).astype(float)
BODY = BodyRate(torch.tensor(STATE, dtype=torch.float32)[None], torch.zeros(1, 3))


def weights_of(module: torch.nn.Module) -> dict[str, np.ndarray]:
    return {name: w.detach().numpy() for name, w in module.state_dict().items()}


def trained(depth: np.ndarray) -> Observation:
    goal = torch.tensor(P_WG, dtype=torch.float32)[None]
    return Observation(torch.tensor(depth).reshape(1, -1), BODY, goal, torch.tensor([2.0]))


def flown(image: np.ndarray) -> base.Observation:
    return base.Observation(1.0, pose_from_state(STATE), QuadrotorState.of(STATE), P_WG, image)


def fly_diffaero(network, depth, hidden):
    seen = flown(depth.repeat(4, 0).repeat(4, 1))  # pooled to the same
    image = diffaero.encode_depth(seen.image)
    a_WB, hidden = diffaero.compute_command(network, image, seen, 2.0, hidden)
    return a_WB, None, hidden


def fly_diffaero_tof(network, depth, hidden):
    seen = flown(time_of_flight_grid(depth, equivalent_sensor(diffaero.DiffAeroTofConfig().camera)))
    limits = diffaero.VELOCITY_LIMITS
    v_WB, hidden = diffaero.compute_command(network, seen.image, seen, 2.0, hidden, limits)
    return tracking_acceleration(seen.state.v_WB, v_WB), None, hidden


def fly_depthnav(network, depth, hidden):
    seen = flown(depth.repeat(4, 0).repeat(4, 1))
    return depthnav.compute_command(network, seen, 2.0, 2.0, hidden)


@pytest.mark.parametrize(
    ("learner", "loss", "fly", "shape"),
    [
        (DiffAeroLearner, DiffAeroLoss, fly_diffaero, (9, 16)),
        (DiffAeroTofLearner, DiffAeroLoss, fly_diffaero_tof, (36, 64)),
        (train_depthnav.DepthNavLearner, train_depthnav.DepthNavLoss, fly_depthnav, (12, 16)),
    ],
)
def test_recurrent_policies_fly_as_trained(learner, loss, fly, shape):
    torch.manual_seed(1)
    learner = learner(loss())
    with torch.no_grad():
        learner.network.head.weight.mul_(10.0)
    network = RecurrentNetwork(learner.network.spec, weights_of(learner.network))
    memory, hidden = learner.initial_memory(1), network.initial_hidden()
    for seed in range(3):
        depth = np.random.default_rng(seed).uniform(0.0, 25.0, shape).astype(np.float32)
        depth[0, 0], depth[1, 1] = 0.0, np.inf
        with torch.no_grad():
            a_cmd, heading, memory = learner.decide(trained(depth), memory)
        a_WB, found, hidden = fly(network, depth, hidden)
        np.testing.assert_allclose(a_WB, a_cmd[0].numpy(), atol=2e-4)
        np.testing.assert_allclose(hidden, memory[0, : len(hidden)].numpy(), atol=1e-5)
        assert np.abs(a_WB).max() > 0.01
        assert (found is None) == (heading is None)
        assert heading is None or found == pytest.approx(float(heading[0]), abs=1e-4)


def test_trajectories_fly_as_trained():
    torch.manual_seed(2)
    module = networks.TrajectoryModule(agile_autonomy.AGILE_NETWORK)
    network = agile_autonomy.TrajectoryNetwork(agile_autonomy.AGILE_NETWORK, weights_of(module))
    depth = np.random.default_rng(0).uniform(0.0, 25.0, (24, 32)).astype(np.float32)
    with torch.no_grad():
        waypoints, costs = AgileAutonomyAgent(module).hypotheses(trained(depth))
    found = agile_autonomy.plan(network, flown(depth), 2.0, None)
    np.testing.assert_allclose(found.waypoints_B, waypoints[0].numpy(), atol=1e-4)
    np.testing.assert_allclose(found.costs, costs[0].numpy(), atol=1e-4)


@pytest.mark.parametrize(
    "rpy", [(0, 0, 0), (np.pi, 0, 0), (0, np.pi, 0), (0, 0, np.pi), (0.3, -2.0, 1.0), (3, 1, -2)]
)
def test_quaternions_of_rotations(rpy):
    q = RollPitchYaw(rpy).ToQuaternion().wxyz()
    R = torch.tensor(RollPitchYaw(rpy).ToRotationMatrix().matrix(), dtype=torch.float32)[None]
    found = train_depthnav.quaternion_from_rotation(R)[0].numpy()
    assert min(np.abs(found - q).max(), np.abs(found + q).max()) < 1e-5
    assert found[0] >= -1e-6


@pytest.mark.parametrize("observation", ["rgb", "depth"])
@pytest.mark.parametrize("size", [(64, 48), (80, 70)])
def test_flight_computes_what_training_computes(observation, size):
    torch.manual_seed(0)
    spec = student.StudentSpec(observation, *size, head_features=20, nominal_speed=2.6)
    module = networks.StudentModule(spec)
    for name, values in module.named_parameters():
        if name.endswith("bias"):  # so that none may be forgotten
            torch.nn.init.normal_(values, 0.0, 0.1)
    weights = weights_of(module)
    assert {name: w.shape for name, w in weights.items()} == spec.weight_shapes()
    network, rng = student.StudentNetwork(spec, weights), np.random.default_rng(0)
    image = rng.integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
    if observation == "depth":
        image = rng.uniform(0.2, 25.0, (size[1], size[0])).astype(np.float16).astype(np.float32)
        image[0, 0], image[1, 1] = 0.0, np.inf
    rotation, p_WB, v_WB = RollPitchYaw(0.3, -0.2, 2.0), rng.normal(size=3), rng.normal(size=3)
    X_WB, still = RigidTransform(rotation, p_WB), np.zeros(3)
    R_WB = X_WB.rotation().matrix()
    for p_WG in np.array([[4.0, 2.0, 1.5], [1.0, -2.0, 0.5], [0.0, 0.0, 0.0]]):
        labels = (R_WB, R_WB.T @ v_WB, R_WB.T @ (p_WG - p_WB))
        state = student.encode_state(*(torch.tensor(x).float()[None] for x in labels), spec.reach)
        with torch.no_grad():
            waypoints, costs = module(encode_images(torch.from_numpy(image[None]).float()), state)
        state = QuadrotorState(p_WB, v_WB, rotation.ToQuaternion().wxyz(), still)
        found = student.plan(network, base.Observation(0.5, X_WB, state, p_WG, image))
        np.testing.assert_allclose(found.waypoints_B, waypoints[0], atol=1e-4)
        np.testing.assert_allclose(found.costs, costs[0], atol=1e-4)
        assert np.ptp(found.costs) > 1e-3 and found.plan_time == 0.5


def test_images_of_another_size_are_refused():
    spec = student.StudentSpec("depth", 64, 48)
    weights = {name: np.zeros(shape, np.float32) for name, shape in spec.weight_shapes().items()}
    message = r"must be \(3, 48, 64\), got \(3, 48, 65\); give it a camera of 64x48"
    with pytest.raises(ValueError, match=message):
        student.StudentNetwork(spec, weights)(np.zeros((3, 48, 65), np.float32), np.zeros(6))


@pytest.fixture
def encoder_file(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("SPLATPILOT_DATA", str(tmp_path))
    (tmp_path / networks.IN_DATA).parent.mkdir()
    return tmp_path / networks.IN_DATA


def test_batch_norms_and_scaling_are_folded(encoder_file):
    torch.manual_seed(0)
    theirs = mobilenet_v2()
    for module in theirs.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            for values in (module.weight, module.running_var):
                torch.nn.init.uniform_(values, 0.5, 1.5)
            for values in (module.bias, module.running_mean):
                torch.nn.init.normal_(values, 0.0, 0.1)
    torch.save(theirs.state_dict(), encoder_file)
    image = torch.rand(1, 3, 64, 96)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    module = networks.StudentModule(student.StudentSpec(way_version=2))
    module.load_state_dict(networks.imagenet_weights(), strict=False)
    with torch.no_grad():
        first = theirs.eval().features[0]((image - mean[:, None, None]) / std[:, None, None])
        ours, rest = module.features[0](2.0 * image - 1.0), theirs.features[1:](first)
        torch.testing.assert_close(ours[..., 1:, 1:], first[..., 1:, 1:], atol=1e-5, rtol=0)
        torch.testing.assert_close(module.features[1:](first), rest, atol=1e-4, rtol=1e-3)


def test_other_files_are_refused(encoder_file, tmp_path, monkeypatch):
    torch.save({"layer.weight": torch.zeros(3)}, encoder_file)
    with pytest.raises(ValueError, match=r"imagenet\.pt: must be a state dictionary"):
        networks.imagenet_weights()
    encoder_file.unlink()
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"imagenet\.pt or .*7ebf99e0\.pth; download"):
        networks.imagenet_weights()
    (tmp_path / "checkpoints").mkdir()
    torch.save(mobilenet_v2().state_dict(), tmp_path / "checkpoints/mobilenet_v2-7ebf99e0.pth")
    assert networks.imagenet_weights().keys() == student.mobilenet_shapes().keys()
