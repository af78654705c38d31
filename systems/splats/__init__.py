"""Gaussian scenes and their rendering.

`rasterize` and `rasterize_surfels` (torch tensors, gsplat's interfaces) load torch on first use;
nothing else here does.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatpilot.systems.splats.rasterization import rasterize
    from splatpilot.systems.splats.surfel_rasterization import rasterize_surfels

__all__ = ["rasterize", "rasterize_surfels"]
_MODULES = {"rasterize": "rasterization", "rasterize_surfels": "surfel_rasterization"}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
