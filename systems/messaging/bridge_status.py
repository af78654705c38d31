"""BridgeStatus: summary of a bridge's inputs; UnixClock: the time of its messages."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.common.drake import vector_input


class BridgeStatus(LeafSystem):
    """Summarizes mode, ages of inputs, and lost messages of a bridge.

    .. pydrake_system::

        name: BridgeStatus
        input_ports: [state_age, state_gaps, state_rejected, (the same of each image), overruns,
            mode]
        output_ports: [status, observation_age]

    - ``s_age``, ``s_gaps``, ``s_rejected`` (1 each) of each input ``s``: see `MessageSubscriber`.
    - ``overruns`` (1), optional: number of ticks that ended too late.
    - ``mode`` (2): see `Failsafe`.
    - ``status`` (7): mode and reason; ages of the state and of the oldest image [s]; sums of gaps
      and of rejected messages; overruns.
    - ``observation_age`` (1): of the oldest image [s], 0 without images.
    """

    def __init__(self, images: list[str]):
        super().__init__()
        self._inputs = ["state", *images]
        for name in self._inputs:
            for signal in ("age", "gaps", "rejected"):
                self.DeclareVectorInputPort(f"{name}_{signal}", 1)
        self.DeclareVectorInputPort("overruns", 1)
        self.DeclareVectorInputPort("mode", 2)
        self.DeclareVectorOutputPort("status", 7, self._calc_status)
        tickets = {self.GetInputPort(f"{image}_age").ticket() for image in images}
        tickets = tickets or {self.nothing_ticket()}
        self.DeclareVectorOutputPort("observation_age", 1, self._calc_observation_age, tickets)

    def _read(self, context: Context, signal: str, first: int = 0) -> list[float]:
        names = [f"{name}_{signal}" for name in self._inputs[first:]]
        return [vector_input(self, name, context)[0] for name in names]

    def _calc_status(self, context: Context, output: BasicVector) -> None:
        mode, overruns = vector_input(self, "mode", context), 0.0
        if self.GetInputPort("overruns").HasValue(context):
            overruns = vector_input(self, "overruns", context)[0]
        ages = self._read(context, "age")
        gaps, rejected = (sum(self._read(context, signal)) for signal in ("gaps", "rejected"))
        oldest = max(ages[1:], default=0.0)
        output.SetFromVector(np.array([*mode, ages[0], oldest, gaps, rejected, overruns]))

    def _calc_observation_age(self, context: Context, output: BasicVector) -> None:
        output[0] = max(self._read(context, "age", first=1), default=0.0)


class UnixClock(LeafSystem):
    """Outputs ``unix_time`` (1) [s], which stamps messages: the epoch, numeric parameter 0, plus
    the Context's time."""

    def __init__(self):
        super().__init__()
        self.DeclareNumericParameter(BasicVector(np.zeros(1)))
        self.DeclareVectorOutputPort("unix_time", 1, self._calc)

    def set_epoch(self, root: Context, epoch: float) -> None:
        """Sets the Unix time [s] of the time 0 of a root Context."""
        context = self.GetMyMutableContextFromRoot(root)
        context.get_mutable_numeric_parameter(0).SetFromVector(np.array([epoch]))

    def _calc(self, context: Context, output: BasicVector) -> None:
        output[0] = context.get_numeric_parameter(0)[0] + context.get_time()
