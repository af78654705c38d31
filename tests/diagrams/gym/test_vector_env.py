import warnings
from dataclasses import replace
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from pydrake.common.schema import Uniform, UniformDiscrete
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import DiagramBuilder

from splatpilot import _native
from splatpilot.diagrams.flight.flight_diagram import AddFlight, BuildFlightDiagram
from splatpilot.diagrams.flight.monitor import Outcome
from splatpilot.diagrams.flight.scenario import Scenario, sample_scenario
from splatpilot.diagrams.gym.flight_env import FlightEnv
from splatpilot.diagrams.gym.spaces import decisions
from splatpilot.diagrams.gym.vector_env import VectorFlightEnv
from splatpilot.diagrams.worlds.moving_spheres import MovingSphere
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.sensing.imaging import Imaging
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams
from splatpilot.systems.vehicle.wind import Wind

_VEHICLE = """{motor_time_constant: 0.04, yaw_time_ratio: 2.0, thrust_scale: 0.97, max_thrust: 18.0,
max_tilt_rate: 3.0, rotor_drag: [0.02, 0.03, 0.05], quadratic_drag: [0.01, 0.02, 0.03]}"""
LAGGING = load_config(Scenario(), overrides=[f"vehicle={_VEHICLE}", "wind.mean=[0.5, -0.3, 0.1]"])


def random_actions(envs: VectorFlightEnv, steps: int) -> np.ndarray:
    """Returns actions (steps, N, n) that change smoothly."""
    shape = steps + 8, envs.num_envs, envs.config.limits().size
    noise = np.random.default_rng(0).normal(size=shape)
    return np.clip(sum(noise[k : k + steps] for k in range(8)) / 4, -1, 1)


def fly_in_drake(
    envs: VectorFlightEnv, flight: int, actions: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    """Flies actions (steps, n) by AddFlight; returns states (steps, 13) and outcomes."""
    config, pool = envs.config, envs.pool
    scenario, world = pool.scenarios[flight], pool.worlds[pool.world[flight]]
    diagram = BuildFlightDiagram(scenario, world, camera=False, policy=config.action)
    simulator = Simulator(diagram)
    ApplySimulatorConfig(scenario.simulator, simulator)
    context = simulator.get_mutable_context()
    port, states, outcomes = diagram.GetInputPort(config.action), [], []
    for step, action in enumerate(actions):
        state = diagram.GetOutputPort("state").Eval(context)
        port.FixValue(context, decisions(config, action[None], state[None])[0])
        simulator.AdvanceTo((step + 1) * 5 * 0.02)  # as Drake computes times of updates
        states.append(diagram.GetOutputPort("state").Eval(context).copy())
        outcomes.append(diagram.GetOutputPort("outcome").Eval(context))
        if outcomes[-1]:
            break
    return np.array(states), outcomes


@pytest.mark.parametrize(
    ("action", "scenario", "limits"),
    [
        ("velocity", Scenario(), [0.8] * 3),
        ("waypoint", Scenario(), [0.8] * 3),
        ("acceleration", LAGGING, [1.0] * 3),
        ("command", LAGGING, [2.0, 0.3, 0.3, 0.5]),
    ],
)
def test_flights_are_those_of_add_flight(action, scenario, limits, post_world):
    envs = VectorFlightEnv(2, scenario, world=post_world, action=action, action_limits=limits)
    envs.reset(seed=2)
    actions, flights = random_actions(envs, 60), envs._flight.copy()
    states, outcomes = np.full((60, 2, 13), np.nan), np.full((60, 2), "", dtype=object)
    flying = np.ones(2, bool)
    for step, now in enumerate(actions):
        *_, infos = envs.step(now)
        states[step, flying] = envs._arrays.states[flying]
        if "outcome" in infos:
            outcomes[step, flying] = [o or "" for o in infos["outcome"][flying]]
            flying &= ~infos["_outcome"]
    for i in range(2):
        truth, ends = fly_in_drake(envs, flights[i], actions[:, i])
        np.testing.assert_allclose(states[: len(truth), i], truth, rtol=0, atol=1e-6)
        assert outcomes[: len(truth), i].tolist() == ends


def test_flights_in_grids_end_as_those_of_add_flight(post_world):
    field = post_world.esdf
    states = field.states.copy()
    states[15:] = FieldState.UNKNOWN  # from x = 3 m on
    field = replace(field, states=states)
    world = replace(post_world, distance_field=field, esdf=field)
    envs = VectorFlightEnv(1, Scenario(goal=[2.5, 2.0, 2.0], start_radius=0.0), world=world)
    envs.reset(seed=0)
    ahead, flown, outcomes = np.array([0.5, -1.0, 0.0]), [], []
    while not outcomes:
        *_, infos = envs.step(ahead[None])
        flown.append(envs._arrays.states[0].copy())
        outcomes = list(infos.get("outcome", []))
    truth, ends = fly_in_drake(envs, 0, np.tile(ahead, (60, 1)))
    np.testing.assert_allclose(flown, truth, rtol=0, atol=1e-6)
    assert ends[-1] == outcomes[0] == Outcome.LEFT_VOLUME


def test_each_flight_draws_its_vehicle(post_world):
    scenario = Scenario(vehicle=QuadrotorParams(thrust_scale=Uniform(min=0.9, max=1.1)))  # pyright: ignore
    envs = VectorFlightEnv(20, scenario, world=post_world)
    _, infos = envs.reset(seed=0)
    scales = envs._arrays.parameters[:, _native.FLIGHT_PARAMETERS.index("thrust_scale")].ravel()
    for scale, seed in zip(scales, infos["flight_seed"].tolist(), strict=False):
        assert scale == sample_scenario(replace(scenario, seed=seed)).vehicle.thrust_scale
    assert len(set(scales)) > 16


@pytest.mark.parametrize("count", [1, 3])
def test_images_and_rewards_are_those_of_flight_env(count, post_world):
    names = ["depth", "depth_m", "rgb", "state", "goal", "obstacle"]
    scenario = Scenario(start=[3.0, 0.0, 2.0], start_radius=0.0)
    env = FlightEnv(scenario, world=post_world, observation=names, native=False)
    envs = VectorFlightEnv(count, scenario, world=post_world, observation=names)
    one, many = env.reset(seed=0)[0], envs.reset(seed=0)[0]
    terminated = False
    while not terminated:
        for name in ("depth", "depth_m", "rgb"):
            np.testing.assert_array_equal(many[name][-1], one[name], name)
        for name in ("state", "goal", "obstacle"):
            np.testing.assert_allclose(many[name][-1], one[name], atol=1e-6)
        action = np.array([0.4, 0.05, 0.0])
        one, reward, terminated, truncated, info = env.step(action)
        many, rewards, terminations, truncations, infos = envs.step(np.tile(action, (count, 1)))
        assert rewards[-1] == pytest.approx(reward, abs=1e-9)
        assert (terminations[-1], truncations[-1]) == (terminated, truncated)
    assert infos["outcome"][-1] == info["outcome"] == Outcome.COLLISION
    assert not infos["is_success"][-1]


@pytest.mark.parametrize("action", ["velocity", "waypoint"])
def test_flights_with_a_decision_delay_begin_at_rest(action, post_world):
    scenario = Scenario(timeout=0.2, start_radius=0.0, decision_delay=[0.06, 0.06])
    options = {"action": action, "observation": "full_state"}
    envs = VectorFlightEnv(1, scenario, world=post_world, **options)
    envs.reset(seed=0)
    rest = np.zeros((1, 3))
    first = envs.step(rest)[0]
    assert envs.step(rest)[3].all()
    envs.step(np.ones((1, 3)))  # begins the next flight, whatever the action
    np.testing.assert_array_equal(envs.step(rest)[0], first)
    envs.reset(options={"start": [3.0, 1.0, 2.0]})
    np.testing.assert_allclose(envs.step(rest)[0][0, :3], [3.0, 1.0, 2.0], atol=1e-6)


def test_rewards_and_transitions_are_not_changed_later(post_world):
    seen = []

    def reward(transition):
        seen.append((transition.states, transition.next_states))
        return transition.distances

    envs = VectorFlightEnv(1, Scenario(), world=post_world, reward=reward)
    envs.reset(seed=0)
    rewards = [envs.step(np.array([[1.0, 0.0, 0.0]]))[1] for _ in range(3)]
    assert len({float(each[0]) for each in rewards}) == 3
    for (_, reached), (left, _) in pairwise(seen):
        np.testing.assert_array_equal(reached, left)


def test_color_of_random_appearance_is_that_of_add_flight(post_world):
    scenario, options = Scenario(appearance=1.0), {"observation": "rgb", "world": post_world}
    envs = VectorFlightEnv(2, scenario, render_mode="rgb_array", **options)
    with pytest.raises(ResetNeeded, match="before render"):
        envs.render()
    observed, _ = envs.reset(seed=0, options={"flight": [0, 1]})
    assert (observed[0] != observed[1]).mean() > 0.5
    scenario = envs.pool.scenarios[1]
    parts = AddFlight(DiagramBuilder(), scenario, post_world, policy="velocity", camera=False)
    np.testing.assert_array_equal(parts.world.gaussians.sh, envs.pool.worlds[1].gaussians.sh)
    assert [frame.shape for frame in envs.render() or ()] == [(240, 320, 3)] * 2


def flown(envs: VectorFlightEnv, seed: int, steps: int = 30) -> list[Any]:
    """Returns all that environments return for random actions."""
    returned = [envs.reset(seed=seed)]
    return returned + [envs.step(actions) for actions in random_actions(envs, steps)]


def test_flights_repeat_with_any_threads_and_simd_level(post_world, monkeypatch):
    def make(threads):
        scenario = Scenario(vehicle=QuadrotorParams(motor_time_constant=0.03))
        return VectorFlightEnv(37, scenario, world=post_world, threads=threads)

    first = flown(make(1), seed=3)
    envs = make(3)
    assert data_equivalence(first, flown(envs, seed=3), exact=True)
    assert not data_equivalence(first, flown(envs, seed=4), exact=True)
    assert data_equivalence(first, flown(envs, seed=3), exact=True)
    monkeypatch.setenv("SPLATPILOT_SIMD", _native.simd_levels()[-1])
    assert data_equivalence(first, flown(make(2), seed=3), exact=True)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_autoreset_modes(mode, post_world):
    scenario = Scenario(timeout=0.2, start_radius=0.0)
    options = {"observation": "full_state", "autoreset_mode": mode}
    envs = VectorFlightEnv(3, scenario, world=post_world, **options)
    assert envs.metadata["autoreset_mode"].value == mode
    start, _ = envs.reset(seed=0)
    ahead = np.tile([1.0, 0.0, 0.0], (3, 1))
    *_, truncated, infos = envs.step(ahead)
    assert not truncated.any() and not infos
    observed, _, _, truncated, infos = envs.step(ahead)
    assert truncated.all()
    assert infos.get("final_info", infos)["outcome"].tolist() == ["timeout"] * 3
    if mode == "SameStep":
        np.testing.assert_array_equal(observed, start)
        assert infos["_flight_seed"].all() and infos["final_info"]["_flight_seed"].all()
        assert infos["final_obs"][2][0] > start[2, 0] and infos["_final_obs"].all()
    elif mode == "Disabled":
        with pytest.raises(ResetNeeded, match=r"got \[0, 1, 2\]"):
            envs.step(ahead)
        envs.reset(options={"reset_mask": np.ones(3, bool)})
        assert not envs.step(ahead)[3].any()
    else:
        observed, rewards, _, truncated, infos = envs.step(ahead)
        np.testing.assert_array_equal(observed, start)
        assert infos["_flight_seed"].all()
        assert not rewards.any() and not truncated.any()


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_a_mask_resets_some_environments(mode, post_world):
    options = {"observation": "full_state", "autoreset_mode": mode}
    envs = VectorFlightEnv(3, Scenario(start_radius=0.0), world=post_world, **options)
    envs.reset(seed=0)
    flown, *_ = envs.step(np.tile([1.0, 0.0, 0.0], (3, 1)))
    options = {"reset_mask": np.array([False, True, False]), "start": [2.0, 1.0, 2.0]}
    observed, infos = envs.reset(options=options)
    np.testing.assert_array_equal(observed[[0, 2]], flown[[0, 2]])
    np.testing.assert_array_equal(observed[1, :3], [2.0, 1.0, 2.0])
    assert infos["_flight_seed"].tolist() == [False, True, False]
    with pytest.raises(InfeasibleFlightError, match=r"goal .* from the nearest surface"):
        envs.reset(options={"goal": [5.0, 0.0, 2.0]})


def test_gymnasium_makes_it_without_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = gymnasium.make_vec(
            "splatpilot:Flight-v0",
            num_envs=5,
            vectorization_mode="vector_entry_point",
            scenario=["P01", Scenario(timeout=0.2)],
            observation=["depth", "goal"],
        )
        envs = RecordEpisodeStatistics(made)
        assert envs.observation_space.contains(envs.reset(seed=0)[0])
        for _ in range(2):
            observed, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())
            assert envs.observation_space.contains(observed)
            assert rewards.dtype == np.float64
            assert terminated.dtype == truncated.dtype == bool
    assert isinstance(made.unwrapped, VectorFlightEnv)
    assert infos["episode"]["l"].max() == 2


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_flights_end_by_a_function_of_ones_own(post_world, mode):
    options = {"world": post_world, "autoreset_mode": mode}
    envs = VectorFlightEnv(3, Scenario(), terminate=lambda t: t.actions[:, 2] > 0.5, **options)
    envs.reset(seed=0)
    climb = np.zeros((3, 3))
    assert not envs.step(climb)[2].any()
    climb[1, 2] = 1.0
    _, rewards, terminated, truncated, infos = envs.step(climb)
    assert terminated.tolist() == [False, True, False] and not truncated.any()
    infos = infos.get("final_info", infos)
    assert infos["outcome"][1] == "terminated" and not infos["is_success"][1]
    assert rewards[1] > -5.0  # No collision
    for invalid in (lambda t: np.zeros(3), lambda t: np.zeros(2, bool)):
        envs.config.terminate = invalid
        with pytest.raises(ValueError, match=r"the result of terminate must be bool of \(3,\)"):
            envs.step(np.zeros((3, 3)))


def test_a_curriculum_chooses_flights(post_world):
    scenarios = [Scenario(timeout=0.1), Scenario(timeout=0.2)]
    envs = VectorFlightEnv(8, scenarios, world=post_world, autoreset_mode="SameStep")
    assert len(set(envs.reset(seed=0)[1]["scenario"])) == 2
    envs.choices = np.flatnonzero(envs.pool.scenario == 1)
    *_, truncated, infos = envs.step(np.zeros((8, 3)))
    assert truncated.any()
    assert (infos["scenario"][truncated] == 1).all()
    assert not infos["final_info"]["scenario"].any()
    assert (envs.reset()[1]["scenario"] == 1).all()
    for invalid in ([], [len(envs.pool)], [[0]], envs.pool.scenario == 1):
        with pytest.raises(ValueError, match=r"choices must be one or more in \[0, "):
            envs.choices = invalid


def test_seeds_and_scenarios_of_flights_are_known(post_world):
    scenarios = [Scenario(), Scenario(timeout=3.0)]
    envs = VectorFlightEnv(4, scenarios, world=post_world, observation="full_state")
    observed, infos = envs.reset(seed=5)
    other, _ = envs.reset(seed=6)
    np.testing.assert_array_equal(observed[1:], other[:-1])
    assert len(set(infos["flight_seed"].tolist())) == 4
    assert set(infos["scenario"]) == {0, 1}
    listed, _ = envs.reset(seed=[8, 7, 6, 5])
    np.testing.assert_array_equal(listed[::-1], observed)
    fresh = VectorFlightEnv(4, scenarios, pool=envs.pool)
    _, infos = fresh.reset(seed=[None] * 4)
    assert len(set(infos["flight_seed"].tolist())) > 1
    second = np.flatnonzero(envs.pool.scenario == 1)[:4]
    assert set(envs.reset(options={"flight": second})[1]["scenario"]) == {1}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"scenario": Scenario(moving={"a": MovingSphere()})}, "moving of VectorFlightEnv"),
        ({"scenario": Scenario(wind=Wind(gusts=5.0))}, "wind.gusts of VectorFlightEnv must be 0"),
        # The seed of the scenario draws no gusts, but others do.
        (
            {"scenario": Scenario(seed=6, wind=Wind(gusts=UniformDiscrete(values=[0.0, 15.4])))},
            "wind.gusts of VectorFlightEnv must be 0, got 15.4",
        ),
        ({"scenario": Scenario(decision_delay=[0.0, 0.2])}, "decision_delay must be at most"),
        ({"scenario": Scenario(start=[5.0, 0.0, 2.0])}, "start .* from the nearest surface"),
        (
            {"scenario": Scenario(observation=ObservationNoise(latency=0.1)), "observation": "rgb"},
            "observation of VectorFlightEnv must be left out",
        ),
        (
            {"scenario": Scenario(imaging=Imaging(vignetting=1.0)), "observation": "rgb"},
            "imaging of VectorFlightEnv must be left out",
        ),
        ({"num_envs": 0}, "num_envs must be at least 1"),
        ({"autoreset_mode": "next_step"}, "autoreset_mode must be one of NextStep, .*'next_step'"),
        ({"render_mode": "human"}, "render_mode must be rgb_array or None"),
    ],
)
def test_invalid_arguments_are_errors(fields, message, post_world):
    with pytest.raises(ValueError, match=message):
        VectorFlightEnv(**{"scenario": Scenario(), "world": post_world} | fields)


def test_invalid_steps_and_resets_are_errors(post_world):
    envs = VectorFlightEnv(2, Scenario(), world=post_world)
    with pytest.raises(ResetNeeded):
        envs.step(np.zeros((2, 3)))
    with pytest.raises(InfeasibleFlightError):
        envs.reset(options={"goal": [5.0, 0.0, 2.0]})
    with pytest.raises(ResetNeeded, match=r"got \[0, 1\]"):
        envs.step(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="world must be left out with a pool"):
        VectorFlightEnv(2, Scenario(), world=post_world, pool=envs.pool)
    envs.reset(seed=0)
    for actions in (np.full((2, 3), np.nan), np.full((2, 3), 1.1), np.zeros(3)):
        with pytest.raises(ValueError, match="action must be"):
            envs.step(actions)
    invalid = [("reset_mask", [True]), ("options", 1)]
    invalid += [("flight", flight) for flight in (64, 1.5, [0, 1, 2], [[0, 1]])]
    invalid += [("goal", goal) for goal in (3.0, "abc", np.zeros((3, 3)))]
    for name, value in invalid:
        with pytest.raises(ValueError, match=f"{name} must be"):
            envs.reset(options={name: value})
    envs.config.reward = lambda transition: 1.0
    with pytest.raises(ValueError, match=r"shape of the rewards must be \(2,\)"):
        envs.step(np.zeros((2, 3)))
