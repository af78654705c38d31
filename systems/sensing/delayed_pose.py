"""DelayedPose: where the vehicle was when the image that arrives now was taken."""

import math

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.vehicle.state_to_pose import pose_from_state
from splatpilot.systems.weakly import weakly


class DelayedPose(LeafSystem):
    """The pose within a quadrotor's state, a fixed time ago.

    .. pydrake_system::

        name: DelayedPose
        input_ports:
        - state
        output_ports:
        - pose

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``pose`` (abstract, RigidTransform): X_WB at ``now - latency``; before there is anything that
      old, the earliest known.

    The discrete state holds samples of time and state every ``period`` (0.02 s); between them
    the state is interpolated linearly, and its quaternion normalised.
    """

    state_input_port = input_port("state")
    pose_output_port = output_port("pose")

    def __init__(self, latency: float, period: float = 0.02) -> None:
        """Constructs the system.

        Args:
            latency: age of the pose [s].
            period: time between samples [s].

        Raises:
            ValueError: if `latency` is negative or not finite, or `period` not positive.
        """
        super().__init__()
        if not (0.0 <= latency < math.inf and period > 0.0):
            raise ValueError(
                f"DelayedPose: latency is {latency} s and period {period} s; they must be at least "
                "0 and more than 0"
            )
        self._latency = latency
        samples = math.ceil(latency / period) + 1
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self.DeclareDiscreteState(np.full(samples * 14, np.nan))
        calc = weakly(self._calc_pose)
        self.DeclareAbstractOutputPort("pose", lambda: Value(RigidTransform()), calc)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._sample)

    def _samples(self, context: Context) -> np.ndarray:
        """Rows of time and state (n, 14) up to now, oldest first; NaN before the first."""
        now = np.append(context.get_time(), np.asarray(self._state_port.Eval(context)))
        held = np.asarray(context.get_discrete_state_vector().value()).reshape(-1, 14)
        return np.vstack([held, now])

    def _sample(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._samples(context)[1:].ravel())

    def _calc_pose(self, context, output) -> None:
        rows = self._samples(context)
        rows = rows[np.isfinite(rows[:, 0])]
        then = context.get_time() - self._latency
        state = np.array([np.interp(then, rows[:, 0], column) for column in rows[:, 1:].T])
        output.set_value(pose_from_state(state))
