"""Compares steps of `FlightEnv` with those of Drake's `DrakeGymEnv` around the same diagram.

    python benchmarks/environments.py [--scenario P02] [--rounds 5] [--steps 200]

The environments take turns, and fly with the same actions from the same starts. Times are CPU
times of one thread, the minimum over all rounds.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from harness import header, machine, row
from pydrake.gym import DrakeGymEnv
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator

import splatpilot as sp
from splatpilot.diagrams.flight.flight_diagram import DecisionInput
from splatpilot.diagrams.gym.spaces import find_scenario
from splatpilot.systems.sensing.onboard_camera import OnboardCamera

RATE = 10.0  # [Hz]


def drake_env(
    scenario: sp.Scenario, world: sp.World, camera: OnboardCamera | None = None
) -> gymnasium.Env:
    """Makes the environment as `docs/diagrams.md` had it: the state, and the distance as reward."""
    policy = DecisionInput("velocity", camera, RATE)
    diagram = sp.BuildFlightDiagram(scenario, world, policy=policy, camera=False)
    simulator = Simulator(diagram)
    ApplySimulatorConfig(scenario.simulator, simulator)

    def reward(diagram: Any, context: Any) -> float:
        return -np.linalg.norm(diagram.GetOutputPort("state").Eval(context)[:3] - world.p_WG)

    return DrakeGymEnv(
        simulator,
        1 / RATE,
        Box(-3.0, 3.0, (3,)),
        Box(-np.inf, np.inf, (13,)),
        reward,
        action_port_id="velocity",
        observation_port_id="observation_state",
        reset_handler=lambda *_: None,
    )


def seconds(env: gymnasium.Env, scale: float, steps: int) -> tuple[float, float]:
    """Returns CPU seconds of a step and of a reset."""
    generator = np.random.default_rng(0)
    in_steps, in_resets, resets = 0.0, 0.0, 0
    ended = True
    for _ in range(steps):
        if ended:
            began = time.process_time()
            env.reset(seed=resets)
            in_resets += time.process_time() - began
            resets += 1
        action = scale * generator.uniform([0.0, -0.3, -0.1], [0.6, 0.3, 0.1])
        began = time.process_time()
        _, _, terminated, truncated, _ = env.step(action)
        in_steps += time.process_time() - began
        ended = terminated or truncated
    return in_steps / steps, in_resets / resets


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="P02")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=200)
    options = parser.parse_args()
    scenario = find_scenario(options.scenario)
    world = sp.make_world(scenario.world, scenario.seed)

    def flight_env(*observation: str, **fields: Any) -> Callable[[], gymnasium.Env]:
        return lambda: sp.FlightEnv(scenario, world=world, observation=observation, **fields)

    made: dict[str, tuple[Callable[[], gymnasium.Env], float]] = {
        "DrakeGymEnv by hand, state": (lambda: drake_env(scenario, world), 3.0),
        "FlightEnv, state, simulator": (flight_env("full_state", native=False), 1.0),
        "FlightEnv, state": (flight_env("full_state"), 1.0),
        "FlightEnv, state, goal, obstacle": (flight_env("state", "goal", "obstacle"), 1.0),
        "FlightEnv, depth 64x36": (flight_env("depth"), 1.0),
        "FlightEnv, RGB 64x36": (flight_env("rgb"), 1.0),
    }
    envs = {name: (make(), scale) for name, (make, scale) in made.items()}
    best = {name: np.full(2, np.inf) for name in envs}
    for _ in range(options.rounds):
        for name, (env, scale) in envs.items():
            best[name] = np.minimum(best[name], seconds(env, scale, options.steps))
    print(f"{options.scenario}, {machine()}")
    header("environment", "steps/s", "over DrakeGymEnv", "reset [ms]")
    first = next(iter(best.values()))[0]
    for name, (step, reset) in best.items():
        row(name, f"{1 / step:,.0f}", f"{first / step:.1f}", f"{1e3 * reset:.2f}")


if __name__ == "__main__":
    main()
