"""Files of tensors: the checkpoints from which runs go on."""

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
