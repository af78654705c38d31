"""Several training runs at once, each in a process and on a core of its own."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatpilot.training.policies import train
from splatpilot.training.policies.registry import TRAINERS
from splatpilot.training.policies.trainer import TrainingConfig


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
    from joblib import Parallel, delayed
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    jobs = min(jobs, len(runs))
    work = [delayed(_run)(run, line % jobs) for line, run in enumerate(runs)]
    try:
        results: Any = Parallel(jobs)(work)
    except TerminatedWorkerError as error:
        raise OSError(
            f"a training process was killed, perhaps for want of memory ({error}); run the same "
            "command again to go on, with fewer --jobs if it repeats"
        ) from None
    finally:
        if jobs > 1:
            get_reusable_executor().shutdown(wait=True, kill_workers=True)
    stopped = [
        f"{run.out}: {result}"
        for run, result in zip(runs, results, strict=True)
        if not isinstance(result, dict)
    ]
    if stopped:
        raise ValueError("\n".join(stopped))
    return results


def _run(run: TrainingRun, line: int) -> dict[str, Any] | str:
    """The summary of a run, or why it stopped."""
    make = TRAINERS.find(run.trainer).make
    try:
        return train.run(config=run.config, out=run.out, make=make, bar_line=line)
    except (ValueError, OSError) as error:
        return str(error)
