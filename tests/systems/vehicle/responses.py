"""Values of systems' outputs, and responses of vehicles to constant commands."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import System

from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, QuadrotorPlant


def evaluate(system: System, output: str = "", time: float = 0.0, **inputs: Any) -> Any:
    """Returns the value of an output, by default of the only one, for values of inputs."""
    context = system.CreateDefaultContext()
    context.SetTime(time)
    for name, value in inputs.items():
        system.GetInputPort(name).FixValue(context, value)
    port = system.GetOutputPort(output) if output else system.get_output_port()
    return port.Eval(context)


def simulate(plant: System, step: float) -> Simulator:
    """Returns a simulator with a fixed step [s]."""
    simulator = Simulator(plant)
    ResetIntegratorFromFlags(simulator, "runge_kutta5", step)
    simulator.get_mutable_integrator().set_fixed_step_mode(True)
    return simulator


def fly(
    plant: System, commands: ArrayLike, step: float = 0.01, **inputs: ArrayLike | None
) -> NDArray[np.float64]:
    """Returns the states (n, 13) at the ends of commands (n, 4) of 0.1 s, with constant inputs."""
    simulator = simulate(plant, step)
    context, states = simulator.get_mutable_context(), []
    for name, value in inputs.items():
        if value is not None:
            plant.GetInputPort(name).FixValue(context, value)
    for k, command in enumerate(np.asarray(commands)):
        plant.GetInputPort("command").FixValue(context, command)
        simulator.AdvanceTo(0.1 * (k + 1))
        states.append(plant.GetOutputPort("state").Eval(context).copy())
    return np.array(states)


def respond(
    params: QuadrotorParams,
    command: ArrayLike,
    times: ArrayLike,
    start: NDArray | None = None,
    step: float = 0.001,
) -> NDArray[np.float64]:
    """Returns all continuous states (n, ...) at times [s] after a constant command (4)."""
    plant = QuadrotorPlant(params, start)
    simulator = simulate(plant, step)
    context, states = simulator.get_mutable_context(), []
    plant.get_input_port().FixValue(context, command)
    for time in np.asarray(times):
        simulator.AdvanceTo(time)
        states.append(context.get_continuous_state_vector().CopyToVector())
    return np.array(states)
