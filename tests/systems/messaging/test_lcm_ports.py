"""LCM messages as ports."""

import gc
import logging
import os
import resource
import socket
import subprocess
import time
import weakref
from pathlib import Path

import lcm
import numpy as np
import pytest
from drake import lcmt_header
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.systems.messaging.bridge_status import UnixClock
from splatpilot.systems.messaging.codecs import CommandCodec, DepthGridCodec, StateCodec
from splatpilot.systems.messaging.generated import lcmt_body_rate_command
from splatpilot.systems.messaging.lcm_ports import (
    MeasurementPublisher,
    MessagePublisher,
    MessageSubscriber,
    open_lcm,
    recorded,
    replay,
)


def test_opens(udp_url):
    for url in (udp_url, "memq://"):
        open_lcm(url)


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("nonsense://", "must begin with udpm:// or memq://"),
        ("", "must begin with"),
        ("file:///tmp/flight.lcm", "must begin with"),
        ("udpm://1.2.3.4:7667", "use a multicast group"),
        ("udpm://not.an.address:7667", "use a multicast group"),
    ],
)
def test_urls_of_no_use_are_refused(url, reason):
    with pytest.raises(OSError, match=reason):
        open_lcm(url)


def test_port_in_use_is_refused(udp_url):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", 0))
        url = f"udpm://239.255.76.67:{other.getsockname()[1]}?ttl=0"
        with pytest.raises(OSError, match="does not deliver its own messages; use a multicast"):
            open_lcm(url)


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
            open_lcm("memq://")
    finally:
        for file in files:
            os.close(file)
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


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
    builder.Connect(clock.get_output_port(), publisher.GetInputPort("unix_time"))
    if tick is not None:
        builder.Connect(source.GetOutputPort("decided"), publisher.GetInputPort("decided"))
    if enabled is not None:
        switch = builder.AddSystem(ConstantVectorSource(np.array([enabled])))
        builder.Connect(switch.get_output_port(), publisher.GetInputPort("enabled"))
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    clock.set_epoch(clock.GetMyMutableContextFromRoot(root), EPOCH)
    simulator.AdvanceTo(until)
    while transport.handle_timeout(0):
        pass
    return [lcmt_body_rate_command.decode(data) for data in heard]


def test_messages_are_numbered_and_stamped():
    messages = published(ConstantVectorSource(np.array([9.0, 1.0, 2.0, 3.0])), 25.0)
    assert len(messages) == 1250
    assert [m.header.seq for m in messages] == list(range(1250))
    first = round(EPOCH * 1e6)
    for k, message in enumerate(messages):
        assert abs(message.header.utime - first - 20_000 * k - 1) <= 1
        assert message.header.frame_name == "body"
    assert (messages[-1].thrust, messages[-1].w_cmd_B) == (9.0, (1.0, 2.0, 3.0))


def test_what_was_decided_at_an_instant_is_sent_at_it():
    assert [m.thrust for m in published(Counter(), 0.05)] == [1.0, 2.0, 3.0]


def test_nothing_is_sent_while_disabled():
    source = np.array([9.0, 0.0, 0.0, 0.0])
    assert published(ConstantVectorSource(source), 0.1, enabled=0.0) == []
    assert len(published(ConstantVectorSource(source), 0.1, enabled=1.0)) == 5


def test_what_is_decided_between_is_sent_at_once():
    counter = Counter(0.03)
    messages = published(counter, 0.1, tick=0.002)
    at = [round(1e3 * (m.header.utime * 1e-6 - EPOCH)) for m in messages]
    assert at == [0, 20, 30, 40, 60, 80, 90]
    assert [m.header.seq for m in messages] == [0, 1, 1, 2, 3, 4, 4]
    assert [m.thrust for m in messages] == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0]


@pytest.mark.parametrize("period", [0.0, -1.0, np.inf, np.nan])
def test_period_must_be_positive(period):
    with pytest.raises(ValueError, match="the period of BODY_RATE_COMMAND must be"):
        MessagePublisher(lcm.LCM("memq://"), CommandCodec(), period)
    with pytest.raises(ValueError, match="the tick of BODY_RATE_COMMAND must be"):
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
    builder.Connect(sensor.GetOutputPort("age"), publisher.GetInputPort("age"))
    builder.Connect(clock.get_output_port(), publisher.GetInputPort("unix_time"))
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


EPOCH = 1_800_000_000.25  # [s], that of the listener.


def command(
    seq: int, time: float, thrust: float = 9.0, frame: str = "body", session: int = 0
) -> bytes:
    """A message that was sent at the listener's `time` [s]."""
    header = lcmt_header()
    header.seq, header.utime, header.frame_name = seq, round((EPOCH + time) * 1e6), frame
    message = CommandCodec().pack(np.array([thrust, 0.1, 0.2, 0.3]), header, EPOCH)
    message.session = session
    return message.encode()


def counts(listener) -> tuple[float, float]:
    return listener.number("gaps"), listener.number("rejected")


def test_before_the_first_message(listener):
    listener = listener(CommandCodec())
    listener.advance_to(0.5)
    assert np.isnan(listener.value).all()
    assert listener.number("age") == np.inf
    assert counts(listener) == (0, 0)


def test_last_message_and_its_age(listener):
    listener = listener(CommandCodec())
    listener.lcm.publish("BODY_RATE_COMMAND", command(0, -0.015, thrust=8.0))
    listener.lcm.publish("BODY_RATE_COMMAND", command(1, -0.005, thrust=9.0))
    listener.advance_to(0.0)
    np.testing.assert_array_equal(listener.value, [9.0, 0.1, 0.2, 0.3])
    listener.advance_to(0.3)
    assert listener.number("age") == pytest.approx(0.305001, abs=1e-6)
    assert counts(listener) == (0, 0)


def test_gaps_are_counted(listener):
    listener = listener(CommandCodec())
    for k, seq in enumerate([7, 8, 11, 12, 14]):
        listener.lcm.publish("BODY_RATE_COMMAND", command(seq, 0.01 * k))
        listener.advance_to(0.01 * k)
    listener.advance_to(1.09)
    for k, seq in enumerate([0, 1, 3]):
        listener.lcm.publish("BODY_RATE_COMMAND", command(seq, 1.1 + 0.01 * k, session=1))
        listener.advance_to(1.1 + 0.01 * k)
    assert counts(listener) == (2 + 1 + 1, 0)


@pytest.mark.parametrize(("session", "first"), [(1, 0), (1, 500), (0, -500)])
def test_of_two_senders_the_first_is_heard_and_the_other_counted(listener, caplog, session, first):
    listener = listener(CommandCodec())
    for k in range(20):
        listener.lcm.publish("BODY_RATE_COMMAND", command(k, 0.02 * k, thrust=8.0))
        other = command(first + k, 0.02 * k + 0.01, thrust=9.0, session=session)
        listener.lcm.publish("BODY_RATE_COMMAND", other)
        listener.advance_to(0.02 * k + 0.01)
        assert listener.value[0] == 8.0
    assert counts(listener) == (0, 20)
    assert "two senders on this channel" in caplog.text
    listener.advance_to(1.49)
    listener.lcm.publish("BODY_RATE_COMMAND", command(600, 1.5, thrust=9.0, session=session))
    listener.advance_to(1.5)
    assert listener.value[0] == 9.0


def test_a_burst_loses_nothing(listener):
    listener = listener(CommandCodec())
    for seq in range(20):
        listener.lcm.publish("BODY_RATE_COMMAND", command(seq, 0.001 * seq, thrust=seq))
    listener.advance_to(0.02)
    assert listener.value[0] == 19
    assert counts(listener) == (0, 0)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "Decode error"),
        (b"not a message of any type", "Decode error"),
        (DepthGridCodec(1, 1, 5.0, "tof").message().encode(), "Decode error"),
        (command(1, 0.01)[:-1], "unpack requires"),
        (command(1, 0.01) + b"\0", "surplus bytes of the message must be 0, got 1"),
        (command(1, 0.01, thrust=np.nan), "must be finite"),
        (command(1, 0.01, frame="ned"), "the frame must be 'body', got 'ned'"),
        (command(1, 0.0), "newer than the one before"),
        (command(1, -0.1), "newer than the one before"),
        (command(1, 0.4), "must be at most 0.2 s ahead"),
    ],
)
def test_messages_of_no_use_are_counted_and_logged(listener, data, reason, caplog):
    listener = listener(CommandCodec())
    listener.lcm.publish("BODY_RATE_COMMAND", command(0, 0.0, thrust=8.0))
    listener.advance_to(0.0)
    with caplog.at_level(logging.WARNING):
        listener.lcm.publish("BODY_RATE_COMMAND", data)
        listener.advance_to(0.01)
    assert reason in caplog.text
    assert listener.value[0] == 8.0
    assert counts(listener) == (0, 1)
    listener.lcm.publish("BODY_RATE_COMMAND", command(1, 0.02, thrust=9.0))
    listener.advance_to(0.02)
    assert listener.value[0] == 9.0
    assert counts(listener) == (0, 1)


@pytest.mark.parametrize("codec", [CommandCodec(), StateCodec(), DepthGridCodec(4, 3, 5.0, "tof")])
def test_damaged_messages_never_raise(listener, codec):
    generator = np.random.default_rng(7)
    listener = listener(codec)
    values = {13: [0.0] * 6 + [1.0] + [0.0] * 6}.get(codec.size, np.full(codec.size, 0.5))
    for k in range(300):
        header = lcmt_header()
        header.seq, header.utime, header.frame_name = (
            k,
            round((EPOCH + k * 0.01) * 1e6),
            codec.frame,
        )
        data = bytearray(codec.pack(np.asarray(values), header, EPOCH).encode())
        for _ in range(generator.integers(1, 4)):
            data[generator.integers(len(data))] = generator.integers(256)
        if k % 3 == 0:
            data = data[: generator.integers(len(data))]
        listener.lcm.publish(codec.channel, bytes(data))
        listener.advance_to(k * 0.01)
        if np.isfinite(listener.number("age")):
            assert np.isfinite(listener.value).all()
    assert listener.number("rejected") >= 100


def test_log_does_not_flood(listener, caplog):
    listener = listener(CommandCodec())
    with caplog.at_level(logging.WARNING):
        for k in range(1000):
            listener.lcm.publish("BODY_RATE_COMMAND", b"x")
            listener.advance_to(k * 0.01)
    assert len(caplog.records) == 10


def test_what_came_is_in_the_context(listener):
    listener = listener(CommandCodec())
    listener.lcm.publish("BODY_RATE_COMMAND", command(0, 0.0, thrust=8.0))
    listener.advance_to(0.0)
    before = listener.root.Clone()
    listener.lcm.publish("BODY_RATE_COMMAND", command(1, 0.01, thrust=9.0))
    listener.advance_to(0.01)
    subscriber = listener.subscriber
    old = subscriber.GetOutputPort("command").Eval(subscriber.GetMyContextFromRoot(before))
    assert (old[0], listener.value[0]) == (8.0, 9.0)


def test_subscribers_are_freed(listener):
    listener = listener(CommandCodec())
    lcm, freed = listener.lcm, weakref.ref(listener.subscriber)
    del listener
    gc.collect()
    assert freed() is None
    lcm.publish("BODY_RATE_COMMAND", command(0, 0.0))
    assert not lcm.handle_timeout(0)


@pytest.mark.parametrize("period", [0.0, -1.0, np.inf, np.nan])
def test_subscribers_period_must_be_positive(listener, period):
    with pytest.raises(ValueError, match="period of BODY_RATE_COMMAND must be"):
        MessageSubscriber(None, CommandCodec(), period)


TOOLS = Path(lcm.LCM_BIN_DIR)  # The programs themselves: scripts would not pass a signal on.

CHANNEL = CommandCodec.channel


def commands(count: int) -> list[bytes]:
    """Messages that are sent 0.02 s apart from now on, of which the fourth is missing."""
    now, messages, codec = time.time(), [], CommandCodec()
    for k in range(count):
        header = lcmt_header()
        header.seq, header.utime, header.frame_name = k, round((now + 0.02 * k) * 1e6), "body"
        messages.append(codec.pack(np.array([k, 0.1, 0.2, 0.3]), header, 0.0).encode())
    return messages[:3] + messages[4:]


def listens(transport: lcm.LCM, logger: subprocess.Popen) -> None:
    """Waits until a program that was just started has joined the group of multicast."""
    time.sleep(0.5)
    assert logger.poll() is None


def events(path: Path) -> list[tuple[str, bytes]]:
    return [(event.channel, event.data) for event in lcm.EventLog(path)]


def test_log_of_lcm_logger_replays(listener, udp_url, tmp_path):
    path, messages = tmp_path / "flight.lcm", commands(6)
    out = open_lcm(udp_url)
    words = [TOOLS / "lcm-logger", "--quiet", "--flush-interval=10", f"--lcm-url={udp_url}", path]
    with subprocess.Popen(words) as logger:
        try:
            listens(out, logger)
            for data in messages:
                out.publish(CHANNEL, data)
                time.sleep(0.02)
        finally:
            logger.terminate()
    assert [e for e in events(path) if e[0] == CHANNEL] == [(CHANNEL, data) for data in messages]
    ages = []
    for _ in range(2):
        ours = listener(CommandCodec())
        clock = next(s for s in ours.simulator.get_system().GetSystems() if type(s) is UnixClock)
        replay(path, ours.lcm, ours.simulator, clock)
        ours.advance_to(ours.root.get_time() + 0.01)
        assert ours.value[0] == 5.0
        assert ours.number("gaps") == 1
        assert ours.number("rejected") == 0
        ages.append(ours.number("age"))
    assert ages[0] == ages[1]


def test_lcms_own_programs_read_our_log(listener, udp_url, tmp_path):
    path, messages = tmp_path / "flight.lcm", commands(4)
    transport = open_lcm(udp_url)
    with recorded(transport, path):
        for data in messages:
            transport.publish(CHANNEL, data)
            assert transport.handle_timeout(2000)
    assert events(path) == [(CHANNEL, data) for data in messages]
    assert abs(next(lcm.EventLog(path)).timestamp * 1e-6 - time.time()) < 60.0

    heard = []
    transport.subscribe(CHANNEL, lambda _, data: heard.append(data))
    subprocess.run(
        [TOOLS / "lcm-logplayer", f"--lcm-url={udp_url}", path], check=True, capture_output=True
    )
    while transport.handle_timeout(200):
        pass
    assert heard == messages


def test_a_full_disk_ends_the_log_with_one_warning_and_nothing_else(caplog):
    transport, heard = lcm.LCM("memq://"), []
    transport.subscribe(CHANNEL, lambda _, data: heard.append(data))
    with recorded(transport, Path("/dev/full"), overwrite=True):
        for _ in range(100):
            transport.publish(CHANNEL, bytes(1000))
            while transport.handle_timeout(0):
                pass
    assert len(heard) == 100
    assert [record.message for record in caplog.records] == [
        "/dev/full cannot be written, the log ends here: No space left on device"
    ]


def test_bad_logs_are_errors(listener, tmp_path):
    (tmp_path / "junk").write_bytes(b"this is no log of LCM" * 10)
    ours = listener(CommandCodec())
    with pytest.raises(FileNotFoundError, match=r"No such file: .*nowhere"):
        replay(tmp_path / "nowhere", ours.lcm, ours.simulator, UnixClock())
    with pytest.raises(ValueError, match="junk must be a log of LCM with messages"):
        replay(tmp_path / "junk", ours.lcm, ours.simulator, UnixClock())
    with (
        pytest.raises(FileExistsError, match="junk is there already"),
        recorded(ours.lcm, tmp_path / "junk"),
    ):
        pass
    with (
        pytest.raises(OSError, match="No such file or directory"),
        recorded(ours.lcm, tmp_path / "no folder" / "log"),
    ):
        pass
