"""How many threads torch itself computes on."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Has torch compute on one thread while the block lasts.

    torch's sums depend on its number of threads, and what little it does beside the renderer, which
    has threads of its own, gains nothing by more.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
