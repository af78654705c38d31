from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import DiagramBuilder

from splatpilot.diagrams.flight.flight_diagram import AddFlight, ExportFlight
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.gym.spaces import decisions
from splatpilot.diagrams.gym.vector_env import VectorFlightEnv
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams
from splatpilot.systems.vehicle.wind import Wind

LAGGING = Scenario(
    vehicle=QuadrotorParams(
        motor_time_constant=0.04,
        yaw_time_ratio=2.0,
        thrust_scale=0.97,
        max_thrust=18.0,
        max_tilt_rate=3.0,
        rotor_drag=[0.02, 0.03, 0.05],
        quadratic_drag=[0.01, 0.02, 0.03],
    ),
    wind=Wind(mean=[0.5, -0.3, 0.1]),
)


def random_actions(envs: VectorFlightEnv, steps: int) -> np.ndarray:
    """Returns actions (steps, N, n) that change smoothly."""
    noise = np.random.default_rng(0).normal(size=(steps + 8, *envs.action_space.shape))
    return np.clip(sum(noise[k : k + steps] for k in range(8)) / 4, -1, 1)


def fly_in_drake(
    envs: VectorFlightEnv, flight: int, actions: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    """Flies actions (steps, n) by AddFlight; returns states (steps, 13) and outcomes."""
    config, pool = envs.config, envs.pool
    scenario = replace(pool.scenarios[flight], appearance=0.0)
    world, builder = pool.worlds[pool.world[flight]], DiagramBuilder()
    ExportFlight(builder, AddFlight(builder, scenario, world, policy=config.action, camera=False))
    diagram = builder.Build()
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


@pytest.mark.parametrize("scenario", ["P02", LAGGING], ids=["ideal", "lagging"])
@pytest.mark.parametrize("action", ["velocity", "acceleration", "waypoint", "command"])
def test_flights_are_those_of_add_flight(action: str, scenario: str | Scenario) -> None:
    limits = {"command": [2.0, 0.3, 0.3, 0.5], "acceleration": [1.0] * 3}.get(action, [0.8] * 3)
    envs = VectorFlightEnv(3, scenario, action=action, action_limits=limits, num_worlds=2)
    envs.reset(seed=4)
    actions, flights, states = random_actions(envs, 100), envs._flight.copy(), []
    ends = np.zeros(3, int)
    outcomes: list[list[str]] = [[], [], []]
    for step, action_now in enumerate(actions):
        flying = np.array([not (each and each[-1]) for each in outcomes])
        if not flying.any():
            break
        _, _, _, _, infos = envs.step(action_now)
        states.append(envs._states.copy())
        for i in np.flatnonzero(flying):
            outcomes[i].append((infos.get("outcome", [None] * 3)[i]) or "")
            ends[i] = step
    for i in range(3):
        truth, ended = fly_in_drake(envs, flights[i], actions[:, i])
        count = min(len(truth), ends[i] + 1)
        whole = count if not ended[count - 1] else count - 1  # the ends differ by a period
        error = np.abs(np.array(states)[:whole, i] - truth[:whole]).max()
        assert error < 1e-9
        assert outcomes[i][:count] == ended[:count]
