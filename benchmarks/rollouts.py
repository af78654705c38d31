"""Speed of rollouts, each without anything but the flight.

    python benchmarks/rollouts.py [--flights 8]

Prints the real-time factor of flights through the default forest: without images (the planner),
with depth images alone (the reactive policy, and DiffAero in P02), and with color and depth at
320x240 and 15 Hz. Then the rollouts per minute of one and of two worker processes, on the same
flights. Run it on an idle machine: factors are of wall time, the best of three; CPU time is given
beside them.
"""

import argparse
import os
import time

from splatpilot.analysis.benchmark.run_study import fly_all
from splatpilot.analysis.benchmark.study import RolloutSpec
from splatpilot.diagrams.flight.flight import fly
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config

os.environ.setdefault("OMP_NUM_THREADS", "1")


def time_policies(repeats: int = 3) -> None:
    """Prints a line for each kind of flight."""
    forest, p02 = Scenario(seed=10), load_config(Scenario(), scenario_file("P02"))
    print(f"{'flight':<40}{'x real time':>12}{'of CPU time':>12}")
    for name, scenario, policy, video in (
        ("planner, no images", forest, "planner", False),
        ("reactive, depth 64x36 at 15 Hz", forest, "reactive", False),
        ("diffaero in P02, depth 64x36 at 15 Hz", p02, "diffaero", False),
        ("planner, color 320x240 at 15 Hz", forest, "planner", True),
    ):
        world = make_world(scenario.world, scenario.seed)
        scenario.policy = policy_named(policy)
        diagram = BuildFlightDiagram(scenario, world, camera=video, video=video)
        wall, cpu = [], []
        for _ in range(repeats):
            started = time.process_time()
            flight = fly(diagram, scenario, world)
            cpu.append(flight.times[-1] / (time.process_time() - started))
            wall.append(flight.times[-1] / flight.wall_time)
        print(f"{name:<40}{max(wall):>12.1f}{max(cpu):>12.1f}")


def time_workers(count: int) -> None:
    """Prints rollouts per minute of one and two worker processes, after they have started."""
    specs = [RolloutSpec("forest", "reactive", 2.0, seed) for seed in range(count)]
    flights = [(spec, Scenario(seed=spec.seed, policy=policy_named("reactive"))) for spec in specs]
    rates = {}
    for jobs in (1, 2):
        started, ends = time.perf_counter(), []
        for _ in fly_all(flights, jobs):
            ends.append(time.perf_counter())
        # From the first end on: processes take seconds to start.
        rates[jobs] = 60.0 * (len(ends) - jobs) / (ends[-1] - ends[jobs - 1])
        print(f"{jobs} workers: {rates[jobs]:.1f} rollouts a minute", end="; ")
        print(f"{60.0 * len(ends) / (ends[-1] - started):.1f} with their start")
    print(f"two over one: {rates[2] / rates[1]:.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--flights", type=int, default=8, help="for the workers (%(default)s)")
    options = parser.parse_args()
    if options.flights < 3:
        parser.error(f"--flights is {options.flights}; two workers need at least 3")
    time_policies()
    time_workers(options.flights)
