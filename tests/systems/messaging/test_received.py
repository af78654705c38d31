"""What receivers keep."""

import copy
import logging
from dataclasses import dataclass, replace

from splatpilot.systems.messaging.lcm_ports import Received


@dataclass(frozen=True, eq=False, kw_only=True)
class _Numbers(Received):
    numbers: tuple[int, ...] = ()


def _after(received: _Numbers, message: bytes) -> _Numbers:
    return replace(received, numbers=(*received.numbers, int(message)))


def test_messages_are_taken_or_counted(caplog):
    """Each good message is taken in its turn; what is no message, and those of strangers, are
    counted, and the reason is logged at the first, second, fourth, eighth... rejection."""
    received = _Numbers().taking([b"1", b"x", b"2"], 2, "the line", _after)
    assert (received.numbers, received.rejected) == ((1, 2), 3)
    with caplog.at_level(logging.WARNING):
        caplog.clear()
        for _ in range(14):
            received = received.taking([b"y"], 0, "the line", _after)
    assert received.rejected == 17
    counts = [record.args[1] for record in caplog.records]
    assert counts == [4, 8, 16]
    assert "the line: a message is refused, 4 so far: invalid literal" in caplog.text


def test_contexts_share_what_has_come():
    """It never changes, so that copies of a Context need none of it."""
    received = _Numbers(numbers=(1,))
    assert copy.deepcopy(received) is received
