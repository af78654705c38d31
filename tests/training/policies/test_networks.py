import numpy as np
import pytest
import torch
from pydrake.math import RollPitchYaw

from splatpilot.systems.policies import agile_autonomy, base, depthnav, diffaero
from splatpilot.systems.policies.networks import RecurrentNetwork
from splatpilot.systems.policies.velocity import tracking_acceleration
from splatpilot.systems.sensing.time_of_flight import equivalent_sensor, time_of_flight_grid
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state
from splatpilot.training.policies.networks import TrajectoryModule
from splatpilot.training.policies.train_agile_autonomy import AgileAutonomyAgent
from splatpilot.training.policies.train_depthnav import (
    DepthNavLearner,
    DepthNavLoss,
    quaternion_from_rotation,
)
from splatpilot.training.policies.train_diffaero import (
    DiffAeroLearner,
    DiffAeroLoss,
    DiffAeroTofLearner,
)
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
    seen = flown(depth.repeat(4, axis=0).repeat(4, axis=1))  # pooled to the same
    a_WB, hidden = diffaero.compute_command(
        network, diffaero.encode_depth(seen.image), seen, 2.0, hidden
    )
    return a_WB, None, hidden


def fly_diffaero_tof(network, depth, hidden):
    seen = flown(time_of_flight_grid(depth, equivalent_sensor(diffaero.DiffAeroTofConfig().camera)))
    limits = diffaero.VELOCITY_LIMITS
    v_WB, hidden = diffaero.compute_command(network, seen.image, seen, 2.0, hidden, limits)
    return tracking_acceleration(seen.state.v_WB, v_WB), None, hidden


def fly_depthnav(network, depth, hidden):
    return depthnav.compute_command(
        network, flown(depth.repeat(4, 0).repeat(4, 1)), 2.0, 2.0, hidden
    )


@pytest.mark.parametrize(
    ("learner", "loss", "fly", "shape"),
    [
        (DiffAeroLearner, DiffAeroLoss, fly_diffaero, (9, 16)),
        (DiffAeroTofLearner, DiffAeroLoss, fly_diffaero_tof, (36, 64)),
        (DepthNavLearner, DepthNavLoss, fly_depthnav, (12, 16)),
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
        assert (
            found is None
            if heading is None
            else found == pytest.approx(float(heading[0]), abs=1e-4)
        )


def test_trajectories_fly_as_trained():
    torch.manual_seed(2)
    module = TrajectoryModule(agile_autonomy.AGILE_NETWORK)
    network = agile_autonomy.TrajectoryNetwork(agile_autonomy.AGILE_NETWORK, weights_of(module))
    depth = np.random.default_rng(0).uniform(0.0, 25.0, (24, 32)).astype(np.float32)
    with torch.no_grad():
        waypoints, costs = AgileAutonomyAgent(module).hypotheses(trained(depth))
    found = agile_autonomy.plan(network, flown(depth), 2.0, None)
    np.testing.assert_allclose(found.waypoints_B, waypoints[0].numpy(), atol=1e-4)
    np.testing.assert_allclose(found.costs, costs[0].numpy(), atol=1e-4)


@pytest.mark.parametrize(
    "rpy",
    [(0, 0, 0), (np.pi, 0, 0), (0, np.pi, 0), (0, 0, np.pi), (0.3, -2.0, 1.0), (3, 1, -2)],
)
def test_quaternions_of_rotations(rpy):
    rotation = RollPitchYaw(rpy)
    q = rotation.ToQuaternion().wxyz()
    R = torch.tensor(rotation.ToRotationMatrix().matrix(), dtype=torch.float32)[None]
    found = quaternion_from_rotation(R)[0].numpy()
    assert min(np.abs(found - q).max(), np.abs(found + q).max()) < 1e-5
    assert found[0] >= -1e-6
