"""Where a vehicle is now whose state was measured a moment ago."""

import math

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState

LONGEST_PREDICTION = 0.1
"""[s], how old states can be brought up to date."""


def predict_state(state: np.ndarray, duration: float) -> np.ndarray:
    """The state (13,) `duration` [s] later, if neither velocity nor body rates change meanwhile."""
    p_WB, v_WB, q_WB, w_WB_B = QuadrotorState.of(state)
    half = 0.5 * duration * w_WB_B
    angle = math.hypot(*half)
    turn = np.append(math.cos(angle), half * (np.sinc(angle / math.pi)))
    s, v, t, u = q_WB[0], q_WB[1:], turn[0], turn[1:]
    q = np.append(s * t - v.dot(u), s * u + t * v + np.cross(v, u))
    return QuadrotorState(p_WB + duration * v_WB, v_WB, q, w_WB_B).to_vector()


class StatePredictor(LeafSystem):
    """Brings a measured state up to date, see `predict_state`.

    .. pydrake_system::

        name: StatePredictor
        input_ports:
        - measured_state
        - age
        output_ports:
        - state

    - ``measured_state`` (13), ``state`` (13): as those of
      :class:`~splatpilot.systems.vehicle.quadrotor_plant.QuadrotorPlant`.
    - ``age`` (1): [s] since it was measured; it counts for 0 to ``longest``, so that neither clocks
      that disagree nor a vehicle that fell silent lead far away.

    Stateless.
    """

    measured_state_input_port = input_port("measured_state")
    age_input_port = input_port("age")
    state_output_port = output_port("state")

    def __init__(self, longest: float = LONGEST_PREDICTION):
        """Constructs the system; `longest` is how far it predicts [s]."""
        super().__init__()
        self._longest = longest
        self.DeclareVectorInputPort("measured_state", 13)
        self.DeclareVectorInputPort("age", 1)
        self.DeclareVectorOutputPort("state", 13, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        state = np.asarray(self.GetInputPort("measured_state").Eval(context))
        age = float(np.asarray(self.GetInputPort("age").Eval(context))[0])
        output.SetFromVector(predict_state(state, min(max(age, 0.0), self._longest)))
