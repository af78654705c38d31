"""FiniteVector: a signal for whoever cannot do with what is no number."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.ports import input_port, output_port


class FiniteVector(LeafSystem):
    """Gives zeros where any part of a signal is infinite or not a number.

    .. pydrake_system::

        name: FiniteVector
        input_ports:
        - signal
        output_ports:
        - finite

    Both are of the size that the constructor is given. Stateless.
    """

    signal_input_port = input_port("signal")
    finite_output_port = output_port("finite")

    def __init__(self, size: int):
        super().__init__()
        self.DeclareVectorInputPort("signal", size)
        self.DeclareVectorOutputPort("finite", size, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        signal = np.asarray(self.get_input_port().Eval(context))
        output.SetFromVector(signal if np.isfinite(signal).all() else np.zeros(len(signal)))
