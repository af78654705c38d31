"""Gaussian scenes and their rendering.

`rasterize` and `rasterize_surfels` (torch tensors, gsplat's interfaces) load torch on first use;
nothing else here does.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatpilot.systems.splats.rasterization import rasterize
    from splatpilot.systems.splats.surfel_rasterization import rasterize_surfels

__all__ = ["rasterize", "rasterize_surfels"]


def __getattr__(name: str) -> Any:
    if name == "rasterize":
        from splatpilot.systems.splats.rasterization import rasterize

        return rasterize
    if name == "rasterize_surfels":
        from splatpilot.systems.splats.surfel_rasterization import rasterize_surfels

        return rasterize_surfels
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
