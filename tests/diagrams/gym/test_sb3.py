import gymnasium
import numpy as np
import torch
from skrl.agents.torch import ExperimentCfg, ppo
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.trainers.torch import SequentialTrainer
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.gym.sb3 import Sb3FlightEnv


def parameters(model: torch.nn.Module) -> torch.Tensor:
    return torch.cat([each.detach().flatten().clone() for each in model.parameters()])


def test_stable_baselines3_trains_on_many_flights(post_world):
    options = {"world": post_world, "observation": ["depth", "goal"], "render_mode": "rgb_array"}
    envs = Sb3FlightEnv(4, Scenario(timeout=0.5), **options)
    model = PPO("MultiInputPolicy", envs, n_steps=8, batch_size=32, n_epochs=1, seed=0)
    before = parameters(model.policy)
    model.learn(32)
    assert (parameters(model.policy) != before).any()
    assert {episode["l"] for episode in model.ep_info_buffer or []} == {5}
    lengths = evaluate_policy(model, envs, n_eval_episodes=4, return_episode_rewards=True)[1]
    assert lengths == [5] * 4
    images = envs.get_images()
    assert [image.shape for image in images if image is not None] == [(240, 320, 3)] * 4


def test_ends_of_many_flights_are_those_of_stable_baselines3(post_world):
    envs = Sb3FlightEnv(2, Scenario(timeout=0.3), world=post_world, observation="full_state")
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


def test_skrl_trains_on_many_flights(tmp_path, post_world):
    options = {"scenario": Scenario(), "world": post_world, "observation": "full_state"}
    envs = gymnasium.make_vec("splatpilot:Flight-v0", 4, **options)
    env = wrap_env(envs, wrapper="gymnasium", verbose=False)
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    network = [{"name": "net", "input": "OBSERVATIONS", "layers": [8], "activations": "elu"}]
    options = {**spaces, "device": "cpu", "network": network}
    models = {
        "policy": gaussian_model(**options, output="ACTIONS", clip_actions=True),
        "value": deterministic_model(**options, output="ONE"),
    }
    for name, model in models.items():
        model.init_state_dict(role=name)
    files = ExperimentCfg(directory=str(tmp_path))
    agent = ppo.PPO(
        **spaces,
        models=models,
        memory=RandomMemory(memory_size=8, num_envs=4, device="cpu"),
        device="cpu",
        cfg=ppo.PPO_CFG(experiment=files, rollouts=8, learning_epochs=1, mini_batches=1),
    )
    before = parameters(models["policy"])
    cfg = {"timesteps": 16, "headless": True, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=cfg).train()
    assert (parameters(models["policy"]) != before).any()
