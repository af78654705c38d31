from collections.abc import Callable

import lcm
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from splatpilot.systems.messaging.bridge_status import UnixClock
from splatpilot.systems.messaging.codecs import Codec
from splatpilot.systems.messaging.lcm_ports import MessageSubscriber

EPOCH = 1_800_000_000.25  # [s]


class Listener:
    """A subscriber in a diagram of its own, whose time the test advances."""

    def __init__(self, codec: Codec, period: float = 0.01, epoch: float = EPOCH):
        self.lcm = lcm.LCM("memq://")
        builder = DiagramBuilder()
        clock = builder.AddSystem(UnixClock())
        self.subscriber = builder.AddSystem(MessageSubscriber(self.lcm, codec, period))
        builder.Connect(clock.get_output_port(), self.subscriber.get_input_port())
        self.codec = codec
        self.simulator = Simulator(builder.Build())
        self.root = self.simulator.get_mutable_context()
        clock.set_epoch(clock.GetMyMutableContextFromRoot(self.root), epoch)

    def advance_to(self, time: float) -> None:
        """Advances to just after what happens at `time` [s]."""
        self.simulator.AdvanceTo(time + 1e-6)

    def output(self, port: str):
        context = self.subscriber.GetMyContextFromRoot(self.root)
        return self.subscriber.GetOutputPort(port).Eval(context)

    @property
    def value(self):
        return self.output(self.codec.port)

    def number(self, port: str) -> float:
        return float(self.output(port)[0])


@pytest.fixture
def listener() -> Callable[..., Listener]:
    return Listener
