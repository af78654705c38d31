"""ArrivalTriggered: runs another system's update when an observation arrives."""

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

from splatpilot.systems.common.drake import declare_input_ports_like, vector_input

_log = logging.getLogger(__name__)

_MAX_WAIT = 1.6  # [periods] max time between updates; then no observation is waited for.
_SAVED = 0.5  # [periods] of rest that may be saved up for observations that come early.
_MIN_MEAN = 0.95  # [periods] between updates, min average: clocks differ.
_NOISE = 1e-4  # [s] error of the time of an observation, computed from its age.


class _Last(NamedTuple):
    """The discrete state after that of the system."""

    time: float = -math.inf  # [s] of the last update.
    due: float = -math.inf  # [s] from which the next observation is not too early.
    observed: float = -math.inf  # [s] time of the observation of the last update,
    looked: float = -math.inf  # and of the one at the last look.
    failed: float = 0.0  # 1 if the last update raised an exception.


class ArrivalTriggered(LeafSystem):
    """Runs the periodic update of a system when an observation comes, instead of at its own times.

    It runs no more often than at the system's rate: it skips some of faster images, by virtual
    scheduling (ITU-T I.371, the generic cell rate algorithm), and runs without an image 1.6
    periods after the last update. Each observation counts as an update of a system without state.
    An exception is logged, once until the system succeeds again, and the state is kept.

    .. pydrake_system::

        name: ArrivalTriggered
        input_ports: [(ports of the system), observation_age]
        output_ports: [(ports of the system), decided, failed]

    - The ports of the system, by their names; outputs that raise an exception are NaN.
    - ``observation_age`` (1): [s] since the observation was sent; infinite before the first.
    - ``decided`` (1), ``failed`` (1): [s] of the last update, and 1 if it, or an output after it,
      raised an exception.

    The system must pass `can_be_triggered`. Looks every ``tick`` [s] from time 0.
    """

    def __init__(self, system: System, tick: float):
        super().__init__()
        self._system = system
        update = system.GetUniquePeriodicDiscreteUpdateAttribute()
        self._period = 0.0 if update is None else update.period_sec()
        declare_input_ports_like(self, system)
        self.DeclareVectorInputPort("observation_age", 1)
        default = system.CreateDefaultContext()
        for group in range(default.num_discrete_state_groups()):
            self.DeclareDiscreteState(default.get_discrete_state(group).value())
        self._last = int(self.DeclareDiscreteState(np.array(_Last())))
        for index in range(system.num_output_ports()):
            self._declare_output(system.get_output_port(index))
        for name, field in (("decided", "time"), ("failed", "failed")):

            def calc(context: Context, output: BasicVector, field: str = field) -> None:
                output[0] = getattr(self._get_last(context), field)

            self.DeclareVectorOutputPort(name, 1, calc, {self.xd_ticket()})
        self.DeclarePeriodicDiscreteUpdateEvent(tick, 0.0, self._update)

    def _declare_output(self, port: OutputPort) -> None:
        system, index = self._system, int(port.get_index())
        inputs = [
            k for k in range(system.num_input_ports()) if system.HasDirectFeedthrough(k, index)
        ]
        tickets = {self.xd_ticket(), *(self.get_input_port(k).ticket() for k in inputs)}

        def calc(context: Context, output: BasicVector) -> None:
            inner = self._system.get_output_port(index)
            try:
                output.SetFromVector(np.asarray(inner.Eval(self._inner(context, inputs))))
            except Exception:  # The next update logs it.
                output.SetFromVector(np.full(output.size(), np.nan))

        self.DeclareVectorOutputPort(port.get_name(), port.size(), calc, tickets)

    def _inner(self, context: Context, inputs: list[int]) -> Context:
        """Returns the system's Context at this instant, with values for some of its inputs."""
        inner = self._system.CreateDefaultContext()
        inner.SetTime(context.get_time())
        for group in range(inner.num_discrete_state_groups()):
            inner.SetDiscreteState(group, context.get_discrete_state(group).value())
        for index in inputs:
            if (port := self.get_input_port(index)).HasValue(context):
                self._system.get_input_port(index).FixValue(inner, port.Eval(context))
        return inner

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        last, now = self._get_last(context), context.get_time()
        observed = now - float(vector_input(self, "observation_age", context)[0])
        comes, is_new = (observed > seen + _NOISE for seen in (last.looked, last.observed))
        is_late = self._period > 0.0 and now >= last.time + _MAX_WAIT * self._period - 1e-6
        discrete_state.set_value(self._last, np.array(last._replace(looked=observed)))
        if math.isinf(observed) or not ((comes and now >= last.due) or is_late):
            return
        due = last.due
        if is_new:
            due = max(due, now - _SAVED * self._period) + _MIN_MEAN * self._period
        failed = not self._run(context, discrete_state)
        discrete_state.set_value(self._last, np.array(_Last(now, due, observed, observed, failed)))

    def _run(self, context: Context, discrete_state: DiscreteValues) -> bool:
        """Updates the system's state; returns False, and logs why, if it raises an exception."""
        inner = self._inner(context, list(range(self._system.num_input_ports())))
        try:
            if self._period > 0.0:
                inner.SetDiscreteState(self._system.EvalUniquePeriodicDiscreteUpdate(inner))
            for index in range(self._system.num_output_ports()):
                self._system.get_output_port(index).Eval(inner)
        except Exception:
            if not self._get_last(context).failed:
                _log.exception("the policy %s failed", type(self._system).__name__)
            return False
        for group in range(inner.num_discrete_state_groups()):
            discrete_state.set_value(group, inner.get_discrete_state(group).value())
        return True

    def _get_last(self, context: Context) -> _Last:
        return _Last(*np.asarray(context.get_discrete_state(self._last).value()))


def can_be_triggered(system: System) -> bool:
    """Checks if `ArrivalTriggered` can run a system: all its state, if any, is discrete, with
    updates of one period, and its outputs are vectors."""
    context = system.CreateDefaultContext()
    others = context.num_continuous_states() + context.num_abstract_states()
    updates = system.GetUniquePeriodicDiscreteUpdateAttribute() is not None
    outputs = (system.get_output_port(index) for index in range(system.num_output_ports()))
    return (
        others == 0
        and (updates or context.num_discrete_state_groups() == 0)
        and all(port.get_data_type() == PortDataType.kVectorValued for port in outputs)
    )
