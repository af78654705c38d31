import os
import resource
import socket
import time
from pathlib import Path

import lcm
import numpy as np
import pytest
from drake import lcmt_header
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.systems.messaging import lcm_ports
from splatpilot.systems.messaging.codecs import CommandCodec, DepthGridCodec
from splatpilot.systems.messaging.lcm_ports import BridgeStatus, UnixClock

EPOCH = 1_800_000_000.25  # [s], also of the listener.
CHANNEL = CommandCodec.channel


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("nonsense://", "must begin with udpm:// or memq://"),
        ("file:///tmp/flight.lcm", "must begin with"),
        ("udpm://1.2.3.4:7667", "use a multicast group"),
    ],
)
def test_unusable_urls_are_refused(url, reason):
    with pytest.raises(OSError, match=reason):
        lcm_ports.open_lcm(url)


def test_a_port_in_use_is_refused(udp_url):
    lcm_ports.open_lcm(udp_url)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", 0))
        url = f"udpm://239.255.76.67:{other.getsockname()[1]}?ttl=0"
        with pytest.raises(OSError, match="does not deliver its own messages; use a multicast"):
            lcm_ports.open_lcm(url)


def test_too_many_open_files_are_an_error_and_no_crash():
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limits[1] != resource.RLIM_INFINITY and limits[1] < 1100:
        pytest.skip(f"this process may open {limits[1]} files only")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(limits[0], 1100), limits[1]))
    files = []
    try:
        while not files or files[-1] < 1000:
            files.append(os.open(os.devnull, os.O_RDONLY))
        with pytest.raises(OSError, match="at most 1000 files may be open"):
            lcm_ports.open_lcm("memq://")
    finally:
        for file in files:
            os.close(file)
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def decode(data: bytes):
    return CommandCodec.message.decode(data)


def published(publisher, until: float, step: float, **sources) -> list:
    """Messages that a publisher of commands sends through an LCM of `memq://`, and their times."""
    builder = DiagramBuilder()
    clock = builder.AddSystem(UnixClock())
    transport, heard = lcm.LCM("memq://"), []
    system = builder.AddSystem(publisher(transport, CommandCodec()))
    builder.Connect(clock.get_output_port(), system.GetInputPort("unix_time"))
    for source in dict.fromkeys(port[0] for port in sources.values()):
        builder.AddSystem(source)
    for name, (source, port) in sources.items():
        builder.Connect(source.GetOutputPort(port), system.GetInputPort(name))
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    clock.set_epoch(root, EPOCH)
    transport.subscribe(CHANNEL, lambda _, data: heard.append((decode(data), root.get_time())))
    for k in range(round(until / step) + 1):
        simulator.AdvanceTo(k * step)
        while transport.handle_timeout(0):
            pass
    return heard


def periodic(source, until: float, tick: float | None = None, **sources) -> list:
    def make(transport, codec):
        return lcm_ports.MessagePublisher(transport, codec, 0.02, tick)

    name = "y0" if isinstance(source, ConstantVectorSource) else "command"
    heard = published(make, until, until, command=(source, name), **sources)
    return [message for message, _ in heard]


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


def constant(*values: float) -> ConstantVectorSource:
    return ConstantVectorSource(np.array(values))


def test_messages_are_numbered_and_stamped():
    messages = periodic(constant(9.0, 1.0, 2.0, 3.0), 5.0)
    assert [m.header.seq for m in messages] == list(range(250))
    for k, message in enumerate(messages):
        assert abs(message.header.utime - round(EPOCH * 1e6) - 20_000 * k - 1) <= 1
        assert message.header.frame_name == "body"
    assert (messages[-1].thrust, messages[-1].w_cmd_B) == (9.0, (1.0, 2.0, 3.0))


@pytest.mark.parametrize(("enabled", "count"), [(0.0, 0), (1.0, 5)])
def test_nothing_is_sent_while_disabled(enabled, count):
    source, switch = constant(9.0, 0.0, 0.0, 0.0), constant(enabled)
    assert len(periodic(source, 0.1, enabled=(switch, "y0"))) == count


def test_a_decision_between_two_periods_is_sent_at_once():
    counter = Counter(0.03)
    messages = periodic(counter, 0.1, 0.002, decided=(counter, "decided"))
    at = [round(1e3 * (m.header.utime * 1e-6 - EPOCH)) for m in messages]
    assert at == [0, 20, 30, 40, 60, 80, 90]
    assert [m.header.seq for m in messages] == [0, 1, 1, 2, 3, 4, 4]
    assert [m.thrust for m in messages] == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0]


class Sensor(LeafSystem):
    """Measures its times, and outputs each `latency` later."""

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
    sensor = Sensor([0.1, 0.103, 0.2, 0.3], latency=0.048)
    sources = {"command": (sensor, "command"), "age": (sensor, "age")}
    heard = published(
        lambda *made: lcm_ports.MeasurementPublisher(*made, 0.01), 0.5, 0.001, **sources
    )
    times = [m.header.utime * 1e-6 - EPOCH for m, _ in heard]
    np.testing.assert_allclose(times, [0.1, 0.103, 0.2, 0.3], atol=2e-6)
    assert [m.thrust for m, _ in heard] == [0.1, 0.103, 0.2, 0.3]
    assert [m.header.seq for m, _ in heard] == [0, 1, 2, 3]
    np.testing.assert_allclose([when for _, when in heard], [0.15, 0.16, 0.25, 0.35], atol=0.0011)


def message(
    seq: int,
    time: float,
    thrust: float = 9.0,
    frame: str = "body",
    session: int = 0,
    epoch: float = EPOCH,
) -> bytes:
    """A command that was sent at the listener's `time` [s]."""
    header = lcmt_header()
    header.seq, header.utime, header.frame_name = seq, round((epoch + time) * 1e6), frame
    command = CommandCodec().pack(np.array([thrust, 0.1, 0.2, 0.3]), header, epoch)
    command.session = session
    return command.encode()


def test_last_message_and_its_age(listener):
    listener = listener(CommandCodec())
    listener.advance_to(0.5)
    assert np.isnan(listener.value).all()
    assert listener.output("age")[0] == np.inf
    listener.advance_to(0.6, message(0, 0.485, thrust=8.0), message(1, 0.595))
    np.testing.assert_array_equal(listener.value, [9.0, 0.1, 0.2, 0.3])
    listener.advance_to(0.9)
    assert listener.output("age")[0] == pytest.approx(0.305001, abs=1e-6)
    assert listener.counts == (0, 0)


def test_gaps_are_counted_but_not_after_a_restart(listener):
    listener = listener(CommandCodec())
    for k, seq in enumerate([7, 8, 11, 12, 14]):
        listener.advance_to(0.01 * k, message(seq, 0.01 * k))
    listener.advance_to(1.09)
    for k, seq in enumerate([0, 1, 3]):
        listener.advance_to(1.1 + 0.01 * k, message(seq, 1.1 + 0.01 * k, session=1))
    assert listener.counts == (2 + 1 + 1, 0)


@pytest.mark.parametrize(("session", "first"), [(1, 0), (1, 500), (0, -500)])
def test_of_two_senders_the_first_is_heard_and_the_other_counted(listener, caplog, session, first):
    listener = listener(CommandCodec())
    for k in range(20):
        other = message(first + k, 0.02 * k + 0.01, thrust=9.0, session=session)
        listener.advance_to(0.02 * k + 0.01, message(k, 0.02 * k, thrust=8.0), other)
        assert listener.value[0] == 8.0
    assert listener.counts == (0, 20)
    assert "two senders on this channel" in caplog.text
    listener.advance_to(1.49)
    listener.advance_to(1.5, message(600, 1.5, thrust=9.0, session=session))
    assert listener.value[0] == 9.0


def test_a_burst_loses_nothing(listener):
    listener = listener(CommandCodec())
    listener.advance_to(0.1, *(message(k, 1e-4 * k, thrust=k) for k in range(900)))
    assert listener.value[0] == 899
    assert listener.counts == (0, 0)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "Decode error"),
        (b"not a message of any type", "Decode error"),
        (DepthGridCodec(1, 1, 5.0, "tof").message().encode(), "Decode error"),
        (message(1, 0.01)[:-1], "unpack requires"),
        (message(1, 0.01) + b"\0", "surplus bytes of the message must be 0, got 1"),
        (message(1, 0.01, thrust=np.nan), "must be finite"),
        (message(1, 0.01, frame="ned"), "the frame must be 'body', got 'ned'"),
        (message(1, 0.0), "newer than the one before"),
        (message(1, -0.1), "newer than the one before"),
        (message(1, 0.4), "must be at most 0.2 s ahead"),
    ],
)
def test_invalid_messages_are_counted_and_logged(listener, data, reason, caplog):
    listener = listener(CommandCodec())
    listener.advance_to(0.0, message(0, 0.0, thrust=8.0))
    listener.advance_to(0.01, data)
    assert reason in caplog.text
    assert (listener.value[0], listener.counts) == (8.0, (0, 1))
    listener.advance_to(0.02, message(1, 0.02, thrust=9.0))
    assert (listener.value[0], listener.counts) == (9.0, (0, 1))


def send(transport: lcm.LCM, messages: list[bytes]) -> None:
    for data in messages:
        transport.publish(CHANNEL, data)
        assert transport.handle_timeout(2000)


def test_a_log_is_lcms_and_replays(listener, tmp_path):
    now, path, transport = time.time(), tmp_path / "flight.lcm", lcm.LCM("memq://")
    messages = [message(k, 0.02 * k, thrust=k, epoch=now) for k in (0, 1, 2, 4, 5)]
    with lcm_ports.recorded(transport, path):
        send(transport, messages)
    logged = list(lcm.EventLog(path))
    assert [(e.channel, e.data) for e in logged] == [(CHANNEL, data) for data in messages]
    assert abs(logged[0].timestamp * 1e-6 - now) < 60.0
    ages = []
    for _ in range(2):
        ours = listener(CommandCodec())
        lcm_ports.replay(path, ours.lcm, ours.simulator, ours.clock)
        ours.advance_to(ours.root.get_time() + 0.01)
        assert (ours.value[0], ours.counts) == (5.0, (1, 0))
        ages.append(ours.output("age")[0])
    assert ages[0] == ages[1]


def test_a_full_disk_only_ends_the_log(caplog):
    transport, heard = lcm.LCM("memq://"), []
    transport.subscribe(CHANNEL, lambda _, data: heard.append(data))
    with lcm_ports.recorded(transport, Path("/dev/full"), overwrite=True):
        send(transport, [bytes(1000)] * 100)
    assert len(heard) == 100
    [record] = caplog.records
    assert "/dev/full cannot be written, the log ends here: No space left" in record.message


def test_invalid_logs_are_errors(listener, tmp_path):
    (tmp_path / "junk").write_bytes(b"this is no log of LCM" * 10)
    ours = listener(CommandCodec())
    for name, error in (("nowhere", FileNotFoundError), ("junk", ValueError)):
        with pytest.raises(error, match=name):
            lcm_ports.replay(tmp_path / name, ours.lcm, ours.simulator, ours.clock)
    for name, error in (("junk", FileExistsError), ("no folder/log", OSError)):
        with pytest.raises(error), lcm_ports.recorded(ours.lcm, tmp_path / name):
            pass


@pytest.mark.parametrize(
    ("images", "overruns", "status"),
    [
        (["depth_image_32f", "color_image"], None, [2, 4, 0.01, 0.07, 6, 12, 0]),
        ([], 4.0, [2, 4, 0.01, 0, 2, 5, 4]),
    ],
)
def test_status_sums_up_the_inputs(images, overruns, status):
    system = BridgeStatus(images)
    context = system.CreateDefaultContext()
    values = {"age": (0.01, 0.05, 0.07), "gaps": (2.0, 3.0, 1.0), "rejected": (5.0, 7.0, 0.0)}
    for what, numbers in values.items():
        for name, value in zip(["state", *images], numbers, strict=False):
            system.GetInputPort(f"{name}_{what}").FixValue(context, [value])
    system.GetInputPort("mode").FixValue(context, [2.0, 4.0])
    if overruns is not None:
        system.GetInputPort("overruns").FixValue(context, [overruns])
    np.testing.assert_array_equal(system.GetOutputPort("status").Eval(context), status)
    assert system.GetOutputPort("observation_age").Eval(context)[0] == status[3]


def test_unix_time_is_the_epoch_and_the_contexts_time():
    clock = UnixClock()
    context = clock.CreateDefaultContext()
    clock.set_epoch(context, 1_800_000_000.125)
    context.SetTime(3600.000001)
    assert abs(clock.GetOutputPort("unix_time").Eval(context)[0] - 1_800_003_600.125001) < 5e-7
