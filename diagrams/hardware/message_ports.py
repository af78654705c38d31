"""MessagePorts: adds publishers and subscribers to a diagram."""

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
    Adds `clock`, and publishers and subscribers that are connected to it.

    Args:
        builder: of the diagram.
        lcm: transport of the messages.
        tick: [s] between looks for messages.
    """

    def __init__(self, builder: DiagramBuilder, lcm: LCM, tick: float) -> None:
        self._builder, self._lcm, self._tick = builder, lcm, tick
        self.unix_time = builder.AddNamedSystem("clock", UnixClock()).get_output_port()

    def subscribe(self, codec: Codec, initial=None, name: str = "") -> MessageSubscriber:
        """Adds `{name}_subscriber`, by default of the name of the codec's port."""
        subscriber = MessageSubscriber(self._lcm, codec, self._tick, initial)
        self.add(f"{name or codec.port}_subscriber", subscriber)
        return subscriber

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
        optional = {"enabled": enabled, "decided": decided}
        sources = {name: port for name, port in optional.items() if port is not None}
        self.add(f"{codec.port}_publisher", publisher, {codec.port: source} | sources)

    def publish_measurement(
        self, name: str, codec: Codec, source: OutputPort, age: OutputPort
    ) -> None:
        """Adds `{name}_publisher`, see `MeasurementPublisher`."""
        publisher = MeasurementPublisher(self._lcm, codec, self._tick)
        self.add(f"{name}_publisher", publisher, {codec.port: source, "age": age})

    def add(self, name: str, system: System, sources: dict[str, OutputPort] | None = None) -> None:
        """Adds a system with the input `unix_time`, and connects it and its `sources` by name."""
        self._builder.AddNamedSystem(name, system)
        ConnectInputs(self._builder, system, {"unix_time": self.unix_time} | (sources or {}))
