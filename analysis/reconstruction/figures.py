"""Sheets of images for print: rows and columns with labels, depth in colour, floaters in red."""

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

DEPTH_COLORS = "turbo_r"
ERROR_COLORS = "inferno"
_RED = np.array([0.95, 0.05, 0.05])
_DPI = 130
_CELL = 2.6  # [in], width of an image


@dataclass(frozen=True, eq=False)
class Panel:
    """One image of a sheet."""

    image: NDArray  # (H, W, 3), 0 to 1
    label: str = ""
    """Written into the lower left corner."""


@dataclass(frozen=True)
class Scale:
    """What the colours of one row mean."""

    colors: str
    norm: Normalize
    label: str
    ticks: Sequence[float] | None = None


def depth_scale(truths: Sequence[NDArray]) -> Scale:
    """Returns a logarithmic scale for the range of these depths [m], a percent left out."""
    values = np.concatenate([depth[np.isfinite(depth) & (depth > 0)] for depth in truths])
    low, high = np.percentile(values, [1, 99]) if len(values) else (0.1, 1.0)
    norm = LogNorm(low, max(high, 1.01 * low), clip=True)
    ticks = [d * 10.0**k for k in range(-3, 4) for d in (1, 2, 5) if low <= d * 10.0**k <= high]
    return Scale(DEPTH_COLORS, norm, "depth [m]", ticks)


def error_scale(limit: float) -> Scale:
    """Returns a scale from 0 to `limit` [m] for depth errors."""
    return Scale(ERROR_COLORS, Normalize(0, limit, clip=True), "depth error [m]")


def colorize(values: NDArray, scale: Scale, known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns values (H, W) as colours (H, W, 3), grey where they are not known."""
    colors = colormaps[scale.colors](scale.norm(np.where(known, values, 1.0)))[..., :3]
    return np.where(known[..., None], colors, 0.35)


def mark_floaters(image: NDArray, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns the image (H, W, 3), paled, with the pixels of `mask` in red."""
    gray = np.repeat(0.35 + 0.6 * np.mean(image, axis=-1, keepdims=True), 3, axis=-1)
    return np.where(mask[..., None], 0.25 * gray + 0.75 * _RED, gray)


def write_sheet(
    path: Path,
    panels: Sequence[Sequence[Panel | None]],
    columns: Sequence[str],
    rows: Sequence[str],
    scales: Sequence[Scale | None] = (),
) -> None:
    """Writes a grid of panels as PNG, whole or not at all.

    Args:
        path: the file.
        panels: row by row; None leaves a cell empty.
        columns: titles above.
        rows: titles at the left.
        scales: of each row, drawn as a bar at its right; None or left out for none.
    """
    image = next(panel.image for row in panels for panel in row if panel is not None)
    aspect = image.shape[0] / image.shape[1]
    left, right, top, gap = 0.32, 0.75 if any(scales) else 0.05, 0.3, 0.05  # [in]
    width = left + len(columns) * (_CELL + gap) + right
    height = top + len(rows) * (_CELL * aspect + gap)
    figure = Figure(figsize=(width, height), dpi=_DPI)
    for r, row in enumerate(panels):
        bottom = height - top - (r + 1) * _CELL * aspect - r * gap
        for c, panel in enumerate(row):
            if panel is None:
                continue
            x = left + c * (_CELL + gap)
            axes = figure.add_axes(
                (x / width, bottom / height, _CELL / width, _CELL * aspect / height)
            )
            axes.imshow(np.clip(panel.image, 0, 1), interpolation="antialiased", aspect="auto")
            axes.set_axis_off()
            axes.text(
                0.02,
                0.035,
                panel.label,
                transform=axes.transAxes,
                color="white",
                fontsize=10,
                bbox={"facecolor": "black", "alpha": 0.65, "pad": 2.5, "linewidth": 0},
            ).set_visible(bool(panel.label))
        figure.text(
            left / 2 / width,
            (bottom + _CELL * aspect / 2) / height,
            rows[r],
            rotation=90,
            ha="center",
            va="center",
            fontsize=11,
        )
        if scale := scales[r] if r < len(scales) else None:
            x = width - right + 0.04
            axes = figure.add_axes(
                (
                    x / width,
                    (bottom + 0.08) / height,
                    0.12 / width,
                    (_CELL * aspect - 0.16) / height,
                )
            )
            bar = figure.colorbar(
                ScalarMappable(scale.norm, scale.colors), cax=axes, format="%g", ticks=scale.ticks
            )
            bar.ax.minorticks_off()
            bar.set_label(scale.label, fontsize=9, labelpad=2)
            bar.ax.tick_params(labelsize=8)
    for c, title in enumerate(columns):
        x = left + c * (_CELL + gap) + _CELL / 2
        figure.text(x / width, 1 - 0.5 * top / height, title, ha="center", va="center", fontsize=12)
    save(figure, path)


def save(figure: Figure, path: Path) -> None:
    """Writes a figure as PNG, whole or not at all."""
    FigureCanvasAgg(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_atomically(path) as partial:
        figure.savefig(partial)
