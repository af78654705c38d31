"""Quadrotor dynamics with commanded thrust and body rates, as pure functions.

State (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
Command (4): ``[c [m/s^2], w_cmd_B (3) [rad/s]]``, with c the thrust over mass along body +z.

The same formula serves floats, torch and numpy batches, and Drake's AutoDiffXd and Expression, so
that the simulated plant and the training loop share one model.
"""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.common.value import AbstractValue
from pydrake.symbolic import Expression
from pydrake.systems.framework import (
    BasicVector_,  # pyright: ignore[reportAttributeAccessIssue]
    LeafSystem_,  # pyright: ignore[reportAttributeAccessIssue]
    ValueProducer,
)

from splatpilot.systems.common.drake import (
    ConfigParameter,
    float_values,
    parameter_setter,
    require_finite,
    system_template,
    weak_callback,
)
from splatpilot.systems.common.validation import Config, bounded, require, require_type
from splatpilot.systems.vehicle.state import QuadrotorState, array_namespace, require_rotation

VEHICLE_RADIUS = 0.354
"""Propeller-tip radius of the vehicle [m]: closer than this to a surface is a collision."""

GRAVITY = 9.81  # Standard gravity [m/s^2], along -z of the world.

_NORM_GAIN = 5.0  # [1/s] pull of the quaternion toward unit length; errors decay as exp(-10 t).


@dataclass
class QuadrotorParams(Config):
    """Parameters of the quadrotor; the defaults describe a small camera drone."""

    # [1/s] Linear drag coefficient over mass. Identified racing quadrotors have 0.39-0.54
    # (Faessler, Franchi, Scaramuzza, RA-L 2018).
    drag: float = bounded(0.375, "[0, inf) 1/s")
    # [s] First-order lag of the body rates behind their command.
    rate_time_constant: float = bounded(0.05, "(0, inf) s")
    # [m/s^2] Gravitational acceleration, along -z of the world.
    gravity: float = bounded(GRAVITY, "[0, inf) m/s^2")


def hover_state(p_WB: Sequence[float] | np.ndarray, yaw: float = 0.0) -> np.ndarray:
    """Returns the state (13,) at rest, level at `p_WB` (3,) [m], facing `yaw` [rad] from x."""
    q_WB = [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
    return QuadrotorState(p_WB, np.zeros(3), q_WB, np.zeros(3)).to_vector()


def quadrotor_derivatives(state: Any, command: Any, params: QuadrotorParams) -> Any:
    """Returns the time derivative (..., 13) of ``state`` (..., 13) under ``command`` (..., 4).

    Their leading shapes broadcast. With z_B the body z axis and ⊗ the Hamilton product::

        d/dt p_WB   = v_WB
        d/dt v_WB   = c z_B - g e_z - drag v_WB
        d/dt q_WB   = 1/2 q_WB ⊗ (0, w_WB_B) + 5 (1 - |q_WB|²) q_WB
        d/dt w_WB_B = (w_cmd_B - w_WB_B) / rate_time_constant

    The last term of the quaternion rate holds its length at one against integration error.
    """
    rates = component_derivatives(
        [state[..., i] for i in range(13)], [command[..., i] for i in range(4)], *astuple(params)
    )
    xp = array_namespace(state)
    if xp is not np:
        return xp.stack(xp.broadcast_tensors(*rates), dim=-1)
    shape = np.broadcast_shapes(state.shape[:-1], command.shape[:-1])
    derivatives = np.empty((*shape, 13), np.result_type(state, command))
    for i, rate in enumerate(rates):
        derivatives[..., i] = rate
    return derivatives


def component_derivatives(
    state: Any,
    command: Any,
    drag: Any,
    rate_time_constant: Any,
    gravity: Any,
    wind: Any = None,
    disturbance: Any = None,
) -> tuple[Any, ...]:
    """Returns the 13 components of :func:`quadrotor_derivatives` from 13 + 4 components; plain
    Python floats are by far the fastest for a single vehicle.

    Args:
        wind: v_WA (3) [m/s] of the air in W: drag acts on v_WB - v_WA.
        disturbance: added acceleration (3) [m/s^2] in W.
    """
    _, _, _, vx, vy, vz, qw, qx, qy, qz, wx, wy, wz = state
    c, wx_cmd, wy_cmd, wz_cmd = command
    norm2 = qw * qw + qx * qx + qy * qy + qz * qz
    thrust = c / norm2
    pull = _NORM_GAIN * (1.0 - norm2)
    v_AB = (vx, vy, vz) if wind is None else (vx - wind[0], vy - wind[1], vz - wind[2])
    a_WB = (
        thrust * (2.0 * (qx * qz + qw * qy)) - drag * v_AB[0],
        thrust * (2.0 * (qy * qz - qw * qx)) - drag * v_AB[1],
        thrust * (qw * qw - qx * qx - qy * qy + qz * qz) - drag * v_AB[2] - gravity,
    )
    if disturbance is not None:
        a_WB = tuple(a + added for a, added in zip(a_WB, disturbance, strict=True))
    return (
        *(vx, vy, vz),
        *a_WB,
        0.5 * (-qx * wx - qy * wy - qz * wz) + pull * qw,
        0.5 * (qw * wx + qy * wz - qz * wy) + pull * qx,
        0.5 * (qw * wy + qz * wx - qx * wz) + pull * qy,
        0.5 * (qw * wz + qx * wy - qy * wx) + pull * qz,
        (wx_cmd - wx) / rate_time_constant,
        (wy_cmd - wy) / rate_time_constant,
        (wz_cmd - wz) / rate_time_constant,
    )


def rk4_step(state: Any, command: Any, params: QuadrotorParams, dt: Any) -> Any:
    """Returns the state (..., 13) after ``dt`` [s] of constant ``command`` (..., 4), by one step of
    the classical Runge-Kutta method, for the array types of :func:`quadrotor_derivatives`."""
    k1 = quadrotor_derivatives(state, command, params)
    k2 = quadrotor_derivatives(state + 0.5 * dt * k1, command, params)
    k3 = quadrotor_derivatives(state + 0.5 * dt * k2, command, params)
    k4 = quadrotor_derivatives(state + dt * k3, command, params)
    return state + (dt / 6.0) * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@system_template("QuadrotorPlant_", (float, AutoDiffXd, Expression))
def QuadrotorPlant_(T):
    class QuadrotorPlant(LeafSystem_[T]):
        """Simulates a quadrotor: exact thrust, body rates with a short lag.

        .. pydrake_system::

            name: QuadrotorPlant
            input_ports: [command, wind, disturbance]
            output_ports: [state]

        - ``command`` (4), ``state`` (13): as at the top of this module; the state is continuous, by
          default a level hover at the world's origin.
        - ``wind`` (3), optional: v_WA [m/s] of the air in W; drag acts on v_WB - v_WA.
        - ``disturbance`` (3), optional: acceleration [m/s^2] in W, added to that of the forces.
        - Numeric parameter 0 (3): ``[drag [1/s], rate_time_constant [s], gravity [m/s^2]]``.

        See `quadrotor_derivatives`. Supports the scalars float, AutoDiffXd and Expression. A
        subclass supports them if it is a `system_template` of its own.
        Integrate in steps of at most 0.02 s: after 5 s of random commands at 50 Hz,
        ``runge_kutta3`` is within 2 cm of the solution.
        """

        def __init__(
            self,
            params: QuadrotorParams | None = None,
            initial_state: np.ndarray | None = None,
            *,
            converter: Any = None,
        ):
            super().__init__(converter=converter)
            params = QuadrotorParams() if params is None else params
            require_type(params, QuadrotorParams, "params")
            params.validate()
            start = hover_state([0.0, 0.0, 0.0]) if initial_state is None else initial_state
            start = np.array(start, dtype=float)
            valid = start.shape == (13,) and np.isfinite(start).all()
            require(valid, "initial_state", "13 finite numbers", start.tolist())
            require_rotation(QuadrotorState.of(start).q_WB)
            self._arguments = replace(params), start
            self._parameters = [ConfigParameter(self, T, params)]
            for name, size in (("command", 4), ("wind", 3), ("disturbance", 3)):
                self.DeclareVectorInputPort(name, size)
            index = self.DeclareContinuousState(BasicVector_[T](start))
            self.DeclareStateOutputPort("state", index)
            # Most inputs are constant within a step.
            calc = weak_callback(self._calc_inputs)
            self._inputs_index = self.DeclareCacheEntry(
                "inputs and parameters",
                ValueProducer(lambda: AbstractValue.Make(object()), calc),
                {self.all_input_ports_ticket(), self.all_parameters_ticket()},
            ).cache_index()

        SetDrag = parameter_setter("drag")
        SetRateTimeConstant = parameter_setter("rate_time_constant")
        SetGravity = parameter_setter("gravity")

        def get_input_port(self, port_index=0):
            """Returns an input port by its index; `command` by default."""
            return super().get_input_port(port_index)

        def DoCalcTimeDerivatives(self, context, derivatives):
            # Python floats, one by one: several times faster than arrays of numpy.
            vector = context.get_continuous_state_vector()
            state = [vector.GetAtIndex(i) for i in range(13)]
            inputs = self.get_cache_entry(self._inputs_index).Eval(context)
            try:
                rates = component_derivatives(state, *inputs)
            except ZeroDivisionError:
                raise ValueError(
                    f"q_WB and rate_time_constant of {self.get_name()} must not be zero, got "
                    f"{state[6:10]} and {inputs[2]} s at t = {context.get_time()} s"
                ) from None
            vector = derivatives.get_mutable_vector()
            for i, rate in enumerate(rates):
                vector.SetAtIndex(i, rate)

        def _calc_inputs(self, context, inputs):
            """Computes the arguments of `component_derivatives` after the state."""
            command, wind, disturbance = (self._read(index, context) for index in range(3))
            parameters = context.get_numeric_parameter(0).value().tolist()
            inputs.set_value((command, *parameters, wind, disturbance))

        def _read(self, index, context):
            vector = self.EvalVectorInput(context, index)
            if vector is None:  # Drake raises for a command that is not connected.
                return None if index > 0 else self.get_input_port(index).Eval(context)
            value = vector.value()
            if T is not Expression:  # Error control would shorten the steps without end.
                require_finite(self.get_input_port(index), context, float_values(value))
            return value.tolist()

    return QuadrotorPlant


QuadrotorPlant = QuadrotorPlant_[None]
