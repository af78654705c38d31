"""Logs, and LCM's own tools as the other end."""

import subprocess
import time
from pathlib import Path

import lcm
import numpy as np
import pytest
from drake import lcmt_header

from splatpilot.systems.messaging.bridge_status import UnixClock
from splatpilot.systems.messaging.codecs import CommandCodec
from splatpilot.systems.messaging.lcm_ports import open_lcm, recorded, replay

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
    """A log that lcm-logger wrote of messages over UDP replays into a diagram: value, age and gap
    are those of the flight, and of every replay."""
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
    """lcm's EventLog reads what we recorded, and lcm-logplayer sends it again."""
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
    """A log that is missing, empty or none is an error that names it; none is overwritten."""
    (tmp_path / "junk").write_bytes(b"this is no log of LCM" * 10)
    ours = listener(CommandCodec())
    with pytest.raises(FileNotFoundError, match="nowhere: there is no such log"):
        replay(tmp_path / "nowhere", ours.lcm, ours.simulator, UnixClock())
    with pytest.raises(ValueError, match="junk holds no messages"):
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
