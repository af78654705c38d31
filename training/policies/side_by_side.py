"""Several training runs at once, each in a process and on a core of its own."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatpilot.systems.common.processes import map_processes
from splatpilot.training.policies import train
from splatpilot.training.policies.trainer import TrainingConfig
from splatpilot.training.policies.trainer_registry import TRAINERS


@dataclass(frozen=True)
class TrainingRun:
    """What `train.run` is to do."""

    trainer: str
    """Name of a trainer, or module:attribute."""
    config: TrainingConfig
    out: Path


def run_side_by_side(runs: Sequence[TrainingRun], jobs: int) -> list[dict[str, Any]]:
    """
    Trains, `jobs` runs at a time, and returns their summaries in order.

    What a run learns does not depend on those beside it.

    Args:
        runs: each in a folder of its own.
        jobs: processes; with one, runs follow one another in this one.

    Raises:
        ValueError: if a run stopped, as `train.run` says; the others were finished.
        OSError: if a process was killed: the same call goes on.
    """
    jobs = min(jobs, len(runs))
    work = [(index, run, index % jobs) for index, run in enumerate(runs)]
    ended = dict(map_processes(_run, work, jobs))
    results = [ended[index] for index in range(len(runs))]
    stopped = [
        f"{run.out}: {result}"
        for run, result in zip(runs, results, strict=True)
        if not isinstance(result, dict)
    ]
    if stopped:
        raise ValueError("\n".join(stopped))
    return results


def _run(work: tuple[int, TrainingRun, int]) -> tuple[int, Any]:
    """The index of a run, and its summary, or why it stopped."""
    index, run, line = work
    make = TRAINERS.find(run.trainer).make
    try:
        return index, train.run(config=run.config, out=run.out, make=make, bar_line=line)
    except (ValueError, OSError) as error:
        return index, str(error)
