"""Checkpoints of an optimization, and its log for tensorboard."""

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

_VERSION = 3
_REMEDY = "start again with --restart, which discards it"
_UNCOMPARED = {
    "threads",
    "checkpoint_every",
    "tensorboard",
    "voxel_size",
    "max_range",
    "distance_field",
    "split",
}
"""Fields that a run may be resumed with other values of: they do not change the optimization."""


def save_tensors(content: dict[str, Any], path: Path) -> None:
    """Writes a file for `load_tensors`, atomically.

    Raises:
        OSError: if it cannot be written; an existing file is kept.
    """
    with written_atomically(path) as partial:
        try:
            torch.save(content, partial)
        except RuntimeError as error:  # torch's error of a full disk
            raise OSError(f"perhaps the disk is full: {reason_of(error)}") from error


def load_tensors(path: Path) -> Any:
    """Reads a file of `save_tensors`.

    Raises:
        OSError, ValueError: if it cannot be read or is damaged; torch itself ignores checksums.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"its part {damaged} is damaged")
        return torch.load(path, weights_only=True)
    except (OSError, ValueError):
        raise
    except Exception as error:  # zipfile and the unpickler may raise anything
        raise ValueError(reason_of(error)) from None


def work_folder(out: Path) -> Path:
    """Returns the folder of an unfinished scene folder `out`, next to it."""
    out = out.absolute()
    return out.with_name(f".{out.name}.partial")


def _checkpoint_file(out: Path) -> Path:
    return work_folder(out) / "checkpoint.pt"


def kept_work(out: Path) -> str:
    """Tells how to resume an unfinished scene folder `out`."""
    if _checkpoint_file(out).exists():
        return f"the last checkpoint is in {work_folder(out)}; the same command resumes from it"
    return "nothing is kept yet; the same command starts again"


class Checkpoint:
    """The file with the state of an optimization, in `work_folder(out)`.

    Args:
        out: scene folder to be written.
        config: of the run.
        views: fitted views.
    """

    def __init__(self, out: Path, config: ReconstructConfig, views: ReconstructionViews):
        self.folder, self.file = work_folder(out), _checkpoint_file(out)
        self._config = _compared_fields(config)
        digest = hashlib.sha256()
        for name in ("images", "depths", "valid", "viewmats", "K", "gains"):
            digest.update(getattr(views, name).numpy().tobytes())
        self._capture = digest.hexdigest()

    def save(self, content: dict[str, Any]) -> None:
        """Replaces the checkpoint.

        Raises:
            OSError: if it cannot be written; the last checkpoint is kept.
        """
        header = {"version": _VERSION, "config": self._config, "capture": self._capture}
        self.folder.mkdir(parents=True, exist_ok=True)
        save_tensors(header | content, self.file)

    def load(self) -> dict[str, Any] | None:
        """Returns the last checkpoint, or None.

        Raises:
            ValueError: if it is damaged, or of another configuration or capture.
        """
        content = _read(self.file, self._config)
        if content is not None and content["capture"] != self._capture:
            raise ValueError(
                f"{self.file}: an interrupted run on another capture, or its files have changed; "
                f"{_REMEDY}"
            )
        return content

    def remove(self) -> None:
        """Removes the work folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def require_same_run(out: Path, config: ReconstructConfig) -> None:
    """Checks a checkpoint of `out` before anything slow is prepared.

    Raises:
        ValueError: if it is damaged, or of another configuration.
    """
    _read(_checkpoint_file(out), _compared_fields(config))


def _compared_fields(config: ReconstructConfig) -> dict[str, Any]:
    return {name: value for name, value in asdict(config).items() if name not in _UNCOMPARED}


def _read(file: Path, config: dict[str, Any]) -> dict[str, Any] | None:
    """Returns the content of a checkpoint of a run with `config`; None if there is no file."""
    if not file.exists():
        return None
    try:
        content = load_tensors(file)
    except ValueError as error:
        raise ValueError(f"{file}: not a readable checkpoint ({error}); {_REMEDY}") from None
    if content.get("version") != _VERSION:
        raise ValueError(f"{file}: written by another version of the program; {_REMEDY}")
    for name, value in config.items():
        saved = content["config"].get(name)
        if saved != value:
            raise ValueError(
                f"{file}: an interrupted run with {name} {saved}, not {value}; set {name}={saved} "
                f"to resume, or {_REMEDY}"
            )
    return content


@contextmanager
def event_log(folder: str) -> Iterator[Callable[[int, dict[str, float]], None]]:
    """Yields a function that logs metrics of a step for tensorboard; without a folder, it does
    nothing.

    Raises:
        ModuleNotFoundError: if tensorboard is required and not installed.
    """
    if not folder:
        yield lambda step, metrics: None
        return
    tensorboard = import_extra("torch.utils.tensorboard", "tensorboard")
    with tensorboard.SummaryWriter(folder) as writer:

        def log(step: int, metrics: dict[str, float]) -> None:
            for name, value in metrics.items():
                writer.add_scalar(name, value, step)

        yield log
