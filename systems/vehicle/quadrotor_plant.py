"""The quadrotor as a continuous Drake system."""

from dataclasses import astuple
from typing import Any

import numpy as np
from pydrake.systems.framework import (
    BasicVector_,  # pyright: ignore[reportAttributeAccessIssue]
    LeafSystem_,  # pyright: ignore[reportAttributeAccessIssue]
)
from pydrake.systems.scalar_conversion import TemplateSystem

from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.vehicle.quadrotor_dynamics import (
    QuadrotorParams,
    component_derivatives,
    hover_state,
)
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState


@TemplateSystem.define("QuadrotorPlant_")
def QuadrotorPlant_(T):
    class Impl(LeafSystem_[T]):
        """A quadrotor that follows commanded thrust exactly and body rates with a short lag.

        .. pydrake_system::

            name: QuadrotorPlant
            input_ports:
            - command
            output_ports:
            - state

        - ``command`` (4): ``[c [m/s^2], w_cmd_B (3) [rad/s]]``, c the thrust over mass along
          body +z.
        - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``,
          continuous; at the default Context ``initial_state``, a level hover at the world's
          origin where none is given.
        - Numeric parameter 0 (3): ``[drag [1/s], rate_time_constant [s], gravity [m/s^2]]``.

        The equations are those of
        :func:`~splatpilot.systems.vehicle.quadrotor_dynamics.quadrotor_derivatives`. Supports the
        scalars float, AutoDiffXd and Expression. Integrate in steps of at most 0.02 s without error
        control: after 5 s of new random commands every 0.02 s, ``runge_kutta3`` is within 2 cm of
        the solution and ``runge_kutta5``, at twice the cost, within 0.2 mm.

        Raises:
            ValueError: if a parameter is out of range, see :class:`QuadrotorParams`, or the initial
                state has another shape.
        """

        command_input_port = input_port("command")
        state_output_port = output_port("state")

        def _construct(
            self,
            params: QuadrotorParams | None = None,
            initial_state: np.ndarray | None = None,
            converter=None,
        ):
            super().__init__(converter=converter)
            params = params or QuadrotorParams()
            params.validate()
            self._defaults = astuple(params)
            self.DeclareNumericParameter(BasicVector_[T](list(self._defaults)))
            self.DeclareVectorInputPort("command", 4)
            start = hover_state([0.0, 0.0, 0.0]) if initial_state is None else initial_state
            self._start = QuadrotorState.of(np.asarray(start, dtype=float)).to_vector()
            index = self.DeclareContinuousState(BasicVector_[T](self._start))
            self.DeclareStateOutputPort("state", index)

        def _construct_copy(self, other, converter=None):
            params = QuadrotorParams(*other._defaults)
            Impl._construct(self, params, other._start, converter=converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            # Lists, because arithmetic on Python floats is several times faster than on numpy's.
            state = context.get_continuous_state_vector().CopyToVector().tolist()
            command = self.get_input_port(0).Eval(context).tolist()
            drag, tau, gravity = context.get_numeric_parameter(0).CopyToVector().tolist()
            try:
                rates = component_derivatives(state, command, drag, tau, gravity)
            except ZeroDivisionError:
                raise ValueError(
                    f"QuadrotorPlant: at t = {context.get_time()} s q_WB is {state[6:10]} and "
                    f"rate_time_constant is {tau} s but neither may be zero; set a unit "
                    "quaternion (w, x, y, z) and a positive time constant in the Context"
                ) from None
            derivatives.get_mutable_vector().SetFromVector(np.array(rates))

    return Impl


QuadrotorPlant: Any = QuadrotorPlant_[None]
