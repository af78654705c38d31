"""Progress of long commands: bars in a terminal, one line per minute elsewhere."""

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

_PERIOD = 60.0  # [s] between two lines that are not for a terminal
_SHORT = 5.0  # [s] shorter work has no line at its end
_COLUMNS, _ROWS = 80, 24  # of terminals of unknown size
_BAR = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"
_CHECKPOINT_PERIOD = 30.0  # [s] between two checkpoints, or longer
_MAX_FRACTION = 0.02  # maximum fraction of the time for checkpoints


class Progress(tqdm):
    """Shows progress on standard error: `tqdm` in a terminal, with its arguments; elsewhere a line
    at the beginning, one per minute, and one at the end of long work."""

    monitor_interval = 0  # No thread: Drake aborts if another thread frees its objects.

    def __init__(
        self,
        iterable: Iterable[Any] | None = None,
        desc: str = "",
        total: float | None = None,
        **keywords: Any,
    ) -> None:
        self._lines = not sys.stderr.isatty()
        self._printed_at = -_PERIOD
        self._started_at = time.monotonic()
        if self._lines:
            keywords |= {"mininterval": 0.0, "leave": False}  # `display` has a clock of its own
        elif total is not None or isinstance(iterable, Sized):
            keywords = {"bar_format": _BAR} | keywords
        columns, rows = _terminal_size()
        given = {"unit": "", "miniters": 1, "ncols": columns, "nrows": rows, "file": sys.stderr}
        super().__init__(iterable, desc, total, **given | keywords)

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Shows the bar, or prints a line if the last one is a minute old."""
        if not self._lines:
            return super().display(msg, pos)
        now = time.monotonic()
        if msg is None and now - self._printed_at >= _PERIOD:
            self._printed_at = now
            print(self._line(now - self._started_at), file=sys.stderr, flush=True)

    def clear(self, nolock: bool = False) -> None:
        """Removes the bar; lines stay."""
        if not self._lines:
            super().clear(nolock)

    def close(self) -> None:
        """Ends the bar, or prints the last line."""
        if not getattr(self, "disable", True) and self._lines:
            if time.monotonic() - self._started_at > max(_SHORT, self.delay):
                self._printed_at = -_PERIOD
                self.display()
        super().close()

    def _line(self, elapsed: float) -> str:
        if self.bar_format:
            return str(self)
        done = self.n - self.initial
        line = f"{self.desc.removesuffix(': ')}: {self.n:.9g}"
        if self.total:
            line += f" of {self.total:.9g}"
        if elapsed >= 1.0:
            line += f", {self.format_interval(elapsed)} elapsed"
        if self.total and 0 < done < self.total - self.initial:
            left = elapsed * (self.total - self.n) / done
            line += f", {self.format_interval(left)} left"
        return f"{line}, {self.postfix}" if self.postfix else line


def say(text: str) -> None:
    """Prints a line on standard error, above open bars."""
    if sys.stderr.isatty():
        tqdm.write(text, file=sys.stderr)
    else:
        print(text, file=sys.stderr, flush=True)


class CheckpointClock:
    """Clock for checkpoints: one is due 30 s after the last, or later if writing takes over 2 %."""

    def __init__(self) -> None:
        self._next = time.monotonic() + _CHECKPOINT_PERIOD

    @property
    def is_due(self) -> bool:
        """Checks if another should be written."""
        return time.monotonic() >= self._next

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Times the block, which writes a checkpoint."""
        begun = time.monotonic()
        yield
        ended = time.monotonic()
        self._next = ended + max(_CHECKPOINT_PERIOD, (ended - begun) / _MAX_FRACTION)


@contextmanager
def resumable(kept: Callable[[], str]) -> Iterator[None]:
    """Adds to an interruption (Ctrl-C, SIGTERM) of the block what is kept and how to resume.

    The innermost block adds its note, which the command line prints.
    """
    try:
        yield
    except KeyboardInterrupt as interruption:
        if not getattr(interruption, "__notes__", None):
            interruption.add_note(kept())
        raise


def _terminal_size() -> tuple[int, int]:
    try:
        columns, rows = os.get_terminal_size(sys.stderr.fileno())
    except (OSError, ValueError):
        columns, rows = 0, 0
    return columns or _COLUMNS, rows or _ROWS
