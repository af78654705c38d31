import gc
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
from splatpilot.systems.messaging.lcm_ports import (
    MeasurementPublisher,
    MessagePublisher,
    open_lcm,
    recorded,
    replay,
)

EPOCH = 1_800_000_000.25  # [s], also of the listener.
CHANNEL = CommandCodec.channel
TOOLS = Path(lcm.LCM_BIN_DIR)  # The programs themselves: scripts would not pass a signal on.


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
def test_unusable_urls_are_refused(url, reason):
    with pytest.raises(OSError, match=reason):
        open_lcm(url)


def test_a_port_in_use_is_refused(udp_url):
    open_lcm(udp_url)
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
        return MessagePublisher(transport, codec, 0.02, tick)

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


def test_a_decision_is_sent_at_its_instant():
    assert [m.thrust for m in periodic(Counter(), 0.05)] == [1.0, 2.0, 3.0]


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
    heard = published(lambda *made: MeasurementPublisher(*made, 0.01), 0.5, 0.001, **sources)
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


def test_before_the_first_message(listener):
    listener = listener(CommandCodec())
    listener.advance_to(0.5)
    assert np.isnan(listener.value).all()
    assert listener.output("age")[0] == np.inf
    assert listener.counts == (0, 0)


def test_last_message_and_its_age(listener):
    listener = listener(CommandCodec())
    listener.advance_to(0.0, message(0, -0.015, thrust=8.0), message(1, -0.005))
    np.testing.assert_array_equal(listener.value, [9.0, 0.1, 0.2, 0.3])
    listener.advance_to(0.3)
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


@pytest.mark.parametrize("codec", [CommandCodec(), StateCodec(), DepthGridCodec(4, 3, 5.0, "tof")])
def test_damaged_messages_never_raise(listener, codec):
    generator = np.random.default_rng(7)
    listener = listener(codec)
    values = {13: [0.0] * 6 + [1.0] + [0.0] * 6}.get(codec.size, np.full(codec.size, 0.5))
    header = lcmt_header()
    header.frame_name = codec.frame
    for k in range(300):
        header.seq, header.utime = k, round((EPOCH + k * 0.01) * 1e6)
        data = bytearray(codec.pack(np.asarray(values), header, EPOCH).encode())
        for _ in range(generator.integers(1, 4)):
            data[generator.integers(len(data))] = generator.integers(256)
        if k % 3 == 0:
            data = data[: generator.integers(len(data))]
        listener.advance_to(k * 0.01, bytes(data))
        if np.isfinite(listener.output("age")[0]):
            assert np.isfinite(listener.value).all()
    assert listener.counts[1] >= 100


def test_received_messages_are_in_the_context(listener):
    listener = listener(CommandCodec())
    listener.advance_to(0.0, message(0, 0.0, thrust=8.0))
    before = listener.root.Clone()
    listener.advance_to(0.01, message(1, 0.01, thrust=9.0))
    assert (listener.output("command", before)[0], listener.value[0]) == (8.0, 9.0)


def test_subscribers_are_freed(listener):
    listener = listener(CommandCodec())
    transport, freed = listener.lcm, weakref.ref(listener.subscriber)
    del listener
    gc.collect()
    assert freed() is None
    transport.publish(CHANNEL, message(0, 0.0))
    assert not transport.handle_timeout(0)


def now_messages(count: int) -> list[bytes]:
    """Messages that are sent 0.02 s apart from now on; the fourth is missing."""
    now = time.time()
    return [message(k, 0.02 * k, thrust=k, epoch=now) for k in range(count) if k != 3]


def events(path: Path) -> list[tuple[str, bytes]]:
    return [(event.channel, event.data) for event in lcm.EventLog(path)]


def test_log_of_lcm_logger_replays(listener, udp_url, tmp_path):
    path, messages, probes = tmp_path / "flight.lcm", now_messages(6), 0
    out = open_lcm(udp_url)
    words = [TOOLS / "lcm-logger", "--quiet", "--flush-interval=10", f"--lcm-url={udp_url}", path]
    with subprocess.Popen(words) as logger:
        try:
            while not (path.exists() and path.stat().st_size):  # Until it has joined the group.
                assert logger.poll() is None and probes < 500
                probes += 1
                out.publish("PROBE", b"")
                time.sleep(0.02)
            for data in messages:
                out.publish(CHANNEL, data)
                time.sleep(0.02)
        finally:
            logger.terminate()
    assert [e for e in events(path) if e[0] == CHANNEL] == [(CHANNEL, data) for data in messages]
    ages = []
    for _ in range(2):
        ours = listener(CommandCodec())
        replay(path, ours.lcm, ours.simulator, ours.clock)
        ours.advance_to(ours.root.get_time() + 0.01)
        assert (ours.value[0], ours.counts) == (5.0, (1, 0))
        ages.append(ours.output("age")[0])
    assert ages[0] == ages[1]


def test_lcms_own_programs_read_our_log(udp_url, tmp_path):
    path, messages, heard = tmp_path / "flight.lcm", now_messages(4), []
    transport = open_lcm(udp_url)
    with recorded(transport, path):
        for data in messages:
            transport.publish(CHANNEL, data)
            assert transport.handle_timeout(2000)
    assert events(path) == [(CHANNEL, data) for data in messages]
    assert abs(next(lcm.EventLog(path)).timestamp * 1e-6 - time.time()) < 60.0
    transport.subscribe(CHANNEL, lambda _, data: heard.append(data))
    player = [TOOLS / "lcm-logplayer", f"--lcm-url={udp_url}", path]
    subprocess.run(player, check=True, capture_output=True)
    while transport.handle_timeout(200):
        pass
    assert heard == messages


def test_a_full_disk_only_ends_the_log(caplog):
    transport, heard = lcm.LCM("memq://"), []
    transport.subscribe(CHANNEL, lambda _, data: heard.append(data))
    with recorded(transport, Path("/dev/full"), overwrite=True):
        for _ in range(100):
            transport.publish(CHANNEL, bytes(1000))
            while transport.handle_timeout(0):
                pass
    assert len(heard) == 100
    [record] = caplog.records
    assert "/dev/full cannot be written, the log ends here: No space left" in record.message


def test_invalid_logs_are_errors(listener, tmp_path):
    (tmp_path / "junk").write_bytes(b"this is no log of LCM" * 10)
    ours = listener(CommandCodec())
    with pytest.raises(FileNotFoundError, match=r"No such file: .*nowhere"):
        replay(tmp_path / "nowhere", ours.lcm, ours.simulator, ours.clock)
    with pytest.raises(ValueError, match="junk must be a log of LCM with messages"):
        replay(tmp_path / "junk", ours.lcm, ours.simulator, ours.clock)
    for path, error in (("junk", FileExistsError), ("no folder/log", OSError)):
        with pytest.raises(error), recorded(ours.lcm, tmp_path / path):
            pass
