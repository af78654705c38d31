"""Figures of the fidelity study: error against offset, and views at growing offset."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from splatpilot.analysis.fidelity.study import FidelityStudy, Sample
from splatpilot.analysis.fidelity.trust import band
from splatpilot.analysis.reconstruction.figures import (
    Panel,
    depth_scale,
    error_scale,
    save,
    write_sheet,
)
from splatpilot.analysis.reconstruction.measure_scene import depth_panels
from splatpilot.analysis.reconstruction.scene_views import SceneViews
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.measures import fit_exposure

_COLUMNS = 6
_ERROR_LIMIT = 0.2  # [m]


def write_curves(path: Path, studies: Sequence[FidelityStudy]) -> None:
    """Draws PSNR and depth errors of each scene against the offset from the path: medians with the
    10th to 90th percentile, the limits, and as a vertical line how far the medians keep them."""
    figure = Figure(figsize=(11, 3.6), dpi=150, layout="constrained")
    axes = figure.subplots(1, 3)
    panels = (
        ("psnr_db", "PSNR [dB]", 1.0),
        ("depth_mae_m", "depth MAE [m]", 1.0),
        ("depth_relative", "relative depth error [%]", 100.0),
    )
    for k, study in enumerate(studies):
        color = colormaps["tab10"](k)
        x = study.column("offset")
        for axis, (name, title, factor) in zip(axes, panels, strict=True):
            y = factor * study.column(name)
            axis.plot(x, y, ".", color=color, alpha=0.4, markersize=5, markeredgewidth=0)
            found = band(x, y)
            axis.fill_between(found.at, found.low, found.high, color=color, alpha=0.2, linewidth=0)
            axis.plot(found.at, found.middle, "o-", color=color, markersize=4, label=study.name)
            axis.axvline(study.reach, color=color, linestyle="--", linewidth=1)
            axis.set_ylabel(title)
        if len(studies) == 1:
            limit = study.on_path_psnr_db - study.max_psnr_drop
            axes[0].axhline(limit, color="black", linestyle=":", linewidth=1)
    axes[2].axhline(100 * studies[0].max_depth_error, color="black", linestyle=":", linewidth=1)
    kinds = {study.kind for study in studies}
    withheld = "distance to the nearest camera kept [m]"
    label = "lateral offset [m]" if kinds == {"rendered"} else withheld
    if len(kinds) > 1:
        label = "offset from the capture path [m]"
    for axis, (name, _, factor) in zip(axes, panels, strict=True):
        axis.set_xlabel(label)
        axis.grid(alpha=0.3)
        axis.set_xlim(left=0)
        if name != "psnr_db":
            top = max(np.percentile(factor * study.column(name), 92) for study in studies)
            axis.set_ylim(0, 1.1 * top)
    axes[0].legend(frameon=False)
    save(figure, path)


def write_views(
    path: Path, views: SceneViews, samples: Sequence[Sample], frames: Sequence[CaptureFrame]
) -> None:
    """Draws views at growing offset: the truth, the scene, its depth and the error of it."""
    order = np.argsort([sample.offset for sample in samples], kind="stable")
    picked = order[np.linspace(0, len(order) - 1, min(_COLUMNS, len(order))).astype(int)]
    depths = depth_scale([frames[k].depth for k in picked])
    errors = error_scale(_ERROR_LIMIT)
    rows: list[list[Panel]] = [[], [], [], []]
    for k in picked:
        frame, view = frames[k], views.render(frames[k])
        truth = frame.image / 255
        image, _ = fit_exposure(view.color, truth, views.metadata.vignetting, frame.valid)
        _, depth, error = depth_panels(frame, view, samples[k].depth_mae_m, depths, errors)
        panels = (Panel(truth), Panel(image, f"{samples[k].psnr_db:.1f} dB"), depth, error)
        for row, panel in zip(rows, panels, strict=True):
            row.append(panel)
    columns = [f"{samples[k].offset:.2f} m" for k in picked]
    titles = ["truth", "scene", "its depth", "depth error"]
    write_sheet(path, rows, columns, titles, [None, None, depths, errors])
