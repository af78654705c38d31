"""How fast the privileged planner plans, and how well it flies forests: run by hand.

    python benchmarks/privileged_planner.py [--forests 20] [--speed 2.0]

Prints milliseconds a plan, seconds for the time of arrival, and for two densities of forest
(36 x 16 x 6 m, trunks as a Poisson disk sample) how many of the flights of the whole closed loop
reach the goal with positive clearance, at what speed and clearance. Times are the least of
repeats, on one thread.
"""

import argparse
import os
import time
from functools import partial
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Cylinder, HalfSpace
from splatpilot.systems.policies.hypotheses import HypothesisSelector
from splatpilot.systems.policies.lattice import LatticeConfig, TrajectoryLattice
from splatpilot.systems.policies.planner import PrivilegedPlanner, PrivilegedPlannerConfig, plan
from splatpilot.systems.policies.time_of_arrival import time_of_arrival
from splatpilot.systems.vehicle.flatness import FlatnessController, FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorPlant, hover_state
from splatpilot.systems.vehicle.state import QuadrotorState

SIZE = np.array([36.0, 16.0, 6.0])
START = np.array([1.5, 8.0, 1.5])
GOAL = np.array([34.5, 8.0, 1.5])
FORESTS = {"sparse": (3.0, 0.25, 0.45), "dense": (2.1, 0.20, 0.35)}  # spacing, radii [m]


class Flight(NamedTuple):
    arrived: bool
    mean_speed: float  # [m/s]
    min_clearance: float  # [m]
    steps_per_second: float


def make_forest(seed: int, spacing: float, least: float, greatest: float) -> AnalyticDistanceField:
    """Ground and trunks `spacing` [m] apart, with room around start and goal."""
    rng = np.random.default_rng(seed)
    trunks: list[np.ndarray] = []
    for p in rng.uniform([0.0, 0.0], SIZE[:2], (20000, 2)):
        if all(np.hypot(*(p - q)) >= spacing for q in trunks):
            trunks.append(p)
    trunks = [p for p in trunks if min(np.hypot(*(p - q[:2])) for q in (START, GOAL)) > 1.5]
    radii = rng.uniform(least, greatest, len(trunks))
    shapes = [
        Cylinder(np.array([x, y, -1.0]), np.array([x, y, 7.0]), radius)
        for (x, y), radius in zip(trunks, radii, strict=True)
    ]
    ground = HalfSpace(np.array([0.0, 0.0, 1.0]), 0.0)
    return AnalyticDistanceField([*shapes, ground], np.zeros(3), SIZE)


def fly(world: AnalyticDistanceField, speed: float) -> Flight:
    """One flight of the closed loop, at most 40 s."""
    config = PrivilegedPlannerConfig(lattice=LatticeConfig(speed=speed))
    builder = DiagramBuilder()
    plant = builder.AddSystem(QuadrotorPlant())
    planner = builder.AddSystem(PrivilegedPlanner(esdf_from_distance_field(world, 0.2), config))
    selector = builder.AddSystem(HypothesisSelector(3, FlatnessControllerConfig().lookahead))
    controller = builder.AddSystem(FlatnessController())
    goal = builder.AddSystem(ConstantVectorSource(GOAL))
    state = plant.GetOutputPort("state")
    for system in (planner, selector, controller):
        builder.Connect(state, system.GetInputPort("state"))
    builder.Connect(goal.get_output_port(), planner.GetInputPort("goal"))
    builder.Connect(planner.GetOutputPort("hypotheses"), selector.GetInputPort("hypotheses"))
    builder.Connect(selector.GetOutputPort("waypoint"), controller.GetInputPort("waypoint"))
    builder.Connect(controller.GetOutputPort("command"), plant.GetInputPort("command"))
    logger = LogVectorOutput(state, builder, publish_period=0.02)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    plant.GetMyMutableContextFromRoot(context).SetContinuousState(hover_state(START))

    def monitor(root_context):
        p_WB = plant_position(root_context)
        if np.linalg.norm(p_WB - GOAL) < 0.5 or world.distance(p_WB) < VEHICLE_RADIUS:
            return EventStatus.ReachedTermination(diagram, "over")
        return EventStatus.DidNothing()

    simulator.set_monitor(monitor)
    started = time.perf_counter()
    simulator.AdvanceTo(40.0)
    wall = time.perf_counter() - started
    p_WB = np.vstack(
        [QuadrotorState.of(logger.FindLog(context).data().T).p_WB, plant_position(context)]
    )  # the log ends up to a sample before the flight does
    clearance = float(world.distance(p_WB).min()) - VEHICLE_RADIUS
    length = np.linalg.norm(np.diff(p_WB, axis=0), axis=1).sum()
    arrived = bool(np.linalg.norm(p_WB[-1] - GOAL) < 0.5) and clearance > 0.0
    return Flight(arrived, length / context.get_time(), clearance, context.get_time() / wall)


def plant_position(context: Context) -> np.ndarray:
    """p_WB (3,) [m] from the Context of the flight; the plant has all of its continuous state."""
    return QuadrotorState.of(context.get_continuous_state_vector().CopyToVector()).p_WB


def least_time(function, repeats: int) -> float:
    """The least wall time [s] of a call."""
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        function()
        times.append(time.perf_counter() - started)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description="Time and fly the privileged planner.")
    parser.add_argument("--forests", type=int, default=20, help="flights per kind of forest")
    parser.add_argument("--speed", type=float, default=2.0, help="nominal speed [m/s]")
    arguments = parser.parse_args()

    world = make_forest(0, *FORESTS["dense"])
    state = hover_state(START)
    QuadrotorState.of(state).v_WB[0] = arguments.speed
    lattice = TrajectoryLattice(LatticeConfig(speed=arguments.speed))
    for voxel_size in (0.2, 0.1):
        field = esdf_from_distance_field(world, voxel_size).conservative()
        toa = time_of_arrival(field, GOAL)
        marching = least_time(partial(time_of_arrival, field, GOAL), 3)
        planning = least_time(partial(plan, 0.0, state, field, toa, lattice), 100)
        print(
            f"voxels of {voxel_size} m ({field.distances.size}): "
            f"time of arrival {marching:.2f} s, plan {1e3 * planning:.2f} ms"
        )
    print("\nforest    arrived    m/s  clearance mean, least [m]  x real time")
    for name, parameters in FORESTS.items():
        flights = [
            fly(make_forest(seed, *parameters), arguments.speed)
            for seed in range(arguments.forests)
        ]
        arrived, speeds, clearances, rates = (
            np.array(column) for column in zip(*flights, strict=True)
        )
        print(
            f"{name:8} {arrived.sum():>4}/{len(flights):<3} {speeds.mean():6.2f} "
            f"{clearances.mean():14.2f}, {clearances.min():.2f} {np.median(rates):17.0f}"
        )


if __name__ == "__main__":
    main()
