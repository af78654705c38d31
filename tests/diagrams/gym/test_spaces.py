import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.gym import spaces

COUNT = 50


@pytest.fixture
def vehicles() -> spaces.Vehicles:
    generator = np.random.default_rng(0)
    states = generator.normal(size=(COUNT, 13))
    states[:, 6:10] /= np.linalg.norm(states[:, 6:10], axis=-1, keepdims=True)
    gradients = generator.normal(size=(COUNT, 3))
    gradients /= np.linalg.norm(gradients, axis=-1, keepdims=True)
    return spaces.Vehicles(
        states, generator.normal(size=(COUNT, 3)), generator.random(COUNT), gradients
    )


def rotations(vehicles: spaces.Vehicles) -> tuple[Rotation, Rotation]:
    """Returns R_WB and R_WH."""
    R_WB = Rotation.from_quat(vehicles.states[:, 6:10], scalar_first=True)
    ahead = R_WB.apply([1.0, 0.0, 0.0])
    return R_WB, Rotation.from_rotvec(np.arctan2(ahead[:, 1], ahead[:, 0])[:, None] * [0, 0, 1.0])


def test_observations_are_in_the_heading_frame(vehicles):
    observed = spaces.observe(spaces.OBSERVATIONS, vehicles)
    R_WB, R_WH = rotations(vehicles)
    state, to_goal = observed["state"], vehicles.p_WG - vehicles.states[:, :3]
    np.testing.assert_allclose(R_WH.apply(state[:, :3]), vehicles.states[:, 3:6], atol=1e-6)
    np.testing.assert_allclose(R_WH.apply(state[:, 3:6]), R_WB.apply([0, 0, 1.0]), atol=1e-6)
    np.testing.assert_allclose(state[:, 6:], vehicles.states[:, 10:], atol=1e-6)
    np.testing.assert_allclose(observed["full_state"], vehicles.states, atol=1e-6)
    direction, distance = observed["goal"][:, :3], 10.0 * observed["goal"][:, 3:]
    np.testing.assert_allclose(R_WH.apply(distance * direction), to_goal, atol=1e-5)
    away = R_WH.apply(observed["obstacle"][:, :3])
    np.testing.assert_allclose(away, vehicles.gradients, atol=1e-6)
    np.testing.assert_allclose(observed["obstacle"][:, 3], vehicles.distances, atol=1e-6)


def test_observations_stay_in_their_space_outside_of_the_world(vehicles):
    far = vehicles._replace(
        states=1e4 * vehicles.states,
        distances=np.full(COUNT, np.nan),
        gradients=np.zeros((COUNT, 3)),
    )
    space = spaces.observation_space(spaces.FlightEnvConfig(observation=spaces.OBSERVATIONS))
    for name, values in spaces.observe(spaces.OBSERVATIONS, far).items():
        assert all(value in space[name] for value in values), name


def test_depth_becomes_proximity():
    depth = np.array([[0.0, 3.0, 12.0, np.inf]], np.float32)
    np.testing.assert_array_equal(
        spaces.observe_image("depth", depth, 12.0)[..., 0], [[255, 191, 0, 0]]
    )
    np.testing.assert_array_equal(spaces.observe_image("depth_m", depth, 12.0), [[0, 3, 12, 12]])


@pytest.mark.parametrize("action", ["acceleration", "velocity", "waypoint"])
def test_actions_are_in_the_heading_frame(action, vehicles):
    config = spaces.FlightEnvConfig(action=action, action_limits=[1.0, 2.0, 3.0])
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (COUNT, 3))
    expected = rotations(vehicles)[1].apply(actions * [1.0, 2.0, 3.0])
    if action == "waypoint":
        expected = expected + vehicles.states[:, :3]
    np.testing.assert_allclose(
        spaces.decisions(config, actions, vehicles.states), expected, atol=1e-9
    )


def test_a_zero_command_hovers_and_others_are_scaled(vehicles):
    actions = np.zeros((COUNT, 4))
    actions[1] = [0.125, 0.5, -0.5, 0.25]
    commands = spaces.decisions(spaces.FlightEnvConfig(action="command"), actions, vehicles.states)
    expected = np.tile([9.81, 0.0, 0.0, 0.0], (COUNT, 1))
    expected[1] = [1.125 * 9.81, 3.0, -3.0, 0.5]
    np.testing.assert_allclose(commands, expected, atol=1e-12)


@pytest.mark.parametrize("value", [np.nan, 1.5, -np.inf])
def test_invalid_actions_are_errors(value):
    actions = np.zeros((2, 3))
    actions[1, 1] = value
    with pytest.raises(ValueError, match=rf"action must be in \[-1, 1\], got {value}"):
        spaces.require_actions(actions, (2, 3))
    with pytest.raises(ValueError, match=r"shape of action must be \(3,\), got \(2, 3\)"):
        spaces.require_actions(actions, (3,))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"action": "yaw"}, "action must be in {command"),
        ({"action_limits": [1.0]}, "action_limits must be 3 finite"),
        ({"action": "command", "action_limits": [20.0, 1, 1, 1]}, "action_limits must be at most"),
        ({"rate": 15.0}, "rate must be 50 Hz"),
        ({"observation": []}, "observation must be different"),
        ({"observation": ["goal", "goal"]}, "observation must be different"),
        ({"reward": 1.0}, "reward must be a function"),
        ({"actions": "velocity"}, "there is no argument 'actions'; did you mean"),
        ({"appearance": 1}, "there is no argument 'appear.*, fields of scenario, as appearance$"),
        ({"observation": ["depht"]}, r"observation must be one of state, .* got 'depht'"),
    ],
)
def test_invalid_configurations_are_errors(fields, message):
    with pytest.raises(ValueError, match=message):
        spaces.observation_space(spaces.env_config(Scenario(), **fields))


def test_one_name_makes_a_box():
    config = spaces.env_config("P01", observation="depth", action="command")
    assert spaces.observation_space(config).shape == (36, 64, 1)
    assert spaces.action_space(config).shape == (4,)


def test_rewards_sum_weighted_terms():
    next_states = np.zeros((3, 13))
    next_states[:, 0] = [1.0, 0.0, -0.5]
    transition = spaces.Transition(
        states=np.zeros((3, 13)),
        next_states=next_states,
        p_WG=np.tile([4.0, 0.0, 0.0], (3, 1)),
        distances=np.array([5.0, 0.354, np.nan]),
        actions=np.tile([1.0, 0.0, 0.0], (3, 1)),
        previous_actions=np.zeros((3, 3)),
        reached=np.array([True, False, False]),
        failed=np.array([False, True, True]),
        duration=0.1,
    )
    reward = spaces.Reward(barrier=-2.0, smoothness=-0.3, time=-1.0)
    terms = reward.terms(transition)
    np.testing.assert_allclose(terms["progress"], [1.0, 0.0, -0.5])
    np.testing.assert_allclose(terms["barrier"], [0.0, -0.2 * 0.3, 0.0], atol=4e-3)
    np.testing.assert_allclose(terms["smoothness"], -0.1)
    np.testing.assert_allclose(terms["success"] + terms["failure"], [10.0, -10.0, -10.0])
    np.testing.assert_allclose(reward(transition), sum(terms.values()))
