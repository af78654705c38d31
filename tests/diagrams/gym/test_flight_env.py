import subprocess
import sys
import warnings
from dataclasses import replace

import av
import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.wrappers import RecordEpisodeStatistics, RecordVideo
from pydrake.common.schema import Uniform
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.gym.flight_env import FlightEnv
from splatpilot.diagrams.gym.vector_env import VectorFlightEnv
from splatpilot.diagrams.worlds.moving_spheres import MovingSphere
from splatpilot.systems.common.config import dump_config, load_config
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.sensing.estimators import MotionCapture
from splatpilot.systems.sensing.imu import Imu
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams

AHEAD = np.array([0.5, 0.0, 0.0], np.float32)


def flown(env: gymnasium.Env, seed: int, steps: int = 60, **options):
    """Flies ahead; returns observations, rewards and the last info."""
    observation, info = env.reset(seed=seed, options=options)
    observed, rewards = [observation], []
    for step in range(steps):
        action = np.array([0.5, 0.2 * np.sin(step), 0.0])
        observation, reward, terminated, truncated, info = env.step(action)
        observed.append(observation)
        rewards.append(reward)
        if terminated or truncated:
            break
    return observed, rewards, info


@pytest.mark.parametrize("observation", [["depth", "rgb", "state", "goal", "obstacle"], "state"])
def test_checkers_pass_without_warnings(observation, post_world):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        options = {"observation": observation, "render_mode": "rgb_array"}
        env = FlightEnv(Scenario(), world=post_world, **options)
        check_env(env, skip_render_check=True)
        check_env_of_sb3(env)


@pytest.mark.parametrize(("action", "axis", "delay"), [("velocity", 0, 0.06), ("command", 2, 0.05)])
def test_delayed_decisions_come_late_in_both_environments(action, axis, delay, post_world):
    def moved(make, **fields):
        scenario = Scenario(start_radius=0.0, **fields)
        env = make(scenario=scenario, world=post_world, observation="full_state", action=action)
        start = env.reset(seed=0)[0]
        ahead = np.zeros(env.action_space.shape)
        ahead[..., 0] = 1.0
        return [(env.step(ahead)[0] - start)[..., axis].item() for _ in range(3)]

    late = moved(FlightEnv, decision_delay=[delay, delay])
    assert 0 < late[0] < 0.5 * moved(FlightEnv)[0]
    many = moved(VectorFlightEnv, decision_delay=[delay, delay])
    np.testing.assert_allclose(late, many, atol=1e-5)


def test_drawn_fields_are_those_of_the_flight(post_world):
    scenario = Scenario(timeout=Uniform(0.1, 0.3), appearance=Uniform(0.5, 1.0))  # pyright: ignore
    for make in (FlightEnv, VectorFlightEnv):
        env = make(scenario=scenario, world=post_world)
        env.reset(seed=0)
        action, steps = np.zeros(env.action_space.shape), 0
        while not np.any(env.step(action)[3]):
            steps += 1
        assert steps < 3


def test_a_zero_command_hovers_on_another_planet(post_world):
    scenario = Scenario(vehicle=QuadrotorParams(gravity=3.7), start_radius=0.0)
    env = FlightEnv(scenario, world=post_world, action="command", observation="full_state")
    start = env.reset(seed=0)[0]
    assert env.config.limits()[0] == 3.7
    np.testing.assert_allclose(env.step(np.zeros(4))[0], start, atol=1e-6)


def test_flights_do_not_begin_in_moving_obstacles(post_world):
    sphere = MovingSphere(radius=0.3, waypoints=[[1.0, 0.7, 2.0], [1.0, 0.7, 2.01]])
    env = FlightEnv(Scenario(moving={"ball": sphere}), world=post_world)
    for seed in range(12):
        env.reset(seed=seed)
        assert env.diagram.GetOutputPort("clearance").Eval(env.simulator.get_context())[0] > 0.0
    with pytest.raises(InfeasibleFlightError):
        env.reset(options={"start": [1.0, 0.7, 2.0]})


def test_own_ends_terminate_a_flight(post_world):
    env = FlightEnv(Scenario(), world=post_world, terminate=lambda t: t.actions[:, 2] > 0.5)
    env.reset(seed=0)
    assert not env.step(np.zeros(3))[2]
    *_, terminated, truncated, info = env.step(np.array([0.0, 0.0, 1.0]))
    assert terminated and not truncated
    assert info == {"outcome": "terminated", "is_success": False}


def test_gymnasium_knows_it_if_imported_before_splatpilot():
    program = "import gymnasium, splatpilot; print(gymnasium.spec('Flight-v0').entry_point)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip().endswith(":FlightEnv"), done.stderr


@pytest.mark.parametrize("profile", [[], ["profile=realistic"]])
def test_a_seed_repeats_flights_noise_and_sensors(profile, post_world):
    scenario = load_config(Scenario(sensors={"imu": Imu()}), overrides=profile)
    names = ["depth_m", "rgb", "full_state", "goal", "obstacle", "imu_accelerometer"]
    env = FlightEnv(scenario, world=post_world, observation=names)
    first, other, again = (flown(env, seed, 5) for seed in (3, 4, 3))
    same = flown(FlightEnv(scenario, world=post_world, observation=names), 3, 5)
    assert data_equivalence(first, again, exact=True) and data_equivalence(first, same, exact=True)
    assert first[1] != other[1]
    assert (first[0][1]["imu_accelerometer"] != other[0][1]["imu_accelerometer"]).any()
    assert env.observation_space.contains(first[0][1])


def test_the_policy_sees_and_acts_by_the_estimate(post_world):
    scenario = Scenario(estimator=MotionCapture(rate=50.0, latency=0.05))
    env = FlightEnv(scenario, world=post_world, observation="full_state", action="waypoint")
    env.reset(seed=0)
    for _ in range(4):
        env.step(AHEAD)
    before, *_ = env.step(AHEAD)
    env.step(AHEAD)
    waypoint = env.diagram.GetInputPort("waypoint").Eval(env.simulator.get_context())
    true = env.diagram.GetOutputPort("state").Eval(env.simulator.get_context())
    assert np.linalg.norm(before[:3] - true[:3]) > 0.02
    assert np.linalg.norm(waypoint - before[:3]) == pytest.approx(0.5 * 1.2, abs=1e-5)


def test_flights_end_by_name_and_keep_the_diagram(post_world):
    env = FlightEnv(Scenario(timeout=4.0), world=post_world)
    diagram, simulator = env.diagram, env.simulator
    for options, outcome in (
        ({}, "collision"),
        ({"goal": [2.5, 0.0, 2.0]}, "goal"),
        ({"start": [1.0, 2.0, 2.0], "goal": [9.0, 2.0, 2.0]}, "timeout"),
    ):
        *_, info = flown(env, 0, **options)
        assert info == {"outcome": outcome, "is_success": outcome == "goal"}
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(AHEAD)
    env.reset(options={"goal": [1.0, 2.0, 2.0]})
    assert env.diagram is diagram and env.simulator is simulator
    assert env.simulator.get_context().get_time() == 0.0


SMALL = load_config(Scenario(), overrides=["world.length=8", "world.width=6"])


def test_worlds_are_drawn_from_the_seeds_of_the_scenario():
    env, seeds = FlightEnv(SMALL, num_worlds=2), set()
    for seed in range(6):
        env.reset(seed=seed)
        seeds.add(env.parts.world.source[1])
    assert seeds == {0, 1}


def test_options_choose_the_scenario(tmp_path):
    (tmp_path / "short.yaml").write_text(dump_config(replace(SMALL, timeout=0.2, seed=7)))
    env = FlightEnv(SMALL)
    env.reset(seed=0, options={"scenario": str(tmp_path / "short.yaml")})
    assert env.step(AHEAD)[2:4] == (False, False)
    _, _, terminated, truncated, info = env.step(AHEAD)
    assert (terminated, truncated, info["outcome"]) == (False, True, "timeout")
    assert env.parts.world.source[1] == 7


@pytest.mark.parametrize(
    ("fields", "options", "error", "message"),
    [
        ({}, {"goals": [1, 2, 3]}, ValueError, "options must be of scenario, start, goal"),
        ({}, {"goal": [1.0, 2.0]}, ValueError, "goal must be three finite numbers"),
        ({}, {"goal": [5.0, 0, 2]}, InfeasibleFlightError, "goal .* from the nearest surface"),
        ({}, {"start": [50.0, 0, 2]}, InfeasibleFlightError, "start .* outside the world"),
        ({}, {"scenario": "P99"}, ValueError, "there is no scenario 'P99'"),
        ({}, {"scenario": "small_house"}, ValueError, r"got a scene; fly --scene small_house, or"),
        ({"observation": ["state", "sonar"]}, {}, ValueError, "observation must be one of state"),
        ({"render_mode": "ansi"}, {}, ValueError, "render_mode must be one of rgb_array, human"),
        ({"num_worlds": 2}, {}, ValueError, "num_worlds must be 1 with a world"),
        ({"scenario": Scenario(start=[5.0, 0, 2])}, {}, ValueError, "start .* nearest surface"),
    ],
)
def test_invalid_arguments_and_options_are_errors(fields, options, error, message, post_world):
    with pytest.raises(error, match=message):
        env = FlightEnv(**{"scenario": Scenario(), "world": post_world} | fields)
        env.reset(seed=0, options=options)


def test_scenarios_without_an_observed_sensor_are_refused():
    scenario = replace(SMALL, sensors={"imu": Imu()})
    env = FlightEnv(scenario, observation="imu_accelerometer")
    for options in ({"scenario": SMALL}, {}):
        with pytest.raises(ValueError, match=r"observation must be one of .* got 'imu_acc"):
            env.reset(options=options)
    assert env.observation_space.contains(env.reset(options={"scenario": scenario})[0])


def test_rewards_are_replaceable(post_world):
    env = FlightEnv(Scenario(), world=post_world, reward=lambda t: t.next_states[:, 2])
    env.reset(seed=0)
    height = env.step(AHEAD)[1]
    state = env.diagram.GetOutputPort("state").Eval(env.simulator.get_context())
    assert height == pytest.approx(state[2])
    env = FlightEnv(Scenario(), world=post_world, reward=lambda transition: 1.0)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape of the reward must be \(N,\)"):
        env.step(AHEAD)


def test_wrappers_record_statistics_and_video(post_world, tmp_path):
    options = {"world": post_world, "render_mode": "rgb_array"}
    env = gymnasium.make("splatpilot:Flight-v0", scenario=Scenario(timeout=0.5), **options)
    env = RecordEpisodeStatistics(RecordVideo(env, str(tmp_path / "videos"), disable_logger=True))
    _, rewards, info = flown(env, 0)
    env.close()
    assert info["episode"]["l"] == len(rewards)
    assert info["episode"]["r"] == pytest.approx(sum(rewards))
    with av.open(str(next(tmp_path.glob("videos/*.mp4")))) as file:
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    assert len(frames) >= len(rewards)
    assert frames[0].shape == (240, 320, 3) and frames[0].std() > 5.0


def test_human_mode_draws_in_meshcat(post_world):
    env = FlightEnv(Scenario(), world=post_world, render_mode="human")
    env.reset(seed=0)
    env.simulator.set_target_realtime_rate(0.0)
    env.step(AHEAD)
    assert env.render() is None
    assert env.meshcat and env.meshcat.HasPath("/splatpilot/vehicle")


def test_human_mode_draws_the_world_and_the_goal_of_each_flight():
    env, sizes = FlightEnv(SMALL, num_worlds=2, render_mode="human"), {}
    for seed in range(4):
        env.reset(seed=seed)
        assert env.meshcat
        size = len(env.meshcat._GetPackedObject("/splatpilot/scene"))
        assert sizes.setdefault(env.parts.world.source[1], size) == size
    assert len(set(sizes.values())) == 2
    goal = env.meshcat._GetPackedTransform("/splatpilot/goal")
    env.reset(options={"goal": env.parts.world.p_WG - [0.5, 0.0, 0.0]})
    assert env.meshcat._GetPackedTransform("/splatpilot/goal") != goal


@pytest.mark.parametrize("action", ["command", "acceleration", "velocity", "waypoint"])
def test_native_code_flies_as_the_simulator_does(action, post_world):
    names = ["full_state", "goal", "obstacle", "depth_m"]
    options = {"world": post_world, "observation": names, "action": action}
    envs = [FlightEnv(Scenario(), native=native, **options) for native in (True, False)]
    actions = np.random.default_rng(1).uniform(-0.3, 0.4, (40, envs[0].config.limits().size))
    if action == "command":
        actions *= 0.05
    for env in envs:
        env.reset(seed=2)
    for given in actions:
        native, simulated = (env.step(given) for env in envs)
        for name in names:
            np.testing.assert_allclose(native[0][name], simulated[0][name], atol=1e-5)
        assert native[1] == pytest.approx(simulated[1], abs=1e-6)
        assert native[2:] == simulated[2:]
        contexts = [env.simulator.get_context() for env in envs]
        assert contexts[0].get_time() == pytest.approx(contexts[1].get_time(), abs=1e-9)
        for port in ("state", "command", "clearance"):
            values = (e.diagram.GetOutputPort(port).Eval(e.simulator.get_context()) for e in envs)
            np.testing.assert_allclose(*values, atol=1e-7)
        if native[2] or native[3]:
            break
    assert contexts[0].get_time() > 1.0
