"""Numbers of a long run, for tensorboard."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from splatpilot.systems.extras import import_extra


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
