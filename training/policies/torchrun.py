"""The processes of `torchrun`: each learns from its part of every batch, on a GPU of its own, and
all take the same step."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import distributed

from splatpilot.training.policies.trainer import Trainer


@dataclass(frozen=True)
class Processes:
    """Those that train together; without torchrun this one alone."""

    rank: int = 0
    """Of this one."""
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether it is this one that measures and writes."""
        return self.rank == 0

    def wait(self) -> None:
        """Until all have come here."""
        if self.count > 1:
            distributed.barrier()

    def share_batches(self, trainer: Trainer) -> None:
        """Has the losses of a trainer be of this process's part of every batch.

        Raises:
            ValueError: if its batches have no such parts.
        """
        if self.count == 1:
            return
        take_part = getattr(trainer, "take_part", None)
        if take_part is None:
            raise ValueError(
                f"torchrun started {self.count} processes, but {trainer.policy} learns in one "
                "alone; run it without torchrun"
            )
        take_part(self.rank, self.count)

    def of_first[Value](self, value: Value) -> Value:
        """What the first has."""
        if self.count == 1:
            return value
        values = [value]
        distributed.broadcast_object_list(values)
        return values[0]

    @torch.no_grad()
    def average(self, tensors: list[torch.Tensor]) -> None:
        """Makes tensors the mean of what they are in all processes."""
        if self.count == 1:
            return
        joined = torch.cat([values.flatten() for values in tensors])
        distributed.all_reduce(joined)
        parts = (joined / self.count).split([values.numel() for values in tensors])
        for values, part in zip(tensors, parts, strict=True):
            values.copy_(part.view_as(values))


@contextmanager
def torchrun_processes(device: str) -> Iterator[Processes]:
    """
    The processes that torchrun started this one among, joined while the block runs.

    Args:
        device: of training; with `cuda` each process on its machine uses another GPU.

    Raises:
        ValueError: if it is one certain GPU of several processes.
    """
    if not distributed.is_torchelastic_launched():
        yield Processes()
        return
    if device == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    elif device != "cpu":
        raise ValueError(
            f"device is {device!r}, one GPU for all that torchrun starts; say device=cuda, and "
            "each has its own"
        )
    distributed.init_process_group("nccl" if device == "cuda" else "gloo")
    try:
        yield Processes(distributed.get_rank(), distributed.get_world_size())
    finally:
        distributed.destroy_process_group()


def require_one_process(what: str) -> None:
    """
    Raises:
        ValueError: where torchrun started several, naming `what` they cannot do together.
    """
    count = int(os.environ["WORLD_SIZE"]) if distributed.is_torchelastic_launched() else 1
    if count > 1:
        raise ValueError(
            f"torchrun started {count} processes, which train one policy of one seed together; run "
            f"{what} without torchrun"
        )
