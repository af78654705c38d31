"""UnixClock: what time it is in the world outside."""

from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.ports import output_port


class UnixClock(LeafSystem):
    """Says which Unix time the Context's time is, to stamp messages with and to tell their age.

    .. pydrake_system::

        name: UnixClock
        output_ports:
        - unix_time

    - ``unix_time`` (1): [s], the Context's time later than the epoch.
    - Numeric parameter 0 (1): the epoch [s], the Unix time of the Context's time 0; who runs the
      diagram in real time sets it when that starts.
    """

    unix_time_output_port = output_port("unix_time")

    def __init__(self):
        super().__init__()
        self.DeclareNumericParameter(BasicVector(np.zeros(1)))
        self.DeclareVectorOutputPort("unix_time", 1, self._calc)

    def set_epoch(self, context: Context, epoch: float) -> None:
        """Sets the Unix time [s] of the Context's time 0."""
        context.get_mutable_numeric_parameter(0).SetFromVector(np.array([epoch]))

    def _calc(self, context: Context, output: BasicVector) -> None:
        output[0] = context.get_numeric_parameter(0)[0] + context.get_time()


def time_of_reading(system: LeafSystem, context: Context, now: Callable[[], float] | None) -> float:
    """Returns the Unix time [s] at which a system has read what came: that of `now`, if any, else
    of its input `unix_time`.

    A process may be behind the wall clock, also within an update. What it reads then would seem to
    have come before it was sent. Call it after reading.
    """
    return now() if now else float(np.asarray(system.GetInputPort("unix_time").Eval(context))[0])
