"""Logs of messages, as `lcm-logger` writes and `lcm-logplayer` plays them."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lcm import LCM, EventLog
from pydrake.systems.analysis import Simulator

from splatpilot.systems.files import require_unused
from splatpilot.systems.messaging.unix_clock import UnixClock

_log = logging.getLogger(__name__)


@contextmanager
def recorded(lcm: LCM, path: Path, overwrite: bool = False) -> Iterator[None]:
    """
    Writes what comes by LCM, on all channels, into a log, each message with the time at which the
    LCM was asked for it.

    A disk that is full ends the log, with one warning, but not the flight that it is a log of.

    Raises:
        OSError: if there is such a file already, unless with `overwrite`, or it cannot be made.
    """
    require_unused(path, overwrite)
    log, is_writable = EventLog(path, "w", overwrite=overwrite), True

    def write(channel: str, data: bytes) -> None:
        nonlocal is_writable
        if not is_writable:
            return
        try:
            log.write_event(time.time_ns() // 1000, channel, data)
        except OSError as error:
            is_writable = False
            _log.warning("%s cannot be written, the log ends here: %s", path, error.strerror)

    subscription = lcm.subscribe(".*", write)
    subscription.set_queue_capacity(10_000)  # They wait while a world is made.
    try:
        yield
    finally:
        lcm.unsubscribe(subscription)
        log.close()


def replay(path: Path, lcm: LCM, simulator: Simulator, clock: UnixClock) -> None:
    """
    Simulates a diagram while it receives the messages of a log, each when it came.

    The same log gives the same simulation, bit for bit.

    Args:
        path: of the log.
        lcm: that the diagram's systems were made with, of `memq://`.
        simulator: of the diagram, at time 0, which is when the first message came.
        clock: of the diagram.

    Raises:
        OSError: if the log cannot be read.
        ValueError: if it has no messages.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such log")
    events = [(event.timestamp, event.channel, event.data) for event in EventLog(path)]
    if not events:
        raise ValueError(f"{path} holds no messages; it is empty, or no log of LCM")
    root = simulator.get_mutable_context()
    first = events[0][0]
    clock.set_epoch(clock.GetMyMutableContextFromRoot(root), first * 1e-6)
    for timestamp, channel, data in events:
        simulator.AdvanceTo(max((timestamp - first) * 1e-6, root.get_time()))
        lcm.publish(channel, data)
    simulator.AdvancePendingEvents()
