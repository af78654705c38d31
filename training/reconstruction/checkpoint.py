"""Checkpoints of an optimization, and its log for tensorboard."""

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
from splatpilot.systems.common.readers import error_summary
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.views import ReconstructionViews

_VERSION = 4
_REMEDY = "start again with --restart, or delete that file"
# Fields that may differ when a run resumes: they do not change the optimization.
_UNCOMPARED = {"threads", "checkpoint_every", "tensorboard", "split"}
_UNCOMPARED |= {"voxel_size", "max_range", "distance_field"}


def save_tensors(content: dict[str, Any], path: Path) -> None:
    """Writes a file for `load_tensors`, atomically."""
    with written_atomically(path) as partial:
        try:
            torch.save(content, partial)
        except RuntimeError as error:  # torch's error of a full disk
            raise OSError(f"perhaps the disk is full: {error_summary(error)}") from error


def load_tensors(path: Path) -> Any:
    """Reads a file of `save_tensors`; raises OSError or ValueError for a damaged one."""
    try:
        with zipfile.ZipFile(path) as archive:  # torch ignores checksums
            damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"its part {damaged} is damaged")
        return torch.load(path, weights_only=True)
    except (OSError, ValueError):
        raise
    except Exception as error:  # zipfile and the unpickler may raise anything
        raise ValueError(error_summary(error)) from None


def work_folder(out: Path) -> Path:
    """Returns the folder of an unfinished scene folder `out`, next to it."""
    out = out.absolute()
    return out.with_name(f".{out.name}.partial")


def kept_work(out: Path) -> str:
    """Tells how to resume an unfinished scene folder `out`."""
    folder = work_folder(out)
    if (folder / "checkpoint.pt").exists():
        return f"the last checkpoint is in {folder}; the same command resumes from it"
    return "nothing is kept yet; the same command starts again"


class Checkpoint:
    """The file with the state of an optimization, in `work_folder(out)`. Without the fitted
    `views`, it compares only the config with that of the checkpoint."""

    def __init__(
        self, out: Path, config: ReconstructConfig, views: ReconstructionViews | None = None
    ):
        self.folder = work_folder(out)
        self._file = self.folder / "checkpoint.pt"
        fields = asdict(config).items()
        self._config = {name: value for name, value in fields if name not in _UNCOMPARED}
        self._capture = None if views is None else views.digest()

    def save(self, content: dict[str, Any]) -> None:
        """Replaces the checkpoint; if it cannot be written, the last one is kept."""
        header = {"version": _VERSION, "config": self._config, "capture": self._capture}
        self.folder.mkdir(parents=True, exist_ok=True)
        save_tensors(header | content, self._file)

    def load(self) -> dict[str, Any] | None:
        """Returns the last checkpoint, or None without one."""
        file = self._file
        if not file.exists():
            return None
        try:
            content = load_tensors(file)
        except ValueError as error:
            raise ValueError(f"{file}: not a readable checkpoint ({error}); {_REMEDY}") from None
        if content.get("version") != _VERSION:
            raise ValueError(f"{file}: written by another version of the program; {_REMEDY}")
        for name, value in self._config.items():
            if (saved := content["config"].get(name)) != value:
                raise ValueError(
                    f"{file}: an interrupted run with {name} {saved}, not {value}; set "
                    f"{name}={saved} to resume, or {_REMEDY}"
                )
        if self._capture not in (None, content["capture"]):
            raise ValueError(
                f"{file}: an interrupted run on another capture, or its files have changed; "
                f"{_REMEDY}"
            )
        return content

    def remove(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


@contextmanager
def event_log(folder: str) -> Iterator[Callable[[int, dict[str, float]], None]]:
    """Yields a function that logs metrics of a step for tensorboard, or ignores them."""
    if not folder:
        yield lambda step, metrics: None
        return
    tensorboard = import_extra("torch.utils.tensorboard", "tensorboard")
    with tensorboard.SummaryWriter(folder) as writer:

        def log(step: int, metrics: dict[str, float]) -> None:
            for name, value in metrics.items():
                writer.add_scalar(name, value, step)

        yield log
