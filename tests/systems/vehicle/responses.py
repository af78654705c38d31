"""Responses of vehicles to constant commands."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator

from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, QuadrotorPlant


def respond(
    params: QuadrotorParams,
    command: ArrayLike,
    times: ArrayLike,
    start: NDArray | None = None,
    step: float = 0.001,
) -> NDArray[np.float64]:
    """Returns all continuous states (n, ...) at times [s] after a constant command (4)."""
    plant = QuadrotorPlant(params, start)
    simulator = Simulator(plant)
    ResetIntegratorFromFlags(simulator, "runge_kutta5", step)
    simulator.get_mutable_integrator().set_fixed_step_mode(True)
    context, states = simulator.get_mutable_context(), []
    plant.get_input_port().FixValue(context, command)
    for time in np.asarray(times):
        simulator.AdvanceTo(time)
        states.append(context.get_continuous_state_vector().CopyToVector())
    return np.array(states)
