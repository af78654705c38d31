"""FiniteVector: a signal for systems that need numbers."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.ports import input_port, output_port


class FiniteVector(LeafSystem):
    """Replaces a signal any part of which is infinite or not a number.

    .. pydrake_system::

        name: FiniteVector
        input_ports:
        - signal
        output_ports:
        - finite

    Both have the size that the constructor is given, ``finite`` is ``signal`` or ``substitute``
    throughout. Stateless.
    """

    signal_input_port = input_port("signal")
    finite_output_port = output_port("finite")

    def __init__(self, size: int, substitute: float = 0.0):
        super().__init__()
        self._substitute = substitute
        self.DeclareVectorInputPort("signal", size)
        self.DeclareVectorOutputPort("finite", size, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        signal = np.asarray(self.get_input_port().Eval(context))
        finite = bool(np.isfinite(signal).all())
        output.SetFromVector(signal if finite else np.full(len(signal), self._substitute))
