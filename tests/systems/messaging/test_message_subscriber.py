"""What comes in by LCM."""

import gc
import logging
import weakref

import numpy as np
import pytest
from drake import lcmt_header

from splatpilot.systems.messaging.codecs import CommandCodec, DepthGridCodec, StateCodec
from splatpilot.systems.messaging.lcm_ports import MessageSubscriber

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
    """Nothing is known yet: the value is not a number and its age infinite."""
    listener = listener(CommandCodec())
    listener.advance_to(0.5)
    assert np.isnan(listener.value).all()
    assert listener.number("age") == np.inf
    assert counts(listener) == (0, 0)


def test_last_message_and_its_age(listener):
    """The newest message is the value, until another comes; its age is the time since it was
    sent."""
    listener = listener(CommandCodec())
    listener.lcm.publish("BODY_RATE_COMMAND", command(0, -0.015, thrust=8.0))
    listener.lcm.publish("BODY_RATE_COMMAND", command(1, -0.005, thrust=9.0))
    listener.advance_to(0.0)
    np.testing.assert_array_equal(listener.value, [9.0, 0.1, 0.2, 0.3])
    listener.advance_to(0.3)
    assert listener.number("age") == pytest.approx(0.305001, abs=1e-6)
    assert counts(listener) == (0, 0)


def test_gaps_are_counted(listener):
    """Each sequence number that never came is one gap; a sender that starts again leaves none."""
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
    """Twenty messages between two looks leave no gap."""
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
        (command(1, 0.01) + b"\0", "longer than its content"),
        (command(1, 0.01, thrust=np.nan), "must be finite"),
        (command(1, 0.01, frame="ned"), "the frame is 'ned'; it must be 'body'"),
        (command(1, 0.0), "no newer than the one before"),
        (command(1, -0.1), "no newer than the one before"),
        (command(1, 0.4), "ahead of our clock"),
    ],
)
def test_messages_of_no_use_are_counted_and_logged(listener, data, reason, caplog):
    """A message of another type, length, frame or time changes nothing but the count of those
    that were refused, and the next good one is taken."""
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
    """Messages whose bytes were overwritten, cut or extended at random are taken or refused, and
    what is taken is finite."""
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
    """A thousand refused messages are logged ten times."""
    listener = listener(CommandCodec())
    with caplog.at_level(logging.WARNING):
        for k in range(1000):
            listener.lcm.publish("BODY_RATE_COMMAND", b"x")
            listener.advance_to(k * 0.01)
    assert len(caplog.records) == 10


def test_what_came_is_in_the_context(listener):
    """A copy of the Context keeps the message that it had."""
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
    """Whoever drops a diagram gets its memory back, and LCM no longer delivers to it."""
    listener = listener(CommandCodec())
    lcm, freed = listener.lcm, weakref.ref(listener.subscriber)
    del listener
    gc.collect()
    assert freed() is None
    lcm.publish("BODY_RATE_COMMAND", command(0, 0.0))
    assert not lcm.handle_timeout(0)


@pytest.mark.parametrize("period", [0.0, -1.0, np.inf, np.nan])
def test_period_must_be_positive(listener, period):
    """A period that is none is an error that names the channel."""
    with pytest.raises(ValueError, match="BODY_RATE_COMMAND are looked for every"):
        MessageSubscriber(None, CommandCodec(), period)
