"""Gaussian scenes and their rendering.

`rasterize` (torch tensors, gsplat's interface) loads torch on first use; nothing else here does.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flysplat.systems.splats.rasterization import rasterize

__all__ = ["rasterize"]


def __getattr__(name: str) -> Any:
    if name == "rasterize":
        from flysplat.systems.splats.rasterization import rasterize

        return rasterize
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
