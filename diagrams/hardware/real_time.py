"""Diagrams that run with the wall clock."""

import math
import time
from collections.abc import Callable

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram

from splatpilot.systems.messaging.bridge_status import UnixClock
from splatpilot.systems.messaging.lcm_ports import PUBLISH_OFFSET

MAX_LAG = 0.05
"""[s] by which a diagram may be behind the wall clock."""

_WATCH_PERIOD = 0.02  # [s] Between looks at whether it is over, which cost more than most ticks.


def run_in_real_time(
    simulator: Simulator,
    diagram: Diagram,
    tick: float,
    over: Callable[[float], bool],
    ready: Callable[[], object] = lambda: None,
) -> int:
    """
    Advances a diagram, which has a `UnixClock` named `clock`, tick by tick: the updates of none are
    made before its time on the wall clock.

    A tick that ends after the next should have begun is an overrun; the input `overruns` of the
    diagram, where it has one, counts them, and the input `lag` is by how much [s]. The next tick is
    then as long as it takes to catch up, and nothing that happens in it is left out. What it is
    behind by more than `MAX_LAG` is never caught up with: the diagram's time passes more slowly for
    once, and its `UnixClock` says so.

    The first tick, at time 0, may take as long as it likes.

    Args:
        simulator, diagram: at time 0.
        tick: [s].
        ready: called after the first tick; when it returns, time begins to pass.
        over: called with the time [s] fifty times a second, after a tick; that where it says yes
            was the last.

    Returns:
        The number of overruns.
    """
    root = simulator.get_mutable_context()
    clock = diagram.GetSubsystemByName("clock")
    assert isinstance(clock, UnixClock)
    clock_context = clock.GetMyMutableContextFromRoot(root)
    simulator.Initialize()  # Here and in the first tick is made what is kept for the whole flight.
    clock.set_epoch(clock_context, time.time())
    simulator.AdvanceTo(2 * PUBLISH_OFFSET)
    ready()
    # The wall clock is not read again: when it is set, messages do not seem to be older.
    epoch, started, number, overruns, told = time.time(), time.monotonic(), 0, 0, 0.0
    clock.set_epoch(clock_context, epoch)
    looked = -0.5 * _WATCH_PERIOD  # Between what is sent at multiples of it.
    while True:
        # What happens at a tick is sent just after it.
        simulator.AdvanceTo(number * tick + 2 * PUBLISH_OFFSET)
        if number * tick >= looked + _WATCH_PERIOD - 0.5 * tick:
            looked = number * tick
            if over(looked):
                return overruns
        number += 1
        # No message that comes until then changes what happens before that tick's updates.
        simulator.AdvanceTo(number * tick)
        late = time.monotonic() - (started + number * tick)
        overruns += late > 0.0
        lag = max(late, 0.0)
        for name, value in (("overruns", float(overruns)), ("lag", lag)):
            if lag != told and diagram.HasInputPort(name):
                diagram.GetInputPort(name).FixValue(root, np.array([value]))
        told = lag
        if late <= 0.0:
            time.sleep(-late)
            continue
        if late > MAX_LAG:
            started += late - MAX_LAG
            epoch += late - MAX_LAG
            clock.set_epoch(clock_context, epoch)
        number += math.floor(min(late, MAX_LAG) / tick)
