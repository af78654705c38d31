"""MessagePorts: adds publishers, subscribers and other systems to a diagram."""

from typing import Any

from lcm import LCM
from pydrake.systems.framework import DiagramBuilder, OutputPort, System

from splatpilot.diagrams.flight.blocks import ConnectInputs
from splatpilot.systems.messaging.bridge_status import UnixClock
from splatpilot.systems.messaging.codecs import Codec
from splatpilot.systems.messaging.lcm_ports import (
    MeasurementPublisher,
    MessagePublisher,
    MessageSubscriber,
)


class MessagePorts:
    """
    Adds `clock`, and systems whose inputs are connected by their names, `unix_time` to the clock.

    Args:
        tick: [s] between looks for messages.
    """

    def __init__(self, builder: DiagramBuilder, lcm: LCM, tick: float) -> None:
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
