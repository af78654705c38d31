import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.systems.policies import agile_autonomy as agile_policy
from splatpilot.systems.policies import base as policy_base
from splatpilot.systems.policies import depthnav as depthnav_policy
from splatpilot.systems.policies import diffaero as diffaero_policy
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK, DiffAeroTofConfig
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS
from splatpilot.systems.policies.recurrent_network import RecurrentNetwork
from splatpilot.systems.policies.velocity import tracking_acceleration
from splatpilot.systems.sensing.time_of_flight import sensor_of, time_of_flight_grid
from splatpilot.systems.vehicle.state import QuadrotorState
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


def weights_of(module: torch.nn.Module) -> dict[str, np.ndarray]:
    return {name: w.detach().numpy() for name, w in module.state_dict().items()}


def vehicle() -> BodyRate:
    rng = np.random.default_rng(0)
    state = rng.normal(size=(1, 13))
    state[0, 6:10] = RollPitchYaw(0.3, -0.2, 2.0).ToQuaternion().wxyz()
    return BodyRate(torch.tensor(state, dtype=torch.float32), torch.zeros(1, 3))


def observed(depth: np.ndarray, body: BodyRate) -> Observation:
    return Observation(
        torch.tensor(depth).reshape(1, -1),
        body,
        torch.tensor(P_WG, dtype=torch.float32)[None],
        torch.tensor([2.0]),
    )


def flown(state: np.ndarray, image: np.ndarray) -> policy_base.Observation:
    X_WB = RigidTransform(RollPitchYaw(0.3, -0.2, 2.0), state[:3])
    return policy_base.Observation(1.0, X_WB, QuadrotorState.of(state), P_WG, image)


def test_policy_of_time_of_flight_flies_as_it_was_trained():
    torch.manual_seed(1)
    learner = DiffAeroTofLearner(DiffAeroLoss())
    with torch.no_grad():
        learner.network.head.weight.mul_(10.0)
    network = RecurrentNetwork(DIFFAERO_NETWORK, weights_of(learner.network))
    body, sensor = vehicle(), sensor_of(DiffAeroTofConfig().camera)
    state = body.state[0].double().numpy()
    memory, hidden = learner.initial_memory(1), network.initial_hidden()
    for seed in range(3):
        depth = np.random.default_rng(seed).uniform(0.0, 50.0, (36, 64)).astype(np.float32)
        depth[0, 0], depth[1, 1] = 0.0, np.inf
        with torch.no_grad():
            a_cmd, _, memory = learner.decide(observed(depth, body), memory)
        grid = time_of_flight_grid(depth, sensor)
        seen, limits = flown(state, grid), diffaero_policy.VELOCITY_LIMITS
        v_wanted, hidden = diffaero_policy.decide(network, grid, seen, 2.0, hidden, limits)
        a_WB = tracking_acceleration(state[3:6], v_wanted)
        np.testing.assert_allclose(a_WB, a_cmd[0].numpy(), atol=2e-4)
        np.testing.assert_allclose(hidden, memory[0].numpy(), atol=1e-5)
        assert np.abs(a_WB).max() > 0.01 and 0.1 < grid.mean() < 0.9


@pytest.mark.parametrize("name", ["diffaero", "depthnav"])
def test_what_flies_is_what_was_trained(name):
    torch.manual_seed(1)
    if name == "diffaero":
        learner = DiffAeroLearner(DiffAeroLoss())
    else:
        learner = DepthNavLearner(DepthNavLoss())
    spec = learner.network.spec
    with torch.no_grad():
        learner.network.head.weight.mul_(10.0)
    network = RecurrentNetwork(spec, weights_of(learner.network))
    body = vehicle()
    state = body.state[0].double().numpy()
    memory, hidden = learner.initial_memory(1), network.initial_hidden()
    start_yaw = 2.0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        depth = rng.uniform(0.0, 25.0, (spec.image_height, spec.image_width)).astype(np.float32)
        depth[0, 0], depth[1, 1] = 0.0, np.inf
        with torch.no_grad():
            a_cmd, heading, memory = learner.decide(observed(depth, body), memory)
        fine = depth.repeat(4, axis=0).repeat(4, axis=1)  # pooled back to the same
        if name == "diffaero":
            grid = diffaero_policy.depth_grid(fine)
            a_WB, hidden = diffaero_policy.decide(network, grid, flown(state, fine), 2.0, hidden)
        else:
            seen = flown(state, fine)
            decision = depthnav_policy.decide(network, seen, 2.0, start_yaw, hidden)
            a_WB, hidden = decision.a_WB, decision.memory
            assert heading is not None
            assert float(heading[0]) == pytest.approx(decision.heading, abs=1e-4)
        np.testing.assert_allclose(a_WB, a_cmd[0].numpy(), atol=2e-4)
        np.testing.assert_allclose(hidden, memory[0, : spec.hidden_size].numpy(), atol=1e-5)
        assert np.abs(a_WB).max() > 0.01


def test_trajectories_that_fly_are_those_trained():
    torch.manual_seed(2)
    module = TrajectoryModule(agile_policy.AGILE_NETWORK)
    agent = AgileAutonomyAgent(module)
    network = agile_policy.TrajectoryNetwork(agile_policy.AGILE_NETWORK, weights_of(module))
    body = vehicle()
    state = body.state[0].double().numpy()
    depth = np.random.default_rng(0).uniform(0.0, 25.0, (24, 32)).astype(np.float32)
    with torch.no_grad():
        waypoints, costs = agent.hypotheses(observed(depth, body))
    found = agile_policy.plan(network, flown(state, depth), 2.0, None)
    assert found.waypoints_B.shape == (3, NUM_WAYPOINTS, 3)
    np.testing.assert_allclose(found.waypoints_B, waypoints[0].numpy(), atol=1e-4)
    np.testing.assert_allclose(found.costs, costs[0].numpy(), atol=1e-4)


def test_quaternions_of_rotations():
    angles = [(0, 0, 0), (np.pi, 0, 0), (0, np.pi, 0), (0, 0, np.pi), (0.3, -2.0, 1.0), (3, 1, -2)]
    for roll, pitch, yaw in angles:
        rpy = RollPitchYaw(roll, pitch, yaw)
        q = rpy.ToQuaternion().wxyz()
        q = q if q[0] >= 0 else -q
        R = torch.tensor(rpy.ToRotationMatrix().matrix(), dtype=torch.float32)[None]
        found = quaternion_from_rotation(R)[0].numpy()
        assert min(np.abs(found - q).max(), np.abs(found + q).max()) < 1e-5
        assert found[0] >= -1e-6
