"""Figures of studies, image grids with depth in color, and sheets of samples of a corpus."""

import io
from collections.abc import Sequence
from itertools import batched
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.training.corpus.corpus import EXPERT, SOURCES, Corpus

_RED = np.array([0.95, 0.05, 0.05])
_GRAY = 0.35  # of unknown values
_CELL = 2.6  # [in], width of an image


class Panel(NamedTuple):
    """One image of a grid."""

    image: NDArray  # (H, W, 3), 0 to 1
    label: str = ""  # in the lower left corner


class Scale(NamedTuple):
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


_SCALE = 3  # pixels per pixel of an image
_COLUMNS = 4
_NEAR = 0.3  # [m], minimum depth of projected points
_COLORS = ((60, 255, 60), (255, 200, 0), (255, 80, 80))  # RGB of trajectories, cheapest first
_GOAL = (255, 0, 255)


def draw_sheet(corpus: Corpus, out: Path, count: int, seed: int = 0) -> None:
    """Draws `count` random samples into the PNG `out`. Trajectories are green, yellow and red in
    order of cost; a goal ahead is a magenta ring."""
    rng = np.random.default_rng(seed)
    indices = np.sort(rng.choice(len(corpus), min(count, len(corpus)), replace=False))
    samples = corpus.samples(indices)
    camera = corpus.config.camera
    tiles = []
    for i, index in enumerate(indices):
        depth = samples.depth[i].astype(np.float32)
        near = np.where(np.isfinite(depth), np.log1p(depth) / np.log1p(camera.max_depth), 1.0)
        shaded = (255 * colormaps["magma"](1.0 - near)[..., :3]).astype(np.uint8)
        panels = [
            _draw_labels(image, camera, samples.trajectories_B[i], samples.goal_B[i])
            for image in (samples.color[i], shaded)
        ]
        world = corpus.worlds[samples.world[i]].name
        source = "" if samples.source[i] == EXPERT else f", {SOURCES[samples.source[i]]}"
        text = f"{index}: {world}{source}, {np.linalg.norm(samples.v_B[i]):.1f} m/s"
        panels[0][:22] //= 3  # contrast for the text
        cv2.putText(panels[0], text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1)
        tiles.append(np.concatenate(panels))
    columns = min(_COLUMNS, len(tiles))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    rows = [np.concatenate(row, axis=1) for row in batched(tiles, columns)]
    out.parent.mkdir(parents=True, exist_ok=True)
    with written_atomically(out) as path:
        path.write_bytes(cv2.imencode(".png", np.concatenate(rows)[..., ::-1])[1].tobytes())


def _draw_labels(
    image: np.ndarray, camera: OnboardCamera, trajectories_B: np.ndarray, goal_B: np.ndarray
) -> np.ndarray:
    """Enlarges an image (H, W, 3), and draws trajectories (K, 10, 3) [m] and a goal (3,) [m]."""
    image = cv2.resize(image, None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_NEAREST)
    for waypoints_B, color in reversed(list(zip(trajectories_B, _COLORS, strict=False))):
        points = _SCALE * project(camera, waypoints_B[np.isfinite(waypoints_B).all(axis=1)])
        line = np.round(16 * points).astype(np.int32)  # sixteenths of a pixel: shift=4
        cv2.polylines(image, [line[:, None]], False, color, 2, cv2.LINE_AA, shift=4)
        for x, y in np.round(points).astype(int).tolist():
            cv2.circle(image, (x, y), 4, color, -1, cv2.LINE_AA)
    for x, y in np.round(_SCALE * project(camera, 1e3 * goal_B[None])).astype(int).tolist():
        cv2.circle(image, (x, y), 9, _GOAL, 2, cv2.LINE_AA)
    return image


def project(camera: OnboardCamera, p_BQ: np.ndarray) -> np.ndarray:
    """Projects points p_BQ (N, 3) [m] in front of the camera to columns and rows (n, 2) [px]."""
    p_CQ = camera.mount().inverse().multiply(p_BQ.T.astype(float)).reshape(3, -1).T
    p_CQ = p_CQ[p_CQ[:, 2] > _NEAR]
    center = np.array([camera.width, camera.height]) / 2
    focal = np.array([camera.focal_x, camera.focal_y])
    slopes = p_CQ[:, :2] / p_CQ[:, 2:]
    if camera.distortion is not None:
        slopes = camera.distortion.project(slopes)
        slopes = slopes[np.isfinite(slopes[:, 0])]
    return center + focal * slopes
