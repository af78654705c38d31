"""Checkpoints of an optimisation: whole files that say what they belong to."""

import hashlib
import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import reason_of
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.views import ReconstructionViews


def save_tensors(content: dict[str, Any], path: Path) -> None:
    """Writes what `torch.load` reads with `weights_only`, whole or not at all.

    Raises:
        OSError: if it cannot be written; what was there before is kept.
    """
    with written_atomically(path) as partial:
        try:
            torch.save(content, partial)
        except RuntimeError as error:  # so torch says that the disk is full
            raise OSError(f"perhaps the disk is full: {reason_of(error)}") from error


def load_tensors(path: Path) -> Any:
    """Reads what `save_tensors` wrote.

    Raises:
        OSError, ValueError: if it cannot be read, or is not what was written: torch takes numbers
            for what they are, without a look at the checksums that are there.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"its part {damaged} is damaged")
        return torch.load(path, weights_only=True)
    except (OSError, ValueError):
        raise
    except Exception as error:  # of a damaged file, zipfile and the unpickler may raise anything
        raise ValueError(reason_of(error)) from None


VERSION = 2
_REMEDY = "start anew with --restart, which discards it"
# What may differ when an interrupted run goes on, for it changes nothing that is computed.
_INDIFFERENT = (
    "threads",
    "checkpoint_every",
    "measure_every",
    "tensorboard",
    "voxel_size",
    "max_range",
    "distance_field",
    "split",
)


def work_folder(out: Path) -> Path:
    """Where what is not finished of the scene folder `out` is kept, beside it."""
    out = out.absolute()
    return out.with_name(f".{out.name}.partial")


def _checkpoint_file(out: Path) -> Path:
    return work_folder(out) / "checkpoint.pt"


def kept_work(out: Path) -> str:
    """Tells what is kept of an unfinished scene folder `out`, and how to resume."""
    if _checkpoint_file(out).exists():
        return f"the last checkpoint is in {work_folder(out)}; the same command resumes from it"
    return "nothing is kept yet; the same command starts again"


class Checkpoint:
    """The one file in which an optimisation is kept while it runs, in a work folder beside `out`.

    Args:
        out: the scene folder that is to be made.
        config: the run's.
        views: what it is fitted to.
    """

    def __init__(self, out: Path, config: ReconstructConfig, views: ReconstructionViews):
        self.folder = work_folder(out)
        self.file = _checkpoint_file(out)
        self._config = _compared_fields(config)
        digest = hashlib.sha256()
        for tensor in (
            views.images,
            views.depths,
            views.valid,
            views.viewmats,
            views.K,
            views.gains,
        ):
            digest.update(tensor.numpy().tobytes())
        self._capture = digest.hexdigest()

    def save(self, content: dict[str, Any]) -> None:
        """Replaces what was kept.

        Raises:
            OSError: if it cannot be written, for example because the disk is full; what was kept
                before is kept.
        """
        own = {"version": VERSION, "config": self._config, "capture": self._capture}
        self.folder.mkdir(parents=True, exist_ok=True)
        save_tensors({**own, **content}, self.file)

    def load(self) -> dict[str, Any] | None:
        """Returns what was kept last, or None if nothing was.

        Raises:
            ValueError: if the file is damaged, or belongs to another configuration or capture.
        """
        content = _read(self.file, self._config)
        if content is None:
            return None
        if content["capture"] != self._capture:
            raise ValueError(
                f"{self.file}: an interrupted run on another capture, or its files have changed; "
                f"{_REMEDY}"
            )
        return content

    def remove(self) -> None:
        """Removes the work folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def require_same_run(out: Path, config: ReconstructConfig) -> None:
    """Checks what an interrupted run has left beside `out`, before anything slow is prepared.

    Raises:
        ValueError: if that is damaged, or of another configuration.
    """
    _read(_checkpoint_file(out), _compared_fields(config))


def _compared_fields(config: ReconstructConfig) -> dict[str, Any]:
    fields = asdict(config)
    return {name: fields[name] for name in fields if name not in _INDIFFERENT}


def _read(file: Path, config: dict[str, Any]) -> dict[str, Any] | None:
    """What a file holds, which must be of a run with `config`; None if there is no file."""
    if not file.exists():
        return None
    try:
        content = load_tensors(file)
    except ValueError as error:
        raise ValueError(f"{file}: not a readable checkpoint ({error}); {_REMEDY}") from None
    if content.get("version") != VERSION:
        raise ValueError(f"{file}: written by another version of the program; {_REMEDY}")
    for name, value in config.items():
        kept = content["config"].get(name)
        if kept != value:
            raise ValueError(
                f"{file}: an interrupted run with {name} {kept}, not {value}; "
                f"set it so to go on; or {_REMEDY}"
            )
    return content


@contextmanager
def event_log(folder: str) -> Iterator[Callable[[int, dict[str, float]], None]]:
    """Yields a function that logs numbers of a step for tensorboard; it does nothing without a
    folder.

    Raises:
        ModuleNotFoundError: tensorboard is wanted and not installed.
    """
    if not folder:
        yield lambda step, figures: None
        return
    tensorboard = import_extra("torch.utils.tensorboard", "tensorboard")
    with tensorboard.SummaryWriter(folder) as writer:

        def log(step: int, figures: dict[str, float]) -> None:
            for name, value in figures.items():
                writer.add_scalar(name, value, step)

        yield log
