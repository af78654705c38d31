"""Where tensors live, and whether that is there."""

import ctypes
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager

import torch

_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1
"""Parameters of glibc's `mallopt`, see malloc.h."""
_LARGEST_KEPT = 32 << 20
"""[bytes] The most that glibc takes for the first; larger ones it always asks the system for."""


def require_device(device: str) -> None:
    """
    Raises:
        ValueError: unless torch can compute on a device: `cpu`, or `cuda` or `cuda:1`.
    """
    kind = device.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"device is {device!r}; it must be cpu or cuda")
    if kind == "cuda" and not torch.cuda.is_available():
        built = torch.version.cuda or "the CPU alone"
        raise ValueError(
            f"device is {device!r}, but there is no GPU that this PyTorch, built for {built}, can "
            "use; choose device=cpu, or install a GPU's driver and a PyTorch for it"
        )


def require_renderer(device: str) -> None:
    """
    Raises:
        ValueError: unless Gaussians can be rendered on a device, for which a GPU needs gsplat.
    """
    require_device(device)
    if device.startswith("cuda") and importlib.util.find_spec("gsplat") is None:
        raise ValueError(
            f"device is {device!r}, on which gsplat renders; pip install 'splatpilot[cuda]', or "
            "choose device=cpu"
        )


def keep_freed_memory() -> None:
    """Has this process keep the memory of tensors that are gone for those that come.

    Otherwise glibc gives it back to the system after each pass of a network, and the system clears
    it anew for the next: a fifth of the time of the student's encoder, and more where several
    processes do so. Without effect where the C library is another.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGEST_KEPT)
        mallopt(_TRIM_THRESHOLD, 2**31 - 1)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Has torch compute on one thread while the block lasts: its sums depend on their number."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
