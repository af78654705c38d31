"""ArrivalTriggered: another system's update, when there is something new to update by."""

import logging
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

from splatpilot.systems.common.drake import input_port, output_port

_log = logging.getLogger(__name__)

LATEST = 1.6
"""Periods after the last update in which no observation is waited for."""

_SAVED = 0.5  # Periods of rest that may be saved up, by which observations may come too early.
_LEAST = 0.95  # Periods between updates on average, at least: clocks differ.
_NOISE = 1e-4  # [s] In when the same observation was sent, as its age and the time tell it.


class _Last(NamedTuple):
    """What is kept in the discrete state."""

    time: float = -math.inf  # [s], of the last update.
    due: float = -math.inf  # [s], when an observation that comes is not too early.
    observed: float = -math.inf  # [s], when the observation was sent that the last update saw,
    looked: float = -math.inf  # and that which was there at the last look.
    failed: float = 0.0  # Whether the last update raised an exception.


class ArrivalTriggered(LeafSystem):
    """Runs the periodic update of a system when an observation comes, instead of at its own times.

    A policy that decides fifteen times a second on images that come fifteen times a second would
    find each up to a fifteenth of a second old, as the two are started. This one decides as an
    image comes, as long as that is no more often than at its rate: of faster images some are left
    out, by the rule of virtual scheduling (ITU-T I.371, the generic cell rate algorithm). Without
    an image that comes in time it decides 1.6 periods after the last decision.

    An exception that the system raises is logged, once until the system decides again, and ends
    nothing: the last decision stands, and ``failed`` tells a failsafe not to fly by it.

    .. pydrake_system::

        name: ArrivalTriggered
        input_ports:
        - (ports of the system)
        - observation_age
        output_ports:
        - (ports of the system)
        - decided
        - failed

    - The ports of the system, by their names.
    - ``observation_age`` (1): [s] since the observation was sent that the system's inputs have;
      infinite before the first.
    - ``decided`` (1): [s], the time of the last update.
    - ``failed`` (1): 1 if the last update, or an output after it, raised an exception, else 0.
      Outputs that raise one are NaN.

    Looks every ``tick`` seconds from time 0; the first update is by the first observation. The
    discrete state is that of the system, and after it four times: of the last update, from which on
    the next may be, of what the last one saw, and of what came since; and ``failed``.
    """

    observation_age_input_port = input_port("observation_age")
    decided_output_port = output_port("decided")
    failed_output_port = output_port("failed")

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
        self.DeclareVectorOutputPort("failed", 1, self._calc_failed, {self.xd_ticket()})
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
            try:
                output.SetFromVector(np.asarray(inner.Eval(self._context(context, inputs))))
            except Exception:  # The next update logs it.
                output.SetFromVector(np.full(output.size(), np.nan))

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
        last = self._kept(context)
        now = context.get_time()
        observed = now - float(np.asarray(self.GetInputPort("observation_age").Eval(context))[0])
        comes, is_new = (observed > seen + _NOISE for seen in (last.looked, last.observed))
        wanted = (comes and now >= last.due) or now >= last.time + LATEST * self._period - 1e-6
        discrete_state.set_value(self._last, np.array(last._replace(looked=observed)))
        if math.isinf(observed) or not wanted:
            return
        due = last.due
        if is_new:
            due = max(due, now - _SAVED * self._period) + _LEAST * self._period
        failed = not self._decide(context, discrete_state)
        discrete_state.set_value(self._last, np.array(_Last(now, due, observed, observed, failed)))

    def _decide(self, context: Context, discrete_state: DiscreteValues) -> bool:
        """Updates the system's state; returns False, and logs why, if it raises an exception."""
        inner = self._context(context, list(range(self._system.num_input_ports())))
        try:
            updated = self._system.EvalUniquePeriodicDiscreteUpdate(inner)
            values = [updated.value(group) for group in range(inner.num_discrete_state_groups())]
            for group, value in enumerate(values):
                inner.SetDiscreteState(group, value)
            for index in range(self._system.num_output_ports()):
                self._system.get_output_port(index).Eval(inner)
        except Exception:
            if not self._kept(context).failed:
                _log.exception("the policy %s failed", type(self._system).__name__)
            return False
        for group, value in enumerate(values):
            discrete_state.set_value(group, value)
        return True

    def _kept(self, context: Context) -> _Last:
        return _Last(*np.asarray(context.get_discrete_state(self._last).value()))

    def _calc_decided(self, context: Context, output: BasicVector) -> None:
        output[0] = self._kept(context).time

    def _calc_failed(self, context: Context, output: BasicVector) -> None:
        output[0] = self._kept(context).failed


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
