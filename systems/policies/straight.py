"""The policy that looks at nothing: what a world asks of a policy is what this one lacks."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from splatpilot.systems.common.drake import input_port, output_port
from splatpilot.systems.common.validation import require_field
from splatpilot.systems.policies.velocity import approach_velocity, tracking_acceleration
from splatpilot.systems.vehicle.state import QuadrotorState


@dataclass
class StraightConfig:
    """How fast the straight line is flown."""

    # [m/s] Speed that is flown.
    speed: float = 2.0
    # [Hz] Decisions per second.
    rate: float = 15.0

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name, largest, unit in (("speed", 20.0, "m/s"), ("rate", 1000.0, "Hz")):
            valid = 0.0 < getattr(self, name) <= largest
            require_field(self, name, valid, f"in (0, {largest:g}] {unit}")


class Straight(LeafSystem):
    """Flies straight to the goal at a set speed, whatever stands there.

    .. pydrake_system::

        name: Straight
        input_ports:
        - state
        - goal
        output_ports:
        - acceleration

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded; a discrete state, zero before
      the first update.

    Updates at ``rate`` (15 Hz) from time 0 with the acceleration that leads to the velocity towards
    the goal: see `approach_velocity` and `tracking_acceleration`.

    Raises:
        ValueError: from the constructor on a config out of range.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    acceleration_output_port = output_port("acceleration")

    def __init__(self, config: StraightConfig | None = None) -> None:
        super().__init__()
        self._config = config or StraightConfig()
        self._config.validate()
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        self.DeclareStateOutputPort("acceleration", self.DeclareDiscreteState(3))
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / self._config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        p_WB, v_WB, _, _ = QuadrotorState.of(np.asarray(self._state_port.Eval(context)))
        p_WG = np.asarray(self._goal_port.Eval(context))
        v_wanted = approach_velocity(p_WB, p_WG, self._config.speed)
        discrete_state.set_value(tracking_acceleration(v_WB, v_wanted))
