"""BridgeStatus: whether what is flown by is fresh, and what was lost."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.messaging.generated import lcmt_bridge_status
from splatpilot.systems.ports import input_port, output_port


class BridgeStatus(LeafSystem):
    """Sums up the signals that a vehicle is flown by, and forbids commands while one is too old.

    .. pydrake_system::

        name: BridgeStatus
        input_ports:
        - state_age
        - state_gaps
        - state_rejected
        - (the same of each image)
        - overruns
        output_ports:
        - status
        - enabled

    - ``s_age``, ``s_gaps``, ``s_rejected`` (1 each) of each signal ``s``: see
      :class:`MessageSubscriber`.
    - ``overruns`` (1): how many ticks ended too late; 0 where it is not connected.
    - ``status`` (6): mode, a constant of ``lcmt_bridge_status``; ages of the state and of the
      oldest image [s]; gaps and rejected messages of all signals together; overruns.
    - ``enabled`` (1): 1 while the mode is ``FLYING``, else 0.

    Stateless.
    """

    status_output_port = output_port("status")
    enabled_output_port = output_port("enabled")
    overruns_input_port = input_port("overruns")

    def __init__(self, images: list[str], max_age: float):
        """Constructs the system.

        Args:
            images: the names of the images that are flown by.
            max_age: [s], of the state and of each image.
        """
        super().__init__()
        self._signals, self._max_age = ["state", *images], max_age
        for signal in self._signals:
            for what in ("age", "gaps", "rejected"):
                self.DeclareVectorInputPort(f"{signal}_{what}", 1)
        self.DeclareVectorInputPort("overruns", 1)
        self.DeclareVectorOutputPort("status", 6, self._calc_status)
        self.DeclareVectorOutputPort("enabled", 1, self._calc_enabled)

    def _read(self, context: Context, what: str) -> np.ndarray:
        ports = (self.GetInputPort(f"{signal}_{what}") for signal in self._signals)
        return np.concatenate([np.asarray(port.Eval(context)) for port in ports])

    def _mode(self, ages: np.ndarray) -> int:
        if np.isinf(ages).any():
            return lcmt_bridge_status.WAITING
        fresh = ages.max() <= self._max_age
        return lcmt_bridge_status.FLYING if fresh else lcmt_bridge_status.STALE

    def _calc_status(self, context: Context, output: BasicVector) -> None:
        ages = self._read(context, "age")
        port = self.GetInputPort("overruns")
        overruns = np.asarray(port.Eval(context))[0] if port.HasValue(context) else 0.0
        counts = [self._read(context, what).sum() for what in ("gaps", "rejected")]
        status = [self._mode(ages), ages[0], max(ages[1:], default=0.0), *counts, overruns]
        output.SetFromVector(np.array(status))

    def _calc_enabled(self, context: Context, output: BasicVector) -> None:
        mode = self._mode(self._read(context, "age"))
        output.SetFromVector(np.array([float(mode == lcmt_bridge_status.FLYING)]))
