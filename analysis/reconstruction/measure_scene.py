"""A scene folder measured on frames of its capture that had no part in making it."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatpilot.analysis.reconstruction.figures import (
    Panel,
    Scale,
    colorize,
    depth_scale,
    error_scale,
    write_sheet,
)
from splatpilot.analysis.reconstruction.scene_measures import (
    METRICS,
    SceneMetrics,
    SceneViews,
    format_metric,
    unseen_share,
)
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.systems.common.files import require_unused, written_atomically
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.splats.baked_scene import RenderedView
from splatpilot.training.captures.capture import Capture, CaptureFrame
from splatpilot.training.reconstruction.lpips import Lpips
from splatpilot.training.reconstruction.metrics import fit_exposure, has_true_depth

SHEET = "views.png"
_SHEET_ROWS = 4
_ERROR_LIMIT = 0.05  # brightest colour of depth errors, as a fraction of the median depth


def load_lpips() -> tuple[Lpips | None, str]:
    """Returns the network, or None and why there is none."""
    try:
        return Lpips(), ""
    except (OSError, ValueError) as error:
        return None, str(error)


def measure_scene(scene: Path, capture: Capture | None = None) -> SceneMetrics:
    """Measures a scene folder and leaves `metrics.json` and the sheet `views.png` in it.

    It is measured on the held-out frames; if none was held out, on every eighth frame, which says
    less: those had a part in making it.

    Raises:
        FileNotFoundError, ValueError, OSError: for a damaged scene or capture, or a folder that
            cannot be written.
    """
    views = SceneViews(scene, capture)
    lpips, missing = load_lpips()
    frames, strict, size = {}, {}, (0, 0)
    for i in Progress(views.measured, "measuring frames", unit="frame"):
        frame = views.frame(i)
        size = frame.depth.shape
        frames[i] = views.measure(frame, views.seen(frame), lpips)
        strict[i] = views.measure(frame, lpips=lpips, fit_gain=False)
    height, width = size
    held_out, unseen = bool(views.metadata.held_out), unseen_share(scene)
    measures = SceneMetrics(held_out, width, height, frames, strict, missing, unseen)
    _write_views(scene / SHEET, views, measures)
    with written_atomically(scene / METRICS) as partial:  # Last: it says that all is there.
        partial.write_text(json.dumps(measures.as_json(), indent=2))
    return measures


def run(scene: Path, overwrite: bool = False) -> SceneMetrics:
    """Measures a scene folder, see `measure_scene`, and prints what it is and the table.

    Raises:
        FileExistsError: if it has been measured, and that is not to be overwritten.
        FileNotFoundError, ValueError, OSError: see `measure_scene`.
    """
    require_unused(scene / METRICS, overwrite)
    metadata = read_scene_metadata(scene)
    measures = measure_scene(scene)
    if metadata.provenance:
        print(f"{'made from':<22} {metadata.provenance}")
    print(f"{'seen free [m^3]':<22} {metadata.observed_free_volume:.1f}")
    if metadata.gains:
        low, high = min(metadata.gains), max(metadata.gains)
        print(f"{'image gains':<22} {low:.3f} to {high:.3f}")
    print(measures)
    return measures


def _write_views(path: Path, views: SceneViews, measures: SceneMetrics) -> None:
    """Draws some of the frames: truth and scene, in colour and depth."""
    numbers = list(measures.frames)
    picked = sorted({numbers[k] for k in np.linspace(0, len(numbers) - 1, _SHEET_ROWS).astype(int)})
    frames = [views.frame(i) for i in picked]
    seen = [views.render(frame) for frame in frames]
    true = [frame.depth for frame in frames if has_true_depth(frame.depth).any()]
    depths = depth_scale(true or [view.depth for view in seen])
    middle = np.median([np.median(frame.depth) for frame in frames])
    errors = error_scale(_ERROR_LIMIT * float(middle) if 0 < middle < np.inf else 0.1)
    rows = []
    for i, frame, view in zip(picked, frames, seen, strict=True):
        found = measures.frames[i]
        vignetting = views.metadata.vignetting
        image, _ = fit_exposure(view.color, frame.image / 255, vignetting, frame.valid)
        label = format_metric(found.psnr_db, "{:.1f} dB")
        row = [Panel(frame.image / 255), Panel(image, label)]
        rows.append(row + depth_panels(frame, view, found.depth_mae_m, depths, errors))
    columns = ["captured", "scene", "captured depth", "depth of the scene", "depth error"]
    scales = [depths] + [errors] * (len(rows) - 1)
    if not true:
        shown = 0, 1, 3
        columns = [columns[k] for k in shown]
        rows = [[row[k] for k in shown] for row in rows]
        scales = [depths]
    write_sheet(path, rows, columns, [f"frame {i}" for i in picked], scales)


def depth_panels(
    frame: CaptureFrame,
    view: RenderedView,
    depth_mae_m: float | None,
    depths: Scale,
    errors: Scale,
) -> list[Panel]:
    """Returns the panels of true depth, rendered depth and the difference."""
    known = has_true_depth(frame.depth)
    error: NDArray = np.abs(view.depth - np.where(known, frame.depth, 0))
    return [
        Panel(colorize(frame.depth, depths, known)),
        Panel(colorize(view.depth, depths, view.alpha > 0)),
        Panel(
            colorize(error, errors, known),
            "" if depth_mae_m is None else f"{100 * depth_mae_m:.1f} cm",
        ),
    ]
