import contextlib
import os
import sys
import termios
import time

import pytest

from splatpilot.systems.common.progress import CheckpointClock, Progress, resumable, say


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """The time [s], which stands until a test moves it."""
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def test_without_a_terminal_a_line_a_minute_tells_what_is_left(clock, capsys):
    with Progress(total=10, initial=2, desc="training", unit="update") as progress:
        for _ in range(4):
            clock[0] += 25.0
            progress.set_postfix_str("loss 0.5", refresh=False)
            progress.update()
    assert capsys.readouterr().err.splitlines() == [
        "training: 2 of 10",
        "training: 5 of 10, 01:15 elapsed, 02:05 left, loss 0.5",
        "training: 6 of 10, 01:40 elapsed, 01:40 left, loss 0.5",
    ]


def test_short_work_is_one_line_in_a_file_or_none_with_a_delay(clock, capsys):
    for _ in Progress(range(3), "fusing depth", unit="image", delay=2.0):
        clock[0] += 0.1
    for _ in Progress(range(30), "loading frames", unit="frame"):
        clock[0] += 0.1
        say("a frame is damaged")
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["loading frames: 0 of 30", *["a frame is damaged"] * 30]


@pytest.mark.parametrize("columns", [0, 40, 100])
def test_bars_fit_their_terminal(columns, monkeypatch):
    ours, theirs = os.openpty()
    termios.tcsetwinsize(theirs, (columns // 4, columns))
    with os.fdopen(theirs, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        for _ in Progress(range(3), "training a policy", unit="update", mininterval=0.0):
            pass
    shown = b""
    with contextlib.suppress(OSError):  # which Linux raises if the other end is closed
        while part := os.read(ours, 4096):
            shown += part
    os.close(ours)
    bars = [bar for bar in shown.decode().replace("\n", "\r").split("\r") if bar.strip()]
    assert bars[-1].startswith("training a policy: 100%") and "3/3" in bars[-1]
    assert max(map(len, bars)) <= (columns or 80)


def test_an_interruption_says_what_is_kept_nearest_to_it():
    with pytest.raises(KeyboardInterrupt) as interruption:
        with resumable(lambda: "the study"), resumable(lambda: "update 3"):
            raise KeyboardInterrupt
    assert interruption.value.__notes__ == ["update 3"]
    with pytest.raises(ValueError, match="no") as failure, resumable(lambda: "update 3"):
        raise ValueError("no")
    assert not hasattr(failure.value, "__notes__")


def test_checkpoints_take_a_small_part_of_the_time(clock):
    checkpoints = CheckpointClock()
    assert not checkpoints.is_due
    for takes, wait in ((0.0, 30.0), (2.0, 100.0)):
        with checkpoints.writing():
            clock[0] += takes
        clock[0] += wait - 0.1
        assert not checkpoints.is_due
        clock[0] += 0.1
        assert checkpoints.is_due
