"""Diagrams that exchange messages and run with the wall clock."""

import math
import time
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from lcm import LCM
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort, System

from splatpilot.diagrams.flight.blocks import ConnectInputs
from splatpilot.systems.common.validation import require
from splatpilot.systems.messaging.codecs import Codec
from splatpilot.systems.messaging.lcm_ports import (
    PUBLISH_OFFSET,
    MeasurementPublisher,
    MessagePublisher,
    MessageSubscriber,
    UnixClock,
)

MAX_LAG = 0.05  # [s] Max lag of a diagram behind the wall clock.
_WATCH_PERIOD = 0.02  # [s] between calls of `over`, which is slower than most ticks.


def run_in_real_time(
    simulator: Simulator,
    diagram: Diagram,
    tick: float,
    over: Callable[[float], bool],
    ready: Callable[[], object] = lambda: None,
) -> int:
    """Advances a diagram, which has a `UnixClock` named `clock`, tick by tick. No tick is updated
    before its time on the wall clock.

    A tick that ends after the begin of the next is an overrun; their number is returned, and given
    to the diagram's inputs `overruns` and `lag` [s], if any. The next tick is then longer. A lag
    above `MAX_LAG` is not caught up with: the diagram's time stops meanwhile.

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
    epoch, started, number, overruns, last_lag = time.time(), time.monotonic(), 0, 0, 0.0
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
            if lag != last_lag and diagram.HasInputPort(name):
                diagram.GetInputPort(name).FixValue(root, np.array([value]))
        last_lag = lag
        if late <= 0.0:
            time.sleep(-late)
            continue
        if late > MAX_LAG:
            started += late - MAX_LAG
            epoch += late - MAX_LAG
            clock.set_epoch(root, epoch)
        number += math.floor(min(late, MAX_LAG) / tick)


class MessagePorts:
    """Adds `clock`, and systems whose inputs are connected by their names, `unix_time` to the
    clock; systems look for messages every `tick` [s]."""

    def __init__(self, builder: DiagramBuilder, lcm: LCM, tick: float) -> None:
        given = f"{type(lcm).__module__}.{type(lcm).__name__}"
        require(hasattr(lcm, "subscribe"), "lcm", "a handle of the package lcm, as lcm.LCM", given)
        self._builder, self._lcm, self._tick = builder, lcm, tick
        self._unix_time = builder.AddNamedSystem("clock", UnixClock()).get_output_port()

    def add[S: System](self, name: str, system: S, **sources: OutputPort | None) -> S:
        """Adds a system; sources of None are left out."""
        self._builder.AddNamedSystem(name, system)
        if system.HasInputPort("unix_time"):
            sources["unix_time"] = self._unix_time
        connected = {name: port for name, port in sources.items() if port is not None}
        ConnectInputs(self._builder, system, connected)
        return system

    def subscribe(self, codec: Codec, initial: Any = None, name: str = "") -> MessageSubscriber:
        """Adds `{name}_subscriber`, by default of the name of the codec's port."""
        subscriber = MessageSubscriber(self._lcm, codec, self._tick, initial)
        return self.add(f"{name or codec.port}_subscriber", subscriber)

    def publish(
        self,
        codec: Codec,
        source: OutputPort,
        period: float,
        enabled: OutputPort | None = None,
        decided: OutputPort | None = None,
    ) -> None:
        """Adds `{port}_publisher`, see `MessagePublisher`."""
        tick = None if decided is None else self._tick
        publisher = MessagePublisher(self._lcm, codec, period, tick)
        sources = {codec.port: source, "enabled": enabled, "decided": decided}
        self.add(f"{codec.port}_publisher", publisher, **sources)

    def publish_measurement(
        self, name: str, codec: Codec, source: OutputPort, age: OutputPort
    ) -> None:
        """Adds `{name}_publisher`, see `MeasurementPublisher`."""
        publisher = MeasurementPublisher(self._lcm, codec, self._tick)
        self.add(f"{name}_publisher", publisher, **{codec.port: source, "age": age})
