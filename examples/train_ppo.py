"""PPO in one file: many flights at once, by torch and Gymnasium alone.

    python examples/train_ppo.py --observation state goal obstacle --minutes 5

Prints environment steps, CPU minutes, and the success of the last 200 flights, in training worlds.
At the end, the weights are saved, and flights of the mean action are tested in worlds of 50 other
seeds. To fly them, make a `splatpilot.GymPolicy` of the mean action.
"""

import argparse
import time
from collections import deque
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers.vector import NormalizeReward
from torch import nn
from torch.distributions import Normal

import splatpilot as sp

STEPS, EPOCHS, BATCHES = 64, 4, 8
GAMMA, LAMBDA, CLIP, ENTROPY, RATE = 0.99, 0.95, 0.2, 0.001, 5e-4


class Agent(nn.Module):
    """Maps vectors, and images by a CNN, to a distribution of actions and the value."""

    def __init__(self, envs: gymnasium.vector.VectorEnv, first: dict) -> None:
        super().__init__()
        self.cnn = nn.Sequential(
            *(nn.LazyConv2d(16, 6, 4), nn.ReLU(), nn.LazyConv2d(32, 3, 2), nn.ReLU()),
            *(nn.Flatten(), nn.LazyLinear(64), nn.ReLU()),
        )
        size = envs.single_action_space.shape[0]
        self.actor, self.critic = (
            nn.Sequential(nn.LazyLinear(128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), last)
            for last in (nn.Linear(128, size), nn.Linear(128, 1))
        )
        self.log_std = nn.Parameter(torch.full((size,), -0.7))
        nn.init.normal_(self.actor[-1].weight, std=0.01)
        self(first)

    def forward(self, seen: dict[str, torch.Tensor]) -> tuple[Normal, torch.Tensor]:
        parts = [x for x in seen.values() if x.ndim == 2]
        if images := [x for x in seen.values() if x.ndim == 4]:
            parts.append(self.cnn(torch.cat(images, -1).movedim(-1, 1) / 255.0))
        features = torch.cat(parts, -1)
        return Normal(self.actor(features), self.log_std.exp()), self.critic(features)[:, 0]


def tensors(seen: dict) -> dict[str, torch.Tensor]:
    return {name: torch.as_tensor(value) for name, value in seen.items()}


@torch.no_grad()
def test(agent: Agent, scenario: sp.Scenario, count: int, **options) -> float:
    """Returns the fraction of flights that arrive, one in the world of each test seed."""
    envs = sp.VectorFlightEnv(count, replace(scenario, seed=1000), num_worlds=count, **options)
    flights = np.unique(envs.pool.world_seeds, return_index=True)[1]
    seen, _ = envs.reset(options={"flight": flights})
    arrived, flying = np.zeros(count, bool), np.ones(count, bool)
    while flying.any():
        action = agent(tensors(seen))[0].mean.clamp(-1.0, 1.0)
        seen, _, terminated, truncated, infos = envs.step(action.numpy())
        arrived |= flying & infos.get("is_success", False)
        flying &= ~(terminated | truncated)
    return arrived.mean()


def main(options: argparse.Namespace) -> None:
    torch.manual_seed(options.seed)
    torch.set_num_threads(options.threads)
    scenario = replace(sp.find_scenario(options.scenario), timeout=30.0)
    fields = {"observation": options.observation, "threads": options.threads}
    envs = gymnasium.make_vec(
        *("splatpilot:Flight-v0", options.envs, "vector_entry_point"),
        scenario=replace(scenario, seed=1_000_000),
        num_worlds=options.worlds,
        autoreset_mode="SameStep",
        **fields,
    )
    rewarded = NormalizeReward(envs, gamma=GAMMA)
    seen = tensors(rewarded.reset(seed=options.seed)[0])
    agent = Agent(envs, seen)
    optimizer = torch.optim.Adam(agent.parameters(), RATE, eps=1e-5)
    ends, steps, began = deque(maxlen=200), 0, time.process_time()
    while (minutes := (time.process_time() - began) / 60) < options.minutes:
        optimizer.param_groups[0]["lr"] = RATE * (1.0 - minutes / options.minutes)
        rows = []
        with torch.no_grad():
            for _ in range(STEPS):
                policy, value = agent(seen)
                action = policy.sample()
                after, reward, terminated, truncated, infos = rewarded.step(
                    action.clamp(-1.0, 1.0).numpy()
                )
                done = torch.as_tensor(terminated | truncated)
                log = policy.log_prob(action).sum(-1)
                rows.append((seen, action, log, value, torch.as_tensor(reward).float(), done))
                ended = infos.get("final_info", {})
                ends.extend(ended["is_success"][ended["_is_success"]] if ended else [])
                seen = tensors(after)
            advantage, following = torch.zeros(options.envs), agent(seen)[1]
            advantages = []
            for _, _, _, value, reward, done in reversed(rows):  # generalized advantages
                delta = reward + GAMMA * following * ~done - value
                advantage = delta + GAMMA * LAMBDA * advantage * ~done
                advantages.insert(0, advantage)
                following = value
        observed = {n: torch.cat([row[0][n] for row in rows]) for n in seen}
        actions, logs, values = (torch.cat([row[k] for row in rows]) for k in (1, 2, 3))
        advantage = torch.cat(advantages)
        returns = values + advantage
        for _ in range(EPOCHS):
            for batch in torch.randperm(len(logs)).chunk(BATCHES):
                policy, value = agent({n: x[batch] for n, x in observed.items()})
                ratio = (policy.log_prob(actions[batch]).sum(-1) - logs[batch]).exp()
                better = advantage[batch]
                better = (better - better.mean()) / (better.std() + 1e-8)
                clipped = ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
                loss = -torch.minimum(ratio * better, clipped * better).mean()
                loss += 0.5 * (value - returns[batch]).square().mean()
                loss -= ENTROPY * policy.entropy().sum(-1).mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
        steps += len(logs)
        print(f"{minutes:.2f} CPU min, {steps} steps, success {np.mean(ends or [0]):.2f}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    torch.save(agent.state_dict(), options.out)
    print(f"wrote {options.out}; test success {test(agent, scenario, options.tests, **fields):.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="P01")
    parser.add_argument("--observation", nargs="+", default=["depth", "state", "goal"])
    parser.add_argument("--out", type=Path, default=Path("out/ppo.pt"))
    parser.add_argument("--minutes", type=float, default=20.0)
    for name, value in (("envs", 64), ("worlds", 32), ("tests", 50), ("threads", 1), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=value)
    main(parser.parse_args())
