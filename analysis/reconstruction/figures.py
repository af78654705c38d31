"""Image grids: rows and columns with titles, depth in color, floaters in red."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from splatpilot.analysis.output import write_png
from splatpilot.systems.splats.background import RenderedView
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.metrics import has_true_depth

_DEPTH_COLORS, _ERROR_COLORS = "turbo_r", "inferno"
_RED = np.array([0.95, 0.05, 0.05])
_GRAY = 0.35  # of unknown values
_CELL = 2.6  # [in], width of an image


@dataclass(frozen=True, eq=False)
class Panel:
    """One image of a grid."""

    image: NDArray  # (H, W, 3), 0 to 1
    label: str = ""
    """In the lower left corner."""


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
    return Scale(_DEPTH_COLORS, norm, "depth [m]", ticks)


def error_scale(limit: float) -> Scale:
    """Returns a scale from 0 to `limit` [m] for depth errors."""
    return Scale(_ERROR_COLORS, Normalize(0, limit, clip=True), "depth error [m]")


def colorize(values: NDArray, scale: Scale, known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns values (H, W) as colors (H, W, 3), gray if not known."""
    colors = colormaps[scale.colors](scale.norm(np.where(known, values, 1.0)))[..., :3]
    return np.where(known[..., None], colors, _GRAY)


def mark_floaters(image: NDArray, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns the image (H, W, 3) in pale gray with the pixels of `mask` in red."""
    gray = np.repeat(0.35 + 0.6 * np.mean(image, axis=-1, keepdims=True), 3, axis=-1)
    return np.where(mask[..., None], 0.25 * gray + 0.75 * _RED, gray)


def depth_panels(
    frame: CaptureFrame, view: RenderedView, depths: Scale, errors: Scale, label: str
) -> list[Panel]:
    """Returns the panels of true depth, rendered depth and its error, with a label."""
    known = has_true_depth(frame.depth)
    error: NDArray = np.abs(view.depth - np.where(known, frame.depth, 0))
    return [
        Panel(colorize(frame.depth, depths, known)),
        Panel(colorize(view.depth, depths, view.alpha > 0)),
        Panel(colorize(error, errors, known), label),
    ]


def write_grid(
    path: Path,
    panels: Sequence[Sequence[Panel | None]],
    columns: Sequence[str],
    rows: Sequence[str],
    scales: Sequence[Scale | None] = (),
) -> None:
    """Writes an image grid as PNG, atomically.

    Args:
        path: of the file.
        panels: row by row; None leaves a cell empty.
        columns: titles above.
        rows: titles at the left.
        scales: of each row, drawn as a bar at its right; None, or a shorter list, for none.
    """
    image = next(panel.image for row in panels for panel in row if panel is not None)
    cell = _CELL * image.shape[0] / image.shape[1]  # [in], height of an image
    left, right, top, gap = 0.32, 0.75 if any(scales) else 0.05, 0.3, 0.05  # [in]
    width = left + len(columns) * (_CELL + gap) + right
    height = top + len(rows) * (cell + gap)
    figure = Figure(figsize=(width, height))

    def add_axes(x: float, y: float, w: float, h: float):  # [in]
        return figure.add_axes((x / width, y / height, w / width, h / height))

    def add_title(x: float, y: float, title: str, size: int, rotation: int = 0) -> None:  # [in]
        style = {"ha": "center", "va": "center", "fontsize": size, "rotation": rotation}
        figure.text(x / width, y / height, title, **style)

    for r, row in enumerate(panels):
        bottom = height - top - (r + 1) * cell - r * gap
        add_title(left / 2, bottom + cell / 2, rows[r], 11, rotation=90)
        for c, panel in enumerate(row):
            if panel is None:
                continue
            axes = add_axes(left + c * (_CELL + gap), bottom, _CELL, cell)
            axes.imshow(np.clip(panel.image, 0, 1), interpolation="antialiased", aspect="auto")
            axes.set_axis_off()
            if panel.label:
                box = {"facecolor": "black", "alpha": 0.65, "pad": 2.5, "linewidth": 0}
                style = {"color": "white", "fontsize": 10, "bbox": box}
                axes.text(0.02, 0.035, panel.label, transform=axes.transAxes, **style)
        if scale := scales[r] if r < len(scales) else None:
            axes = add_axes(width - right + 0.04, bottom + 0.08, 0.12, cell - 0.16)
            colors = ScalarMappable(scale.norm, scale.colors)
            bar = figure.colorbar(colors, cax=axes, format="%g", ticks=scale.ticks)
            bar.ax.minorticks_off()
            bar.set_label(scale.label, fontsize=9, labelpad=2)
            bar.ax.tick_params(labelsize=8)
    for c, title in enumerate(columns):
        add_title(left + c * (_CELL + gap) + _CELL / 2, height - top / 2, title, 12)
    write_png(figure, path)
