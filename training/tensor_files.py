"""Files of tensors: the checkpoints from which runs go on."""

import zipfile
from pathlib import Path
from typing import Any

import torch

from splatpilot.systems.array_files import reason_of
from splatpilot.systems.files import written_atomically


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
