"""ArrivalTriggered: another system's update, when there is something new to update by."""

import math
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    LeafSystem,
    OutputPort,
    PortDataType,
    System,
)

from splatpilot.systems.ports import input_port, output_port

EARLIEST, LATEST = 0.8, 1.25
"""Of the period, after the last update: when one that comes is not too early, and when none is
waited for."""

_NOISE = 1e-4  # [s] In when the same observation was sent, as its age and the time tell it.


class _Last(NamedTuple):
    """Of the last update, in the discrete state."""

    time: float = -math.inf  # [s]
    sighted: float = -math.inf  # [s], of the last one by a new observation.
    observed: float = -math.inf  # [s], when the observation was sent that it saw,
    looked: float = -math.inf  # and that which was there at the last look.


class ArrivalTriggered(LeafSystem):
    """Runs the periodic update of a system when an observation comes, instead of at its own times.

    A policy that decides fifteen times a second on images that come fifteen times a second would
    find each up to a fifteenth of a second old, as the two are started. This one decides as an
    image comes, four fifths of a period after the last decision on one at the earliest; by one that
    came before that when the period is over; and without a new one after a period and a quarter. So
    the rate remains what the policy was made for, also where images are faster, slower, or missing.

    .. pydrake_system::

        name: ArrivalTriggered
        input_ports:
        - (ports of the system)
        - observation_age
        output_ports:
        - (ports of the system)
        - decided

    - The ports of the system, by their names.
    - ``observation_age`` (1): [s] since the observation was sent that the system's inputs have;
      infinite before the first.
    - ``decided`` (1): [s], the time of the last update.

    Looks every ``tick`` seconds from time 0; the first update is by the first observation. The
    discrete state is that of the system, and after it the times of the last update, of what it saw,
    and of what came since.
    """

    observation_age_input_port = input_port("observation_age")
    decided_output_port = output_port("decided")

    def __init__(self, system: System, tick: float):
        """Constructs the system.

        Args:
            system: whose update it runs, see `can_be_triggered`.
            tick: [s] between looks at what has come.

        Raises:
            ValueError: for a system that cannot be triggered.
        """
        super().__init__()
        if not can_be_triggered(system):
            raise ValueError(
                f"{type(system).__name__} cannot be triggered: it must have discrete state alone, "
                "updated at one period, and vectors as outputs"
            )
        self._system = system
        update = system.GetUniquePeriodicDiscreteUpdateAttribute()
        assert update is not None
        self._period = update.period_sec()
        for index in range(system.num_input_ports()):
            port = system.get_input_port(index)
            if port.get_data_type() == PortDataType.kVectorValued:
                self.DeclareVectorInputPort(port.get_name(), port.size())
            else:
                self.DeclareAbstractInputPort(port.get_name(), port.Allocate())
        self.DeclareVectorInputPort("observation_age", 1)
        default = system.CreateDefaultContext()
        for group in range(default.num_discrete_state_groups()):
            self.DeclareDiscreteState(default.get_discrete_state(group).value())
        self._last = int(self.DeclareDiscreteState(np.array(_Last())))
        for index in range(system.num_output_ports()):
            self._declare_output(system.get_output_port(index))
        self.DeclareVectorOutputPort("decided", 1, self._calc_decided, {self.xd_ticket()})
        self.DeclarePeriodicDiscreteUpdateEvent(tick, 0.0, self._update)

    def _declare_output(self, port: OutputPort) -> None:
        """Declares an output port of the system as one of this."""
        inputs = [
            index
            for index in range(self._system.num_input_ports())
            if self._system.HasDirectFeedthrough(index, int(port.get_index()))
        ]
        tickets = {self.xd_ticket(), *(self.get_input_port(i).ticket() for i in inputs)}
        index = int(port.get_index())

        def calc(context: Context, output: BasicVector) -> None:
            inner = self._system.get_output_port(index)
            output.SetFromVector(np.asarray(inner.Eval(self._context(context, inputs))))

        self.DeclareVectorOutputPort(port.get_name(), port.size(), calc, tickets)

    def _context(self, context: Context, inputs: list[int]) -> Context:
        """The system's Context at this instant, with values for some of its inputs."""
        inner = self._system.CreateDefaultContext()
        inner.SetTime(context.get_time())
        for group in range(inner.num_discrete_state_groups()):
            inner.SetDiscreteState(group, context.get_discrete_state(group).value())
        for index in inputs:
            if self.get_input_port(index).HasValue(context):
                value = self.get_input_port(index).Eval(context)
                self._system.get_input_port(index).FixValue(inner, value)
        return inner

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        last = _Last(*np.asarray(context.get_discrete_state(self._last).value()))
        now = context.get_time()
        observed = now - float(np.asarray(self.GetInputPort("observation_age").Eval(context))[0])
        comes, is_new = (observed > seen + _NOISE for seen in (last.looked, last.observed))
        due = last.time + LATEST * self._period
        if is_new:
            due = last.sighted + (EARLIEST if comes else 1.0) * self._period
        discrete_state.set_value(self._last, np.array(last._replace(looked=observed)))
        if math.isinf(observed) or now < due - 1e-6:
            return
        inner = self._context(context, list(range(self._system.num_input_ports())))
        updated = self._system.EvalUniquePeriodicDiscreteUpdate(inner)
        for group in range(inner.num_discrete_state_groups()):
            discrete_state.set_value(group, updated.value(group))
        discrete_state.set_value(
            self._last, np.array(_Last(now, now if is_new else last.sighted, observed, observed))
        )

    def _calc_decided(self, context: Context, output: BasicVector) -> None:
        output[0] = context.get_discrete_state(self._last)[0]


def can_be_triggered(system: System) -> bool:
    """Whether `ArrivalTriggered` can run a system: all its state is discrete and updated at one
    period, and its outputs are vectors."""
    context = system.CreateDefaultContext()
    others = context.num_continuous_states() + context.num_abstract_states()
    outputs = (system.get_output_port(index) for index in range(system.num_output_ports()))
    return (
        others == 0
        and system.GetUniquePeriodicDiscreteUpdateAttribute() is not None
        and all(port.get_data_type() == PortDataType.kVectorValued for port in outputs)
    )
