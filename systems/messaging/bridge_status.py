"""BridgeStatus: what is flown by, and what was lost."""

from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.common.drake import input_port, optional_input, output_port


class BridgeStatus(LeafSystem):
    """Sums up the signals that a vehicle is flown by, and how it is flown.

    .. pydrake_system::

        name: BridgeStatus
        input_ports:
        - state_age
        - state_gaps
        - state_rejected
        - (the same of each image)
        - overruns
        - mode
        output_ports:
        - status
        - observation_age

    - ``s_age``, ``s_gaps``, ``s_rejected`` (1 each) of each signal ``s``: see
      :class:`MessageSubscriber`.
    - ``overruns`` (1): how many ticks ended too late; 0 where it is not connected.
    - ``mode`` (2): see :class:`~splatpilot.systems.messaging.failsafe.Failsafe`.
    - ``status`` (7): mode and reason; ages of the state and of the oldest image [s]; gaps and
      rejected messages of all signals together; overruns.
    - ``observation_age`` (1): of the oldest image [s], 0 where there is none.

    Stateless.
    """

    status_output_port = output_port("status")
    observation_age_output_port = output_port("observation_age")
    overruns_input_port = input_port("overruns")
    mode_input_port = input_port("mode")

    def __init__(self, images: list[str]):
        """Constructs the system; `images` are the names of those that are flown by."""
        super().__init__()
        self._signals = ["state", *images]
        for signal in self._signals:
            for what in ("age", "gaps", "rejected"):
                self.DeclareVectorInputPort(f"{signal}_{what}", 1)
        self.DeclareVectorInputPort("overruns", 1)
        self.DeclareVectorInputPort("mode", 2)
        self.DeclareVectorOutputPort("status", 7, self._calc_status)
        tickets = {self.GetInputPort(f"{signal}_age").ticket() for signal in self._signals[1:]} or {
            self.nothing_ticket()
        }
        self.DeclareVectorOutputPort("observation_age", 1, self._calc_observation_age, tickets)

    def _read(self, context: Context, what: str) -> np.ndarray:
        ports = (self.GetInputPort(f"{signal}_{what}") for signal in self._signals)
        return np.concatenate([np.asarray(port.Eval(context)) for port in ports])

    def _calc_status(self, context: Context, output: BasicVector) -> None:
        ages = self._read(context, "age")
        overruns = optional_input(self, "overruns", context)
        counts = [self._read(context, what).sum() for what in ("gaps", "rejected")]
        mode = np.asarray(self.GetInputPort("mode").Eval(context))
        late = 0.0 if overruns is None else overruns[0]
        status = [*mode, ages[0], max(ages[1:], default=0.0), *counts, late]
        output.SetFromVector(np.array(status))

    def _calc_observation_age(self, context: Context, output: BasicVector) -> None:
        output[0] = max(self._read(context, "age")[1:], default=0.0)


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
