from collections.abc import Callable

import lcm
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from splatpilot.systems.messaging.codecs import Codec
from splatpilot.systems.messaging.lcm_ports import MessageSubscriber, UnixClock

EPOCH = 1_800_000_000.25  # [s]


class Listener:
    """A subscriber in a diagram of its own, whose time the test advances."""

    def __init__(self, codec: Codec, period: float = 0.01):
        self.lcm = lcm.LCM("memq://")
        builder = DiagramBuilder()
        self.clock = builder.AddSystem(UnixClock())
        self.subscriber = builder.AddSystem(MessageSubscriber(self.lcm, codec, period))
        builder.Connect(self.clock.get_output_port(), self.subscriber.get_input_port())
        self.codec = codec
        self.simulator = Simulator(builder.Build())
        self.root = self.simulator.get_mutable_context()
        self.clock.set_epoch(self.root, EPOCH)

    def advance_to(self, time: float, *messages: bytes) -> None:
        """Sends messages, and advances to just after the updates at `time` [s]."""
        for data in messages:
            self.lcm.publish(self.codec.channel, data)
        self.simulator.AdvanceTo(time + 1e-6)

    def output(self, port: str, root=None):
        context = self.subscriber.GetMyContextFromRoot(root or self.root)
        return self.subscriber.GetOutputPort(port).Eval(context)

    @property
    def value(self):
        return self.output(self.codec.port)

    @property
    def counts(self) -> tuple[float, float]:
        return self.output("gaps")[0], self.output("rejected")[0]


@pytest.fixture
def listener() -> Callable[..., Listener]:
    return Listener
