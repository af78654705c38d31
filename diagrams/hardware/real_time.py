"""Diagrams that run with the wall clock."""

import math
import time
from collections.abc import Callable
from typing import cast

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram

from splatpilot.systems.messaging.bridge_status import UnixClock
from splatpilot.systems.messaging.lcm_ports import PUBLISH_OFFSET

MAX_LAG = 0.05  # [s] Max lag of a diagram behind the wall clock.
_WATCH_PERIOD = 0.02  # [s] between calls of `over`, which is slower than most ticks.


def output(diagram: Diagram, name: str, root: Context) -> np.ndarray:
    """Returns the vector at an output port of a diagram."""
    return np.asarray(diagram.GetOutputPort(name).Eval(root))


def run_in_real_time(
    simulator: Simulator,
    diagram: Diagram,
    tick: float,
    over: Callable[[float], bool],
    ready: Callable[[], object] = lambda: None,
) -> int:
    """Advances a diagram, which has a `UnixClock` named `clock`, tick by tick. No tick is updated
    before its time on the wall clock.

    A tick that ends after the begin of the next is an overrun; their number is returned. The
    diagram's inputs `overruns` and `lag` [s], if any, tell number and delay. The next tick is then
    longer, to catch up without leaving anything out. A lag above `MAX_LAG` is not caught up
    with: the diagram's time stops meanwhile, and its `UnixClock` is set.

    Args:
        over: called with the time [s] fifty times a second, after a tick; returns True to end.
        ready: called after the first tick, which may be long; then time begins to pass.
    """
    root = simulator.get_mutable_context()
    clock = cast(UnixClock, diagram.GetSubsystemByName("clock"))
    simulator.Initialize()  # This and the first tick fill caches.
    clock.set_epoch(root, time.time())
    simulator.AdvanceTo(2 * PUBLISH_OFFSET)
    ready()
    # The wall clock is read once, since it may be set.
    epoch, started, number, overruns, told = time.time(), time.monotonic(), 0, 0, 0.0
    clock.set_epoch(root, epoch)
    looked = -0.5 * _WATCH_PERIOD  # Between messages, which are sent at multiples of it.
    while True:
        # Messages of a tick are sent just after it.
        simulator.AdvanceTo(number * tick + 2 * PUBLISH_OFFSET)
        if number * tick >= looked + _WATCH_PERIOD - 0.5 * tick:
            looked = number * tick
            if over(looked):
                return overruns
        number += 1
        # Messages that come until then have no effect before the updates of that tick.
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
            clock.set_epoch(root, epoch)
        number += math.floor(min(late, MAX_LAG) / tick)
