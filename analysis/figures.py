"""Figures of studies, and image grids: titles, depth in color, floaters in red."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from splatpilot.systems.common.files import written_atomically

_RED = np.array([0.95, 0.05, 0.05])
_GRAY = 0.35  # of unknown values
_CELL = 2.6  # [in], width of an image


@dataclass(frozen=True, eq=False)
class Panel:
    """One image of a grid."""

    image: NDArray  # (H, W, 3), 0 to 1
    label: str = ""  # in the lower left corner


@dataclass(frozen=True)
class Scale:
    """Color scale of a row."""

    colors: str
    norm: Normalize
    label: str
    ticks: Sequence[float] | None = None


def depth_scale(truths: Sequence[NDArray]) -> Scale:
    """Returns a logarithmic scale for the 1st to 99th percentile of these depths [m]."""
    values = np.concatenate([depth[np.isfinite(depth) & (depth > 0)] for depth in truths])
    low, high = np.percentile(values, [1, 99]) if len(values) else (0.1, 1.0)
    norm = LogNorm(low, max(high, 1.01 * low), clip=True)
    ticks = [d * 10.0**k for k in range(-3, 4) for d in (1, 2, 5) if low <= d * 10.0**k <= high]
    return Scale("turbo_r", norm, "depth [m]", ticks)


def error_scale(limit: float) -> Scale:
    """Returns a scale from 0 to `limit` [m] for depth errors."""
    return Scale("inferno", Normalize(0, limit, clip=True), "depth error [m]")


def mark_floaters(image: NDArray, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns the image (H, W, 3) in pale gray with the pixels of `mask` in red."""
    gray = np.repeat(0.35 + 0.6 * np.mean(image, axis=-1, keepdims=True), 3, axis=-1)
    return np.where(mask[..., None], 0.25 * gray + 0.75 * _RED, gray)


def colorize(values: NDArray, scale: Scale, known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns the colors (H, W, 3) of values (H, W), gray if they are not known."""
    colors = colormaps[scale.colors](scale.norm(np.where(known, values, 1.0)))[..., :3]
    return np.where(known[..., None], colors, _GRAY)


def write_grid(
    path: Path,
    panels: Sequence[Sequence[Panel | None]],
    columns: Sequence[str],
    rows: Sequence[str],
    scales: Sequence[Scale | None] = (),
) -> None:
    """Writes an image grid as PNG, atomically: rows of panels, or None for an empty cell, with
    titles of columns and rows, and color bars of the rows that have a scale."""
    image = next(panel.image for row in panels for panel in row if panel is not None)
    cell = _CELL * image.shape[0] / image.shape[1]  # [in], height of an image
    size = (_CELL + 0.1) * len(columns) + 1, (cell + 0.1) * len(rows) + 0.4
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(rows), len(columns), squeeze=False)
    box = {"facecolor": "black", "alpha": 0.65, "pad": 2.5, "linewidth": 0}
    for r, row in enumerate(panels):
        for axes, panel in zip(grid[r], row, strict=True):
            axes.set(xticks=[], yticks=[], frame_on=False)
            if panel is not None:
                axes.imshow(np.clip(panel.image, 0, 1), interpolation="antialiased")
                style = {"color": "white", "fontsize": 10, "bbox": box if panel.label else None}
                axes.text(0.02, 0.035, panel.label, transform=axes.transAxes, **style)
        grid[r, 0].set_ylabel(rows[r], fontsize=11)
        if scale := scales[r] if r < len(scales) else None:
            colors = ScalarMappable(scale.norm, scale.colors)
            bar = figure.colorbar(colors, ax=list(grid[r]), format="%g", ticks=scale.ticks)
            bar.ax.minorticks_off()
            bar.set_label(scale.label, fontsize=9)
            bar.ax.tick_params(labelsize=8)
    for axes, title in zip(grid[0], columns, strict=True):
        axes.set_title(title, fontsize=12)
    write_png(figure, path)


def write_png(figure: Figure, path: Path, dpi: int = 130) -> bytes:
    """Writes a figure as PNG, atomically, and returns the bytes, which are deterministic."""
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_atomically(path) as partial:
        partial.write_bytes(buffer.getvalue())
    return buffer.getvalue()
