import contextlib
import os
import resource
import socket
import time
from pathlib import Path

import lcm
import numpy as np
import pytest
from drake import lcmt_header
from harness import Harness
from pydrake.systems.framework import DiagramBuilder

from splatpilot.systems.messaging import lcm_ports
from splatpilot.systems.messaging.codecs import CommandCodec, DepthGridCodec
from splatpilot.systems.messaging.lcm_ports import BridgeStatus, UnixClock

EPOCH = 1_800_000_000.25  # [s]
CHANNEL = CommandCodec.channel


def test_urls_that_do_not_deliver_are_refused(udp_url):
    lcm_ports.open_lcm(udp_url)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", 0))
        for url, reason in {
            "nonsense://": "must begin with udpm:// or memq://",
            "file:///tmp/flight.lcm": "must begin with",
            "udpm://1.2.3.4:7667": "use a multicast group",
            f"udpm://239.255.76.67:{other.getsockname()[1]}?ttl=0": "does not deliver its own",
        }.items():
            with pytest.raises(OSError, match=reason):
                lcm_ports.open_lcm(url)


def test_too_many_open_files_are_an_error_and_no_crash():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 1100:
        pytest.skip(f"this process may open {hard} files only")
    with contextlib.ExitStack() as stack:
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 1100), hard))
        while stack.enter_context(open(os.devnull)).fileno() < 1000:
            pass
        with pytest.raises(OSError, match="at most 1000 files may be open"):
            lcm_ports.open_lcm("memq://")


def published(publisher, until: float, inputs) -> list:
    """Messages, and their times, of a publisher of commands whose inputs depend on time [s]."""
    transport, heard = lcm.LCM("memq://"), []
    system, decode = Harness(publisher(transport, CommandCodec())), CommandCodec.message.decode
    transport.subscribe(CHANNEL, lambda _, data: heard.append((decode(data), system.now)))
    for now in 0.001 * np.arange(round(1000 * until) + 1):
        system.give(unix_time=EPOCH + now, **inputs(now))
        system.simulator.AdvanceTo(now + 2.0 * lcm_ports.PUBLISH_OFFSET)
        while transport.handle_timeout(0):
            pass
    return heard


def periodic(*arguments):
    return lambda transport, codec: lcm_ports.MessagePublisher(transport, codec, *arguments)


def test_messages_are_numbered_and_stamped_while_enabled():
    command = [9.0, 1.0, 2.0, 3.0]
    assert published(periodic(0.02), 0.1, lambda _: {"command": command, "enabled": 0.0}) == []
    heard = published(periodic(0.02), 0.9, lambda _: {"command": command, "enabled": 1.0})
    assert [m.header.seq for m, _ in heard] == list(range(46))
    for k, (message, _) in enumerate(heard):
        assert abs(message.header.utime - round(EPOCH * 1e6) - 20_000 * k) <= 1
        assert message.header.frame_name == "body"
        assert (message.thrust, message.w_cmd_B) == (9.0, (1.0, 2.0, 3.0))


def test_a_decision_between_two_periods_is_sent_at_once():
    def inputs(now: float) -> dict:
        count = np.floor(now / 0.03 + 1e-6)
        return {"command": np.full(4, count + 1.0), "decided": 0.03 * count}

    messages = [message for message, _ in published(periodic(0.02, 0.002), 0.1, inputs)]
    at = [round(1e3 * (m.header.utime * 1e-6 - EPOCH)) for m in messages]
    assert at == [0, 20, 30, 40, 60, 80, 90, 100]
    assert [m.header.seq for m in messages] == [0, 1, 1, 2, 3, 4, 4, 5]
    assert [m.thrust for m in messages] == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0, 4.0]


def test_measurements_are_sent_once_as_they_come_with_their_own_time():
    measured = np.array([0.1, 0.103, 0.2, 0.3])

    def inputs(now: float) -> dict:
        last = max(measured[measured + 0.048 <= now], default=-np.inf)
        return {"command": [last, 0.0, 0.0, 0.0], "age": now - last}

    heard = published(lambda *made: lcm_ports.MeasurementPublisher(*made, 0.01), 0.4, inputs)
    times = [m.header.utime * 1e-6 - EPOCH for m, _ in heard]
    np.testing.assert_allclose(times, measured, atol=2e-6)
    assert [m.thrust for m, _ in heard] == measured.tolist()
    assert [m.header.seq for m, _ in heard] == [0, 1, 2, 3]
    np.testing.assert_allclose([when for _, when in heard], [0.15, 0.16, 0.25, 0.35], atol=0.0011)


class Listener(Harness):
    """A subscriber of commands in a diagram of its own, whose time the test advances."""

    def __init__(self):
        self.lcm, builder = lcm.LCM("memq://"), DiagramBuilder()
        self.clock = builder.AddSystem(UnixClock())
        subscriber = lcm_ports.MessageSubscriber(self.lcm, CommandCodec(), 0.01)
        builder.AddSystem(subscriber)
        builder.Connect(self.clock.get_output_port(), subscriber.get_input_port())
        for name in ("command", "age", "gaps", "rejected"):
            builder.ExportOutput(subscriber.GetOutputPort(name), name)
        super().__init__(builder.Build())
        self.clock.set_epoch(self.context, EPOCH)

    def advance_to(self, time: float, *messages: bytes) -> None:
        """Sends messages, and advances to just after the updates at `time` [s]."""
        for data in messages:
            self.lcm.publish(CHANNEL, data)
        self.simulator.AdvanceTo(time + 1e-6)

    @property
    def value(self):
        return self.out("command")

    @property
    def counts(self) -> tuple[float, float]:
        return self.out("gaps"), self.out("rejected")


def message(
    seq: int, time: float, thrust=9.0, frame="body", session: int = 0, epoch: float = EPOCH
) -> bytes:
    """A command that was sent at the listener's `time` [s]."""
    header = lcmt_header()
    header.seq, header.utime, header.frame_name = seq, round((epoch + time) * 1e6), frame
    command = CommandCodec().pack(np.array([thrust, 0.1, 0.2, 0.3]), header, epoch)
    command.session = session
    return command.encode()


def test_last_message_and_its_age():
    listener = Listener()
    listener.advance_to(0.5)
    assert np.isnan(listener.value).all()
    assert listener.out("age") == np.inf
    listener.advance_to(0.6, message(0, 0.485, thrust=8.0), message(1, 0.595))
    np.testing.assert_array_equal(listener.value, [9.0, 0.1, 0.2, 0.3])
    listener.advance_to(0.9)
    assert listener.out("age") == pytest.approx(0.305001, abs=1e-6)
    assert listener.counts == (0, 0)


def test_gaps_are_counted_but_not_after_a_restart_or_in_a_burst():
    listener = Listener()
    for k, seq in enumerate([7, 8, 11, 12, 14]):
        listener.advance_to(0.01 * k, message(seq, 0.01 * k))
    listener.advance_to(1.09)
    for k, seq in enumerate([0, 1, 3]):
        listener.advance_to(1.1 + 0.01 * k, message(seq, 1.1 + 0.01 * k, session=1))
    assert listener.counts == (2 + 1 + 1, 0)
    burst = (message(4 + k, 1.2 + 1e-4 * k, thrust=k, session=1) for k in range(900))
    listener.advance_to(1.3, *burst)
    assert (listener.value[0], listener.counts) == (899, (4, 0))


@pytest.mark.parametrize(("session", "first"), [(1, 0), (1, 500), (0, -500)])
def test_of_two_senders_the_first_is_heard_and_the_other_counted(caplog, session, first):
    listener = Listener()
    for k in range(20):
        other = message(first + k, 0.02 * k + 0.01, thrust=9.0, session=session)
        listener.advance_to(0.02 * k + 0.01, message(k, 0.02 * k, thrust=8.0), other)
        assert listener.value[0] == 8.0
    assert listener.counts == (0, 20)
    assert "two senders on this channel" in caplog.text
    listener.advance_to(1.49)
    listener.advance_to(1.5, message(600, 1.5, thrust=9.0, session=session))
    assert listener.value[0] == 9.0


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
def test_invalid_messages_are_counted_and_logged(data, reason, caplog):
    listener = Listener()
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


def test_a_log_is_lcms_and_replays(tmp_path):
    now, path, transport = time.time(), tmp_path / "flight.lcm", lcm.LCM("memq://")
    messages = [message(k, 0.02 * k, thrust=k, epoch=now) for k in (0, 1, 2, 4, 5)]
    with lcm_ports.recorded(transport, path):
        send(transport, messages)
    logged = list(lcm.EventLog(path))
    assert [(e.channel, e.data) for e in logged] == [(CHANNEL, data) for data in messages]
    listeners = Listener(), Listener()
    for ours in listeners:
        lcm_ports.replay(path, ours.lcm, ours.simulator, ours.clock)
        ours.advance_to(ours.now + 0.01)
        assert (ours.value[0], ours.counts) == (5.0, (1, 0))
    assert listeners[0].out("age") == listeners[1].out("age")


def test_a_full_disk_only_ends_the_log(caplog):
    transport, heard = lcm.LCM("memq://"), []
    transport.subscribe(CHANNEL, lambda _, data: heard.append(data))
    with lcm_ports.recorded(transport, Path("/dev/full"), overwrite=True):
        send(transport, [bytes(1000)] * 100)
    assert len(heard) == 100
    [record] = caplog.records
    assert "/dev/full cannot be written, the log ends here: No space left" in record.message


def test_invalid_logs_are_errors(tmp_path):
    (tmp_path / "junk").write_bytes(b"this is no log of LCM" * 10)
    ours = Listener()
    for name, error in (("nowhere", FileNotFoundError), ("junk", ValueError)):
        with pytest.raises(error, match=name):
            lcm_ports.replay(tmp_path / name, ours.lcm, ours.simulator, ours.clock)
    for name, error in (("junk", FileExistsError), ("no folder/log", OSError)):
        with pytest.raises(error):
            lcm_ports.recorded(ours.lcm, tmp_path / name).__enter__()


@pytest.mark.parametrize(
    ("images", "overruns", "status"),
    [
        (["depth_image_32f", "color_image"], {}, [2, 4, 0.01, 0.07, 6, 12, 0]),
        ([], {"overruns": 4.0}, [2, 4, 0.01, 0, 2, 5, 4]),
    ],
)
def test_status_sums_up_the_inputs(images, overruns, status):
    system = Harness(BridgeStatus(images), mode=[2.0, 4.0], **overruns)
    values = {"age": (0.01, 0.05, 0.07), "gaps": (2.0, 3.0, 1.0), "rejected": (5.0, 7.0, 0.0)}
    for what, numbers in values.items():
        for name, value in zip(["state", *images], numbers, strict=False):
            system.give(**{f"{name}_{what}": value})
    np.testing.assert_array_equal(system.out("status"), status)
    assert system.out("observation_age") == status[3]
