"""DelayedPose: where the vehicle was when the image that arrives now was taken."""

import math

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.sensing.frame_times import FrameTimes
from splatpilot.systems.vehicle.state_to_pose import pose_from_state
from splatpilot.systems.weakly import weakly


class DelayedPose(LeafSystem):
    """The pose within a quadrotor's state when the last frame was taken that has come.

    .. pydrake_system::

        name: DelayedPose
        input_ports:
        - state
        output_ports:
        - pose

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``pose`` (abstract, RigidTransform): X_WB at ``now - age``, the age that of the last frame;
      before there is anything that old, the earliest known.

    The discrete state holds samples of time and state every ``period`` (0.02 s); between them
    the state is interpolated linearly, and its quaternion normalised.
    """

    state_input_port = input_port("state")
    pose_output_port = output_port("pose")

    def __init__(self, frames: FrameTimes, period: float = 0.02) -> None:
        """Constructs the system.

        Args:
            frames: when they are taken, and when they come.
            period: time between samples [s].

        Raises:
            ValueError: if a delay of frames is negative, or `period` not positive.
        """
        super().__init__()
        if not (frames.delays.min() >= 0.0 and math.isfinite(frames.oldest) and period > 0.0):
            raise ValueError(
                f"DelayedPose: frames come {frames.delays.min()} s late and the period is "
                f"{period} s; they must be at least 0 and finite, and more than 0"
            )
        self._frames = frames
        samples = math.ceil(frames.oldest / period) + 1
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
        then = context.get_time() - self._frames.age(context.get_time())
        state = np.array([np.interp(then, rows[:, 0], column) for column in rows[:, 1:].T])
        output.set_value(pose_from_state(state))
