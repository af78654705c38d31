"""Trainers of others, at small scale."""

from typing import Any

import gymnasium
import numpy as np
import torch
from skrl.agents.torch import ExperimentCfg, ppo
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.evaluation import evaluate_policy

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.gym.flight_env import FlightEnv
from splatpilot.diagrams.gym.sb3 import Sb3FlightEnv


def parameters(model: torch.nn.Module) -> torch.Tensor:
    return torch.cat([each.detach().flatten().clone() for each in model.parameters()])


def test_stable_baselines3_trains_on_images(post_world):
    env = FlightEnv(Scenario(timeout=2.0), world=post_world, observation=["rgb", "state", "goal"])
    model = PPO("MultiInputPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=0)
    before = parameters(model.policy)
    model.learn(64)
    assert (parameters(model.policy) != before).any()
    assert model.ep_info_buffer


def test_stable_baselines3_trains_off_policy(post_world):
    env = FlightEnv(Scenario(timeout=2.0), world=post_world, observation="state")
    model = SAC("MlpPolicy", env, learning_starts=16, batch_size=16, seed=0)
    before = parameters(model.policy)
    model.learn(24)
    assert (parameters(model.policy) != before).any()


def test_stable_baselines3_trains_on_many_flights():
    names = ["depth", "state", "goal"]
    envs = Sb3FlightEnv(4, Scenario(timeout=1.0), observation=names, render_mode="rgb_array")
    model = PPO("MultiInputPolicy", envs, n_steps=16, batch_size=64, n_epochs=1, seed=0)
    before = parameters(model.policy)
    model.learn(128)
    assert (parameters(model.policy) != before).any()
    assert {episode["l"] for episode in model.ep_info_buffer or []} == {10}
    lengths = evaluate_policy(model, envs, n_eval_episodes=4, return_episode_rewards=True)[1]
    assert lengths == [10] * 4
    images = envs.get_images()
    assert [image.shape for image in images if image is not None] == [(240, 320, 3)] * 4


def test_ends_of_many_flights_are_those_of_stable_baselines3():
    envs = Sb3FlightEnv(2, Scenario(timeout=0.3), observation="full_state")
    envs.seed(5)
    first = envs.reset()
    action = np.zeros((2, 3), np.float32)
    envs.step(action)
    envs.step(action)
    observed, _, dones, infos = envs.step(action)
    assert dones.all()
    for i, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert info["outcome"] == "timeout"
        assert info["episode"]["l"] == 3
        assert np.linalg.norm(info["terminal_observation"][:3] - first[i, :3]) < 0.1
        assert envs.observation_space.contains(observed[i])
    envs.seed(5)
    np.testing.assert_array_equal(envs.reset(), first)


class Policy(GaussianMixin, Model):
    def __init__(self, observation_space: Any, action_space: Any) -> None:
        Model.__init__(
            self, observation_space=observation_space, action_space=action_space, device="cpu"
        )
        GaussianMixin.__init__(self, clip_actions=True)
        self.net = torch.nn.Linear(self.num_observations, self.num_actions)
        self.log_std = torch.nn.Parameter(torch.zeros(self.num_actions))

    def compute(self, inputs, role=""):  # pyright: ignore
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    def __init__(self, observation_space: Any, action_space: Any) -> None:
        Model.__init__(
            self, observation_space=observation_space, action_space=action_space, device="cpu"
        )
        DeterministicMixin.__init__(self)
        self.net = torch.nn.Linear(self.num_observations, 1)

    def compute(self, inputs, role=""):  # pyright: ignore
        return self.net(inputs["observations"]), {}


def test_skrl_trains_on_many_flights(tmp_path):
    envs = gymnasium.make_vec(
        "splatpilot:Flight-v0", 4, scenario=Scenario(timeout=1.0), observation="full_state"
    )
    env = wrap_env(envs, wrapper="gymnasium", verbose=False)
    models = {
        name: model(env.observation_space, env.action_space)
        for name, model in (("policy", Policy), ("value", Value))
    }
    agent = ppo.PPO(
        models=models,
        memory=RandomMemory(memory_size=16, num_envs=4, device="cpu"),
        observation_space=env.observation_space,
        action_space=env.action_space,
        device="cpu",
        cfg=ppo.PPO_CFG(
            experiment=ExperimentCfg(directory=str(tmp_path)),
            rollouts=16,
            learning_epochs=1,
            mini_batches=1,
        ),
    )
    before = parameters(models["policy"])
    cfg = {"timesteps": 32, "headless": True, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=cfg).train()
    assert (parameters(models["policy"]) != before).any()
