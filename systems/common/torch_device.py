"""Checks and settings of torch devices."""

import ctypes
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from splatpilot.systems.common.validation import require

_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1  # parameters of glibc's `mallopt`, see malloc.h
_MAX_THRESHOLD = 32 << 20  # [bytes]


def require_device(device: str) -> None:
    """Raises ValueError unless torch can compute on `cpu`, `cuda` or `cuda:1`."""
    kind = device.partition(":")[0]
    require(kind in ("cpu", "cuda"), "device", "cpu or cuda", repr(device))
    if kind == "cuda" and not torch.cuda.is_available():
        built = torch.version.cuda or "the CPU alone"
        raise ValueError(
            f"device must be cpu, got {device!r}; this PyTorch, built for {built}, finds no GPU: "
            "install a driver and a PyTorch for it"
        )


def require_renderer(device: str) -> None:
    """Raises ValueError unless Gaussians can be rendered on a device; a GPU needs gsplat."""
    require_device(device)
    if device.startswith("cuda") and importlib.util.find_spec("gsplat") is None:
        raise ValueError(
            f"device must be cpu, got {device!r}; to render on it, pip install 'splatpilot[cuda]'"
        )


def keep_freed_memory() -> None:
    """Lets glibc keep freed memory of tensors instead of returning it to the system.

    Has no effect with other C libraries.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _MAX_THRESHOLD)
        mallopt(_TRIM_THRESHOLD, 2**31 - 1)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Limits torch to one thread in the block: sums depend on the number of threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
