"""Measures `VectorFlightEnv` beside Drake's `DrakeGymEnv` around the diagram of one flight.

    python benchmarks/vector_env.py [--scenario P02] [--worlds 16] [--rounds 7] [--threads 2]
        [--merged-spread 0]

The environments take turns, and each figure is the best of all rounds. CPU times are those of all
threads. The last column is the part of the CPU time that is not spent in the image kernels. P02, 16
worlds, 8 rounds, two cores of an AMD EPYC that others used too:

| environment | steps/s | CPU us a step | outside image kernels |
|---|---|---|---|
| DrakeGymEnv, state | 403 | 2,402.66 | |
| DrakeGymEnv, depth 64x36 | 273 | 3,661.74 | |
| state, N = 64 | 255,128 | 4.07 | |
| state, N = 256 | 654,415 | 1.53 | |
| state, N = 1024 | 1,211,784 | 0.88 | |
| state, N = 4096 | 1,664,174 | 0.66 | |
| depth 64x36, N = 64 | 2,065 | 731.43 | 6% |
| depth and RGB 64x48, N = 64 | 314 | 4,486.91 | 2% |
| depth and RGB 160x120, N = 64 | 224 | 6,167.10 | 4% |

A reset of one environment takes 0.027 ms before its images.
"""

import argparse
import os
import time
from dataclasses import replace
from typing import Any

import numpy as np
from environments import RATE, drake_env
from harness import header, machine, row

from splatpilot import _native
from splatpilot.diagrams.gym.spaces import find_scenario
from splatpilot.diagrams.gym.vector_env import VectorFlightEnv
from splatpilot.systems.sensing.onboard_camera import OnboardCamera

MAX_DEPTH = 12.0  # [m]
STATES = ("state", "goal")
CASES: dict[str, tuple[int, tuple[str, ...], tuple[int, int]]] = {
    "state, N = 64": (64, STATES, (64, 36)),
    "state, N = 256": (256, STATES, (64, 36)),
    "state, N = 1024": (1024, STATES, (64, 36)),
    "state, N = 4096": (4096, STATES, (64, 36)),
    "depth 64x36, N = 64": (64, ("depth", *STATES), (64, 36)),
    "depth and RGB 64x48, N = 64": (64, ("depth", "rgb", *STATES), (64, 48)),
    "depth and RGB 160x120, N = 64": (64, ("depth", "rgb", *STATES), (160, 120)),
}
"""Number of environments, observation, and image size."""


class Kernels:
    """Measures the CPU time of the image kernels."""

    def __init__(self) -> None:
        self._render, self.seconds = _native.render_views, 0.0
        _native.render_views = self

    def __call__(self, *arguments: Any, **keywords: Any) -> None:
        began = time.process_time()
        self._render(*arguments, **keywords)
        self.seconds += time.process_time() - began


def ahead(generator: np.random.Generator, count: int) -> np.ndarray:
    """Draws actions (count, 3) that fly ahead."""
    low, high = [0.0, -0.3, -0.1], [0.6, 0.3, 0.1]
    return generator.uniform(low, high, (count, 3)).astype(np.float32)


def measure(envs: VectorFlightEnv, kernels: Kernels, steps: int) -> np.ndarray:
    """Returns wall and CPU time of a step of one environment, and of it in the kernels [s]."""
    generator = np.random.default_rng(0)
    actions = [ahead(generator, envs.num_envs) for _ in range(8)]
    kernels.seconds = 0.0
    began = time.perf_counter(), time.process_time()
    for k in range(steps):
        envs.step(actions[k % 8])
    now = time.perf_counter(), time.process_time()
    spent = now[0] - began[0], now[1] - began[1], kernels.seconds
    return np.array(spent) / (steps * envs.num_envs)


def measure_drake(env: Any, with_depth: bool, steps: int) -> np.ndarray:
    """Returns the same for `DrakeGymEnv`, whose diagram renders."""
    generator = np.random.default_rng(0)
    diagram, context = env.simulator.get_system(), env.simulator.get_mutable_context()
    env.reset(seed=0)
    began = time.perf_counter(), time.process_time()
    for k in range(steps):
        if k % 30 == 29:
            env.reset(seed=0)
        env.step(3.0 * ahead(generator, 1)[0])
        if with_depth:
            diagram.GetOutputPort("observation_depth_image_32f").Eval(context)
    now = time.perf_counter(), time.process_time()
    return np.array([now[0] - began[0], now[1] - began[1], 0.0]) / steps


def reset_times(envs: VectorFlightEnv, count: int = 50) -> float:
    """Returns the time [s] of a reset of one environment, without its observation."""
    best = np.inf
    for k in range(count):
        began = time.perf_counter()
        envs._begin(np.array([k % envs.num_envs]))
        best = min(best, time.perf_counter() - began)
    return best


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenario", default="P02")
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--merged-spread", type=float, default=0.0, help="[px] of all cameras")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    options = parser.parse_args()
    scenario = find_scenario(options.scenario)
    base = OnboardCamera(max_depth=MAX_DEPTH, merged_spread=options.merged_spread)
    envs: dict[str, VectorFlightEnv] = {}
    for name, (count, observation, (width, height)) in CASES.items():
        envs[name] = VectorFlightEnv(
            count,
            scenario,
            num_worlds=options.worlds,
            observation=observation,
            camera=replace(base, width=width, height=height),
            threads=options.threads,
            rate=RATE,
            pool=next(iter(envs.values())).pool if envs else None,
        )
        envs[name].reset(seed=0)
    world = envs["state, N = 64"].pool.worlds[0]
    drake = {name: drake_env(scenario, world, base) for name in ("state", "depth 64x36")}
    kernels = Kernels()
    best: dict[str, np.ndarray] = {}
    for _ in range(options.rounds):
        for name, env in drake.items():
            spent, name = measure_drake(env, "depth" in name, 60), f"DrakeGymEnv, {name}"
            best[name] = np.minimum(spent, best.get(name, np.inf))
        for name, each in envs.items():
            spent = measure(each, kernels, 4 if "depth" in name else 16384 // each.num_envs)
            best[name] = np.minimum(spent, best.get(name, np.inf))
    print(
        f"{options.scenario}, {options.worlds} worlds, {options.threads} threads, merged_spread "
        f"{options.merged_spread:g} px, {machine()}"
    )
    header("environment", "steps/s", "CPU us a step", "outside image kernels")
    for name, (wall, cpu, inside) in best.items():
        share = f"{1 - inside / cpu:.0%}" if inside else ""
        row(name, f"{1 / wall:,.0f}", f"{1e6 * cpu:,.2f}", share)
    ratios = best["DrakeGymEnv, depth 64x36"] / best["depth 64x36, N = 64"]
    print(
        f"\ndepth 64x36 over DrakeGymEnv: {ratios[0]:.1f} by wall time, {ratios[1]:.1f} by CPU time"
    )
    periods = envs["state, N = 1024"]._steps["periods"]
    rate = periods / best["state, N = 1024"][0]
    print(f"updates of controllers, and steps of integrators, with N = 1024: {rate:,.0f} a second")
    print(f"reset of one environment: {1e3 * reset_times(envs['state, N = 1024']):.3f} ms")


if __name__ == "__main__":
    main()
