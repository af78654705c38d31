from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.policies import agile_autonomy as agile_policy
from splatpilot.systems.policies import depthnav as depthnav_policy
from splatpilot.systems.policies import diffaero as diffaero_policy
from splatpilot.systems.policies.agile_autonomy import AgileAutonomy, AgileAutonomyConfig
from splatpilot.systems.policies.base import Observation
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.depthnav import DepthNav, DepthNavConfig
from splatpilot.systems.policies.diffaero import (
    DiffAero,
    DiffAeroConfig,
    DiffAeroTof,
    DiffAeroTofConfig,
)
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.policies.observations import pool_depth
from splatpilot.systems.policies.recurrent_network import RecurrentNetwork
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state

SPECS = {
    "diffaero": diffaero_policy.DIFFAERO_NETWORK,
    "depthnav": depthnav_policy.DEPTHNAV_NETWORK,
    "agile_autonomy": agile_policy.AGILE_NETWORK,
}
SYSTEMS = {
    "diffaero": (DiffAero, DiffAeroConfig),
    "depthnav": (DepthNav, DepthNavConfig),
    "agile_autonomy": (AgileAutonomy, AgileAutonomyConfig),
}
P_WG = np.array([12.0, 3.0, 2.0])


def weights(name: str) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        key: rng.normal(scale=0.1, size=shape).astype(np.float32)
        for key, shape in SPECS[name].weight_shapes().items()
    }


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("weights")
    paths = {name: str(folder / f"{name}.npz") for name in SPECS}
    for name, path in paths.items():
        PolicyCheckpoint(name, SPECS[name], weights(name), {}).save(Path(path))
    return paths


def state() -> np.ndarray:
    state = hover_state([1.0, 2.0, 1.5], yaw=0.6)
    state[3:6] = [1.0, 0.3, 0.1]
    state[10:13] = [0.1, -0.2, 0.3]
    return state


def depth_of(config) -> np.ndarray:
    rng = np.random.default_rng(1)
    return rng.uniform(0.5, 15.0, (config.camera.height, config.camera.width)).astype(np.float32)


def observation(image: np.ndarray) -> Observation:
    x = state()
    return Observation(0.0, pose_from_state(x), QuadrotorState.of(x), P_WG, image)


def simulator_of(system, config) -> Simulator:
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("state").FixValue(context, state())
    system.GetInputPort("goal").FixValue(context, P_WG)
    image = ImageDepth32F(config.camera.width, config.camera.height)
    image.mutable_data[..., 0] = depth_of(config)
    system.GetInputPort("depth_image_32f").FixValue(context, Value(image))
    simulator.Initialize()
    return simulator


@pytest.mark.parametrize("name", ["diffaero", "depthnav"])
def test_recurrent_policy_decides_and_remembers_at_its_rate(name, files):
    make, configure = SYSTEMS[name]
    config = configure(weights=files[name], speed=1.7)
    system = make(config)
    network = RecurrentNetwork(SPECS[name], weights(name))
    seen, memory = observation(depth_of(config)), network.initial_hidden()
    a_WB, heading = np.zeros(3), np.nan
    for _ in range(3):
        if name == "diffaero":
            grid = diffaero_policy.depth_grid(seen.image)
            a_WB, memory = diffaero_policy.decide(network, grid, seen, 1.7, memory)
        else:
            a_WB, heading, memory = depthnav_policy.decide(network, seen, 1.7, 0.6, memory)
    for _ in range(2):
        simulator = simulator_of(system, config)
        simulator.AdvanceTo(2.5 / config.rate)
        context = simulator.get_context()
        found = system.GetOutputPort("acceleration").Eval(context)
        np.testing.assert_allclose(found, a_WB, rtol=0, atol=1e-9)
        if name == "depthnav":
            found = system.GetOutputPort("heading").Eval(context)
            assert float(found[0]) == pytest.approx(heading, abs=1e-9)


def test_policy_of_time_of_flight_decides_and_remembers_at_its_rate(tmp_path):
    file = tmp_path / "mine.npz"
    spec = diffaero_policy.DIFFAERO_NETWORK
    PolicyCheckpoint("diffaero_tof", spec, weights("diffaero"), {}).save(file)
    config = DiffAeroTofConfig(weights=str(file), speed=1.7)
    system, network = DiffAeroTof(config), RecurrentNetwork(spec, weights("diffaero"))
    grid = np.random.default_rng(1).uniform(size=(9, 16))
    velocity, memory = np.zeros(3), network.initial_hidden()
    for _ in range(3):
        velocity, memory = diffaero_policy.decide(
            network, grid, observation(grid), 1.7, memory, diffaero_policy.VELOCITY_LIMITS
        )
    for _ in range(2):
        simulator = Simulator(system)
        context = simulator.get_mutable_context()
        for name, value in (("state", state()), ("goal", P_WG), ("depth_grid", grid.ravel())):
            system.GetInputPort(name).FixValue(context, value)
        simulator.Initialize()
        simulator.AdvanceTo(2.5 / config.rate)
        found = system.velocity_output_port().Eval(context)
        np.testing.assert_allclose(found, velocity, rtol=0, atol=1e-9)


def test_trajectory_policy_plans_at_its_rate(files):
    config = AgileAutonomyConfig(weights=files["agile_autonomy"])
    system = AgileAutonomy(config)
    simulator = simulator_of(system, config)
    simulator.AdvanceTo(1.5 / config.rate)
    vector = np.array(system.GetOutputPort("hypotheses").Eval(simulator.get_context()))
    found = Hypotheses.from_vector(vector, 3)
    assert found is not None and found.plan_time == pytest.approx(1.0 / config.rate)
    network = agile_policy.TrajectoryNetwork(SPECS["agile_autonomy"], weights("agile_autonomy"))
    expected = agile_policy.plan(network, observation(depth_of(config)), 2.0, None)
    np.testing.assert_allclose(found.waypoints_B, expected.waypoints_B, atol=1e-9)


def test_near_ties_continue_the_last_plan(files):
    way = np.linspace(0.1, 1.0, 10)[:, None]
    left, right, far = way * [1.0, 1.0, 0.0], way * [1.0, -1.0, 0.0], way * [0.0, 0.0, 1.0]
    X_WB = pose_from_state(hover_state([0, 0, 2]))
    last = Hypotheses(0.0, X_WB, np.stack([right, left, far]), np.array([0.1, 0.5, 0.9]))

    def followed(costs) -> int:
        new = Hypotheses(0.1, X_WB, np.stack([left, right, far]), np.array(costs))
        return agile_policy.prefer_continuation(new, last).best

    assert followed([0.100, 0.101, 0.9]) == 1
    assert followed([0.100, 0.900, 0.9]) == 0
    assert followed([0.100, 0.900, 0.101]) in (0, 2)


def test_progress_is_worth_some_cost():
    class Equal(agile_policy.TrajectoryNetwork):
        def __call__(self, image, state):
            way = np.linspace(0.1, 1.0, 10)[:, None] * [1, 0, 0]
            return np.stack([0.2 * way, way, -way]), np.full(3, 0.3)

    network = Equal(SPECS["agile_autonomy"], weights("agile_autonomy"))
    x = hover_state([0, 0, 2])
    depth = np.full((24, 32), 9.0)
    seen = Observation(0.0, pose_from_state(x), QuadrotorState.of(x), np.array([9, 0, 2]), depth)
    plan = agile_policy.plan(network, seen, 2.0, None)
    np.testing.assert_allclose(plan.costs, [0.28, 0.2, 0.4])


@pytest.mark.parametrize("name", SYSTEMS)
def test_cameras_that_cannot_be_pooled_are_refused(name, files):
    make, configure = SYSTEMS[name]
    config = configure(weights=files[name], camera=OnboardCamera(width=50, height=30))
    with pytest.raises(ValueError, match=r"whole multiples of .* got 50x30"):
        make(config)
    with pytest.raises(ValueError, match=r"speed .* got 0"):
        make(configure(weights=files[name], speed=0.0))


def test_pooling_keeps_the_nearest():
    depth = np.full((4, 6), 9.0)
    depth[1, 1], depth[3, 5], depth[0, 4] = 2.0, 0.0, np.inf
    np.testing.assert_array_equal(pool_depth(depth, 2, 3), [[2.0, 9.0, 9.0], [9.0, 9.0, 0.0]])
