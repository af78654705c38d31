"""What goes out by LCM."""

import lcm
import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.systems.messaging.bridge_status import UnixClock
from splatpilot.systems.messaging.codecs import CommandCodec
from splatpilot.systems.messaging.generated import lcmt_body_rate_command
from splatpilot.systems.messaging.lcm_ports import MeasurementPublisher, MessagePublisher

EPOCH = 1_800_000_000.25  # [s]


class Counter(LeafSystem):
    """Its output is the number of its updates, and its output `decided` the time of the last."""

    def __init__(self, period: float = 0.02):
        super().__init__()
        self.DeclareStateOutputPort("command", self.DeclareDiscreteState(4))
        self.DeclareStateOutputPort("decided", self.DeclareDiscreteState(1))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context, discrete_state):
        discrete_state.set_value(0, context.get_discrete_state(0).value() + 1)
        discrete_state.set_value(1, [context.get_time()])


def published(
    source: LeafSystem, until: float, enabled: float | None = None, tick: float | None = None
) -> list:
    """The messages that a publisher with a period of 0.02 s sends of a source of commands."""
    transport = lcm.LCM("memq://")
    heard = []
    transport.subscribe("BODY_RATE_COMMAND", lambda _, data: heard.append(data))
    builder = DiagramBuilder()
    clock = builder.AddSystem(UnixClock())
    builder.AddSystem(source)
    publisher = builder.AddSystem(MessagePublisher(transport, CommandCodec(), 0.02, tick))
    builder.Connect(source.get_output_port(0), publisher.GetInputPort("command"))
    builder.Connect(clock.get_output_port(), publisher.unix_time_input_port())
    if tick is not None:
        builder.Connect(source.GetOutputPort("decided"), publisher.decided_input_port())
    if enabled is not None:
        switch = builder.AddSystem(ConstantVectorSource(np.array([enabled])))
        builder.Connect(switch.get_output_port(), publisher.enabled_input_port())
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    clock.set_epoch(clock.GetMyMutableContextFromRoot(root), EPOCH)
    simulator.AdvanceTo(until)
    while transport.handle_timeout(0):
        pass
    return [lcmt_body_rate_command.decode(data) for data in heard]


def test_messages_are_numbered_and_stamped():
    """Numbers go up by one, times by the period, to the microsecond."""
    messages = published(ConstantVectorSource(np.array([9.0, 1.0, 2.0, 3.0])), 25.0)
    assert len(messages) == 1250
    assert [m.header.seq for m in messages] == list(range(1250))
    first = round(EPOCH * 1e6)
    for k, message in enumerate(messages):
        assert abs(message.header.utime - first - 20_000 * k - 1) <= 1
        assert message.header.frame_name == "body"
    assert (messages[-1].thrust, messages[-1].w_cmd_B) == (9.0, (1.0, 2.0, 3.0))


def test_what_was_decided_at_an_instant_is_sent_at_it():
    """The result of an update goes out with the message of the same instant, not with the next."""
    assert [m.thrust for m in published(Counter(), 0.05)] == [1.0, 2.0, 3.0]


def test_nothing_is_sent_while_disabled():
    """A publisher whose input `enabled` is 0 is silent, and speaks where it is 1."""
    source = np.array([9.0, 0.0, 0.0, 0.0])
    assert published(ConstantVectorSource(source), 0.1, enabled=0.0) == []
    assert len(published(ConstantVectorSource(source), 0.1, enabled=1.0)) == 5


def test_what_is_decided_between_is_sent_at_once():
    """Between two of its times a publisher sends what is decided there, with the number of the
    message before; what is decided at one of them is sent once."""
    counter = Counter(0.03)
    messages = published(counter, 0.1, tick=0.002)
    at = [round(1e3 * (m.header.utime * 1e-6 - EPOCH)) for m in messages]
    assert at == [0, 20, 30, 40, 60, 80, 90]
    assert [m.header.seq for m in messages] == [0, 1, 1, 2, 3, 4, 4]
    assert [m.thrust for m in messages] == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0]


@pytest.mark.parametrize("period", [0.0, -1.0, np.inf, np.nan])
def test_period_must_be_positive(period):
    """A period or a tick that is none is an error that names the channel."""
    with pytest.raises(ValueError, match=r"BODY_RATE_COMMAND are .* apart"):
        MessagePublisher(lcm.LCM("memq://"), CommandCodec(), period)
    with pytest.raises(ValueError, match=r"BODY_RATE_COMMAND are .* late at most"):
        MessagePublisher(lcm.LCM("memq://"), CommandCodec(), 0.02, tick=period)


class Sensor(LeafSystem):
    """Measures at times, of which it knows each `latency` later."""

    def __init__(self, times: list[float], latency: float):
        super().__init__()
        self.times, self.latency = np.array(times), latency
        self.DeclareVectorOutputPort("command", 4, self._calc)
        self.DeclareVectorOutputPort("age", 1, self._calc_age)

    def _last(self, context) -> float:
        known = self.times[self.times + self.latency <= context.get_time()]
        return known[-1] if len(known) else -np.inf

    def _calc(self, context, output):
        output.SetFromVector([self._last(context), 0.0, 0.0, 0.0])

    def _calc_age(self, context, output):
        output[0] = context.get_time() - self._last(context)


def test_measurements_are_sent_once_as_they_come_with_their_own_time():
    transport = lcm.LCM("memq://")
    heard = []
    transport.subscribe("BODY_RATE_COMMAND", lambda _, data: heard.append((data, root.get_time())))
    builder = DiagramBuilder()
    clock = builder.AddSystem(UnixClock())
    sensor = builder.AddSystem(Sensor([0.1, 0.103, 0.2, 0.3], latency=0.048))
    publisher = builder.AddSystem(MeasurementPublisher(transport, CommandCodec(), 0.01))
    builder.Connect(sensor.GetOutputPort("command"), publisher.GetInputPort("command"))
    builder.Connect(sensor.GetOutputPort("age"), publisher.age_input_port())
    builder.Connect(clock.get_output_port(), publisher.unix_time_input_port())
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    clock.set_epoch(clock.GetMyMutableContextFromRoot(root), EPOCH)
    for k in range(1000):
        simulator.AdvanceTo(0.001 * k)
        while transport.handle_timeout(0):
            pass
    messages = [lcmt_body_rate_command.decode(data) for data, _ in heard]
    times = [m.header.utime * 1e-6 - EPOCH for m in messages]
    np.testing.assert_allclose(times, [0.1, 0.103, 0.2, 0.3], atol=2e-6)
    assert [m.thrust for m in messages] == [0.1, 0.103, 0.2, 0.3]
    assert [m.header.seq for m in messages] == [0, 1, 2, 3]
    np.testing.assert_allclose([when for _, when in heard], [0.15, 0.16, 0.25, 0.35], atol=0.0011)
