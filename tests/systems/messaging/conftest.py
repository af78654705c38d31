import os
from collections.abc import Callable

import lcm
import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.systems.messaging.codecs import Codec
from splatpilot.systems.messaging.message_publisher import MessagePublisher
from splatpilot.systems.messaging.message_subscriber import MessageSubscriber
from splatpilot.systems.messaging.open_lcm import open_lcm
from splatpilot.systems.messaging.unix_clock import UnixClock

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


@pytest.fixture
def speaker() -> Callable[..., Simulator]:
    """Makes simulators of a diagram that publishes a constant vector."""

    def make(transport: lcm.LCM, codec: Codec, value, period: float = 0.02) -> Simulator:
        builder = DiagramBuilder()
        clock = builder.AddSystem(UnixClock())
        source = builder.AddSystem(ConstantVectorSource(np.asarray(value, dtype=float)))
        publisher = builder.AddSystem(MessagePublisher(transport, codec, period))
        builder.Connect(source.get_output_port(), publisher.get_input_port(0))
        builder.Connect(clock.get_output_port(), publisher.unix_time_input_port())
        simulator = Simulator(builder.Build())
        root = simulator.get_mutable_context()
        clock.set_epoch(clock.GetMyMutableContextFromRoot(root), EPOCH)
        return simulator

    return make


@pytest.fixture(scope="session")
def udp_url() -> str:
    """An LCM URL on a port of this process's own; skips where multicast does not come back."""
    url = f"udpm://239.255.76.67:{20000 + os.getpid() % 20000}?ttl=0&recv_buf_size=4000000"
    try:
        open_lcm(url)
    except OSError as error:
        pytest.skip(str(error))
    return url
