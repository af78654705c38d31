"""Ablation of depth in reconstruction, the paper's Table II, with steps between its arms."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from splatpilot.analysis import figures
from splatpilot.analysis.reconstruction.measure_scene import (
    NAMES,
    SceneMetrics,
    SceneViews,
    format_metric,
    measure_scene,
    read_metrics,
)
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.files import claim_folder, locks_folder, write_csv, write_text
from splatpilot.systems.common.processes import require_renderer
from splatpilot.systems.common.progress import resumable
from splatpilot.systems.common.validation import require
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_registry import read_capture, read_scene_capture
from splatpilot.training.captures.photographs import triangulate
from splatpilot.training.reconstruction.checkpoint import kept_work
from splatpilot.training.reconstruction.config import HOLD_OUT, ReconstructConfig
from splatpilot.training.reconstruction.initialize import MAX_STEPS, held_out_frames
from splatpilot.training.reconstruction.metrics import floaters
from splatpilot.training.reconstruction.reconstruct import reconstruct

COLUMNS = ("psnr_db", "ssim", "lpips", "depth_mae_m")
COLUMNS += ("floater_fraction", "hole_fraction", "psnr_on_black_db")
_FROM_DEPTH: dict[str, Any] = {"initialization": "depth"}
_NO_DEPTH_LOSSES = {"depth_weight": 0.0, "surface_weight": 0.0, "outline_weight": 0.0}
_STEPS: dict[str, tuple[str, dict[str, Any]]] = {
    "points": (
        "from points, photometric",
        {"initialization": "points", "strategy": "default", **_NO_DEPTH_LOSSES},
    ),
    "depth_start": ("from depth, photometric", _FROM_DEPTH | _NO_DEPTH_LOSSES),
    "surfaces": ("+ surface and outline losses", _FROM_DEPTH | {"depth_weight": 0.0}),
    "depth_term": ("+ depth term", _FROM_DEPTH),
}
"""Titles of the steps from one arm of a representation to the next, and the settings of the arm
that differ from the study's."""
_RECIPE = "reconstruct.yaml"
_ERROR_LIMIT = 0.5  # [m], brightest color of depth errors


@dataclass(frozen=True)
class Arm:
    """A representation and the last of the `_STEPS` that it takes."""

    representation: str
    step: str

    @property
    def key(self) -> str:
        """Name of the folder."""
        return f"{self.representation}_{self.step}"

    @property
    def title(self) -> str:
        """Name in tables."""
        return f"{self.representation.upper()} {_STEPS[self.step][0]}"


ARMS = tuple(Arm(representation, step) for representation in ("3dgs", "2dgs") for step in _STEPS)
PAPER = {
    Arm("3dgs", "points"): (29.35, 0.8706, 0.215, 0.974, 0.115, None, None),
    Arm("3dgs", "depth_term"): (28.89, 0.8676, 0.184, 0.085, 0.004, None, None),
    Arm("2dgs", "points"): (29.07, 0.8656, 0.228, 1.466, 0.130, None, None),
    Arm("2dgs", "depth_term"): (28.26, 0.8518, 0.213, 0.212, 0.015, None, None),
}
"""The paper's vanilla and "+ depth" results by `COLUMNS`; their initialization is not stated."""


@dataclass(frozen=True)
class AblationResult:
    """The metrics of all arms."""

    captures: dict[str, dict[str, SceneMetrics]]  # by name of the capture and key of the arm

    def verdicts(self) -> list[str]:
        """Returns the effect of each step on each capture."""
        lines = []
        for name, arms in self.captures.items():
            same = (p for p in pairwise(ARMS) if p[0].representation == p[1].representation)
            for plain, other in same:
                before, after = arms[plain.key], arms[other.key]
                gain = (after.mean("psnr_db") or 0) - (before.mean("psnr_db") or 0)
                lines.append(
                    f"{name}, {other.title}: depth error divided by "
                    f"{_ratio(before, after, 'depth_mae_m')}, floaters by "
                    f"{_ratio(before, after, 'floater_fraction')}, PSNR {gain:+.2f} dB"
                )
        return lines

    def table(self) -> list[list[str]]:
        """Returns the header and the rows of each capture, of their mean, and of the paper."""
        rows = [["capture", "arm", *(NAMES[name][0] for name in COLUMNS)]]

        def add(source: str, arm: Arm, values: Sequence[float | None]) -> None:
            pairs = zip(values, COLUMNS, strict=True)
            rows.append([source, arm.title, *(format_metric(v, NAMES[n][1]) for v, n in pairs)])

        for capture, arms in self.captures.items():
            for arm in ARMS:
                add(capture, arm, [arms[arm.key].mean(name) for name in COLUMNS])
        if len(self.captures) > 1:
            for arm in ARMS:
                rows.append(["mean ± spread", arm.title, *(self._spread(arm, n) for n in COLUMNS)])
        for arm, values in PAPER.items():
            add("paper", arm, values)
        return rows

    def _spread(self, arm: Arm, name: str) -> str:
        found = (metrics[arm.key].mean(name) for metrics in self.captures.values())
        values, form = [value for value in found if value is not None], NAMES[name][1]
        if not values:
            return "-"
        return f"{form.format(np.mean(values))} ± {form.format(np.std(values, ddof=1))}"

    def __str__(self) -> str:
        rows = self.table()
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in rows]
        return "\n".join([*lines, "", *self.verdicts()])


def _ratio(before: SceneMetrics, after: SceneMetrics, name: str) -> str:
    a, b = before.mean(name), after.mean(name)
    if a is None or b is None:
        return "-"
    return f"{a / b:.1f}" if b > 0 else "infinity"


@dataclass
class AblationStudy:
    """The content of `ablation.yaml`."""

    captures: list[str] = field(default_factory=list)  # folders
    # Settings of the arms, apart from their own.
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)


def arm_config(arm: Arm, config: ReconstructConfig) -> ReconstructConfig:
    """Returns the settings of an arm, with the same steps, images and photometry. The first of a
    representation uses metric depth only for the smallest size of Gaussians."""
    own = {"representation": arm.representation, "distance_field": "captured"}
    return replace(config, **own, **_STEPS[arm.step][1])


@locks_folder("out")
def run(
    captures: Sequence[Path], out: Path, config: ReconstructConfig, overwrite: bool = False
) -> AblationResult:
    """Reconstructs and measures each capture in every arm, as a scene folder `out/CAPTURE/ARM`, and
    writes `ablation.md`, `ablation.csv`, `ablation.yaml` and an image grid of each capture."""
    config.validate()
    require_renderer(config.device)
    require(config.hold_out != 0, "hold_out", "not 0, to measure", config.hold_out)
    require(config.iterations != 0, "iterations", "not 0, to compare losses", config.iterations)
    if config.iterations < 0:  # all arms take the same
        config = replace(config, iterations=MAX_STEPS)
    opened: list[Capture] = []
    for path in captures:
        if (path / "scene.yaml").is_file():
            capture = read_scene_capture(path, read_scene_metadata(path))
        else:
            capture = read_capture(path, config.capture)
        if not capture.has_depth:
            raise ValueError(f"{path}: has no depth, which losses and metrics need")
        if capture.name in {other.name for other in opened}:
            raise ValueError(f"{path}: two captures are called {capture.name}; rename one folder")
        opened.append(capture)
    study = AblationStudy([str(path.resolve()) for path in captures], config)
    claim_folder(out / "ablation.yaml", study, overwrite)
    with resumable(lambda: f"arms that are finished are in {out}; the same command resumes"):
        result = AblationResult(
            {each.name: _ablate(each, out / each.name, config) for each in opened}
        )
    for capture in opened:
        _write_grid(out / f"{capture.name}.png", capture, out / capture.name, result)
    _write_tables(out, result, config)
    print(result)
    return result


def _ablate(capture: Capture, out: Path, config: ReconstructConfig) -> dict[str, SceneMetrics]:
    found = {}
    points = capture.points
    for arm in ARMS:
        scene = out / arm.key
        recipe = f"capture: {capture.folder}\ncameras: {capture.camera_digest()}\n"
        recipe += dump_config(arm_config(arm, config))
        file = scene / _RECIPE
        if not file.is_file() or file.read_text() != recipe:
            print(f"{capture.name}: {arm.title}", flush=True)
            if arm.step == "points" and points is None:
                held_out = held_out_frames(capture, config)
                points = triangulate(capture, [i for i in range(len(capture)) if i not in held_out])
            source = replace(capture, points=points) if arm.step == "points" else capture
            with resumable(partial(kept_work, scene)):
                reconstruct(source, scene, arm_config(arm, config))
            write_text(file, recipe)
        found[arm.key] = read_metrics(scene) or measure_scene(scene, capture)
    return found


def _write_tables(out: Path, result: AblationResult, config: ReconstructConfig) -> None:
    header, *rows = result.table()
    held_out = f"Every {config.hold_out}th frame"
    if config.hold_out < 0:
        held_out = f"Frames that the files hold out, or every {HOLD_OUT}th,"
    lines = [
        "# Reconstruction recipe ablation",
        "",
        f"{held_out} held out; {config.iterations} steps; images "
        f"{config.image_width or 'of full'} px wide. The paper's metrics are of another scene (its "
        "LPIPS of another network), and of recipes without surface and outline losses.",
        "",
        "| " + " | ".join(header) + " |",
        "|" + "---|" * len(header),
        *("| " + " | ".join(row) + " |" for row in rows),
        "",
        *(f"- {line}" for line in result.verdicts()),
        "",
        *(f"![{name}]({name}.png)" for name in result.captures),
        "",
    ]
    write_text(out / "ablation.md", "\n".join(lines))
    table = [
        {"capture": name, "arm": arm.key, **{n: arms[arm.key].mean(n) for n in COLUMNS}}
        for name, arms in result.captures.items()
        for arm in ARMS
    ]
    for arm, values in PAPER.items():
        known = {n: v for n, v in zip(COLUMNS, values, strict=True) if v is not None}
        table.append({"capture": "paper", "arm": arm.key, **known})
    write_csv(out / "ablation.csv", table)


def _write_grid(path: Path, capture: Capture, out: Path, result: AblationResult) -> None:
    """Writes the image grid of the frame of median floaters in 3DGS from points."""
    arms = result.captures[capture.name]
    frames = arms["3dgs_points"].frames
    ordered = sorted(frames, key=lambda i: frames[i].floater_fraction or 0.0)
    i = ordered[len(ordered) // 2]
    drawn = sorted(PAPER, key=lambda arm: (arm.step != "points", arm.key))
    depths, errors = None, figures.error_scale(_ERROR_LIMIT)
    rows: list[list[figures.Panel | None]] = []
    for arm in drawn:
        views = SceneViews(out / arm.key, capture)
        frame, found = views.frame(i), arms[arm.key].frames[i]
        depths = depths or figures.depth_scale([frame.depth])
        labels = format_metric(found.psnr_db, "{:.1f} dB"), f"{found.depth_mae_m or 0.0:.2f} m"
        truth, image, true_depth, *depth = views.panels(frame, depths, errors, labels)
        if not rows:
            rows = [[truth], [None], [true_depth], [None]]
        marked = figures.mark_floaters(
            image.image, floaters(views.render(frame).depth, frame.depth)
        )
        panels = image, figures.Panel(marked, f"{found.floater_fraction or 0.0:.1%}"), *depth
        for row, panel in zip(rows, panels, strict=True):
            row.append(panel)
    columns = ["captured", *(arm.title.partition(",")[0] for arm in drawn)]
    titles = [f"frame {i}", "floaters", "depth", "depth error"]
    figures.write_grid(path, rows, columns, titles, [None, None, depths, errors])
