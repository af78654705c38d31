"""Damages files, has them read, and says what became of each: in a process of its own, because a
reader that waits for ever or takes all memory can only be ended from outside."""

import collections
import contextlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fuzz.mutations import PICKLE_LEFT, damage, replace_file
from fuzz.packets import PACKETS
from fuzz.readers import READERS, Reader
from fuzz.run_readers import RUN_READERS
from fuzz.splat_readers import SPLAT_READERS

TIME_LIMIT = 10.0
"""[s] for a case."""
_MEMORY = 3 << 30  # [bytes] for a case, beside what the libraries take
_LINKS = 0.03  # fraction of cases in which a file becomes something that is no file

ALL = READERS | SPLAT_READERS | RUN_READERS | PACKETS


class Outcome(NamedTuple):
    """What became of a case."""

    case: int
    kind: str
    """accepted, refused, or what is wrong: traceback, weak, nonsense, hang, crash."""
    what: str = ""


class _HangError(BaseException):
    """The time is over."""


def cases(name: str, start: int, stop: int, seed: int) -> Iterator[Outcome]:
    """Runs cases in this process. The same name, case and seed make the same damage."""
    reader = ALL[name]
    with tempfile.TemporaryDirectory(prefix="fuzz-") as root, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        whole = Path(root) / "whole"
        whole.mkdir()
        reader.write(whole)
        reader.use(reader.read(whole))  # What is whole must be accepted.
        for case in range(start, stop):
            folder = Path(root) / f"case{case}"
            shutil.copytree(whole, folder)
            rng = np.random.default_rng([seed, case, *name.encode()])
            file = _damage(reader, folder, rng)
            yield Outcome(case, *outcome_of(reader, folder, file))
            shutil.rmtree(folder)
            if PICKLE_LEFT.exists():
                raise AssertionError(f"{name}, case {case}: a pickle was run")


def _end(*_: object) -> None:
    raise _HangError


def _damage(reader: Reader, folder: Path, rng: np.random.Generator) -> Path:
    patterns = reader.damaged.split()
    found = [sorted(file for file in folder.glob(p) if file.is_file()) for p in patterns]
    files = [some for some in found if some]
    some = files[rng.integers(len(files))]
    file = some[rng.integers(len(some))]
    if rng.random() < _LINKS:
        replace_file(file, rng)
    else:
        file.write_bytes(damage(file.read_bytes(), rng))
    return file


def outcome_of(reader: Reader, folder: Path, file: Path) -> tuple[str, str]:
    """What becomes of a folder in which `file` is damaged: the kind of outcome, and why."""
    signal.signal(signal.SIGALRM, _end)
    signal.setitimer(signal.ITIMER_REAL, TIME_LIMIT)
    try:
        read = reader.read(folder)
    except _HangError:
        return "hang", file.name
    except (ValueError, OSError) as error:
        named = reader.names(str(error), folder)
        one_line = "\n" not in str(error) and len(str(error)) < 800
        return ("refused", "") if named and one_line else ("weak", f"{file.name}: {error!r:.300}")
    except BaseException as error:
        return "traceback", f"{file.name}: {error!r:.300}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    signal.setitimer(signal.ITIMER_REAL, TIME_LIMIT)
    try:
        reader.use(read)
    except _HangError:
        return "hang", f"{file.name}, in use"
    except BaseException as error:
        return "nonsense", f"{file.name}: {error!r:.300}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return "accepted", ""


def run(name: str, count: int, seed: int = 0) -> list[Outcome]:
    """Runs cases of a reader in processes with a limit of memory, a new one after each that
    crashed or that nothing but a kill could end."""
    outcomes: list[Outcome] = []
    while len(outcomes) < count:
        found, status, said = _run_from(name, len(outcomes), count, seed)
        outcomes += found
        if len(outcomes) < count:
            if status is not None and status > 0:  # The harness itself failed.
                raise RuntimeError(f"{name}: {said[-2000:]}")
            kind = "hang" if status is None else "crash"
            outcomes.append(Outcome(len(outcomes), kind, f"status {status}"))
    return outcomes


def _run_from(name: str, start: int, stop: int, seed: int) -> tuple[list[Outcome], int | None, str]:
    """Outcomes of the cases up to one that ends the process, its exit status, None if it had to be
    killed, and what it said."""
    words = [sys.executable, "-m", "fuzz.campaign", name, str(start), str(stop), str(seed)]
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        process = subprocess.Popen(words, stdout=out, stderr=err)
        size, last = 0, time.monotonic()
        while process.poll() is None and time.monotonic() - last < 2 * TIME_LIMIT + 30:
            time.sleep(0.02)
            if (now := os.fstat(out.fileno()).st_size) > size:
                size, last = now, time.monotonic()
        status = process.poll()
        process.kill()
        process.wait()
        out.seek(0)
        err.seek(0)
        return [Outcome(*json.loads(line)) for line in out], status, err.read()


def counts(outcomes: list[Outcome]) -> collections.Counter[str]:
    """How many of each kind."""
    return collections.Counter(outcome.kind for outcome in outcomes)


def _main() -> None:
    name, *numbers = sys.argv[1:]
    iterator = cases(name, *map(int, numbers))
    first = next(iterator)  # All libraries are there now.
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY, used + _MEMORY))
    print(json.dumps(first), flush=True)
    for outcome in iterator:
        print(json.dumps(outcome), flush=True)


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        _main()
