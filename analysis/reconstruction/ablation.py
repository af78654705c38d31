"""Compares reconstructions that use depth more and more, for two representations.

The paper's Table II compares the first and the last step; those between tell apart what changes
from one to the other.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from splatpilot.analysis.reconstruction.figures import (
    Panel,
    colorize,
    depth_scale,
    error_scale,
    mark_floaters,
    write_sheet,
)
from splatpilot.analysis.reconstruction.measure_scene import measure_scene
from splatpilot.analysis.reconstruction.scene_measures import (
    NAMES,
    SceneMetrics,
    SceneViews,
    format_metric,
    read_metrics,
)
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.files import claim_folder, holds_folder, written_atomically
from splatpilot.systems.common.progress import resumable
from splatpilot.systems.common.torch_device import require_renderer
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture, read_capture_of
from splatpilot.training.reconstruction.checkpoint import kept_work
from splatpilot.training.reconstruction.config import HOLD_OUT, ReconstructConfig
from splatpilot.training.reconstruction.initialize import MAX_STEPS, held_out_frames, triangulate
from splatpilot.training.reconstruction.metrics import fit_exposure, floaters, has_true_depth
from splatpilot.training.reconstruction.reconstruct import reconstruct

COLUMNS = (
    "psnr_db",
    "ssim",
    "lpips",
    "depth_mae_m",
    "floater_fraction",
    "hole_fraction",
    "psnr_on_black_db",
)


STEPS = {
    "points": "from points, photometric",
    "depth_start": "from depth, photometric",
    "surfaces": "+ surface and outline losses",
    "depth_term": "+ depth term",
}
"""Titles of the steps from one arm of a representation to the next, by the end of its key."""

_PAPER = {
    "3dgs_points": (29.35, 0.8706, 0.215, 0.974, 0.115),
    "2dgs_points": (29.07, 0.8656, 0.228, 1.466, 0.130),
    "2dgs_depth_term": (28.26, 0.8518, 0.213, 0.212, 0.015),
    "3dgs_depth_term": (28.89, 0.8676, 0.184, 0.085, 0.004),
}
"""The paper's figures for its one scene, in the order of the first of COLUMNS: of its vanilla and
its "+ depth" arms, whose initialization it does not state."""


@dataclass(frozen=True)
class Arm:
    """One way to reconstruct: a representation, and the last of the `STEPS` that it takes."""

    representation: str
    step: str

    @property
    def key(self) -> str:
        """The name of its folder."""
        return f"{self.representation}_{self.step}"

    @property
    def title(self) -> str:
        """Its name in tables."""
        return f"{self.representation.upper()} {STEPS[self.step]}"


ARMS = tuple(Arm(representation, step) for representation in ("3dgs", "2dgs") for step in STEPS)


@dataclass(frozen=True)
class AblationResult:
    """The measures of all arms on one capture or more."""

    captures: dict[str, dict[str, SceneMetrics]]  # by name of the capture and key of the arm

    def values(self, arm: Arm, name: str) -> list[float]:
        """Returns a measure of an arm on each capture that has it."""
        found = (measures[arm.key].mean(name) for measures in self.captures.values())
        return [value for value in found if value is not None]

    def verdicts(self) -> list[str]:
        """Returns what each step did to the arm before it on each capture."""
        lines = []
        for name, arms in self.captures.items():
            for plain, other in pairwise(ARMS):
                if plain.representation != other.representation:
                    continue
                before, after = arms[plain.key], arms[other.key]
                gain = (after.mean("psnr_db") or 0) - (before.mean("psnr_db") or 0)
                lines.append(
                    f"{name}, {other.title}: depth error divided by "
                    f"{_ratio(before, after, 'depth_mae_m')}, floaters by "
                    f"{_ratio(before, after, 'floater_fraction')}, PSNR {gain:+.2f} dB"
                )
        return lines

    def table(self) -> list[list[str]]:
        """Returns the table, heading first: each capture, the mean over them, and the paper."""
        rows = [["capture", "arm", *(NAMES[name][0] for name in COLUMNS)]]
        for capture, arms in self.captures.items():
            for arm in ARMS:
                cells = [
                    format_metric(arms[arm.key].mean(name), NAMES[name][1]) for name in COLUMNS
                ]
                rows.append([capture, arm.title, *cells])
        if len(self.captures) > 1:
            for arm in ARMS:
                cells = [_spread(self.values(arm, name), NAMES[name][1]) for name in COLUMNS]
                rows.append(["mean ± spread", arm.title, *cells])
        for arm, known in paper_rows():
            cells = [format_metric(known.get(name), NAMES[name][1]) for name in COLUMNS]
            rows.append(["paper", arm.title, *cells])
        return rows

    def __str__(self) -> str:
        rows = self.table()
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in rows]
        return "\n".join([*lines, "", *self.verdicts()])


def paper_rows() -> list[tuple[Arm, dict[str, float]]]:
    """Returns the arms of the paper with its figures by column."""
    return [
        (arm, dict(zip(COLUMNS, _PAPER[arm.key], strict=False)))
        for arm in ARMS
        if arm.key in _PAPER
    ]


def _ratio(before: SceneMetrics, after: SceneMetrics, name: str) -> str:
    a, b = before.mean(name), after.mean(name)
    if a is None or b is None:
        return "-"
    return f"{a / b:.1f}" if b > 0 else "infinity"


def _spread(values: Sequence[float], form: str) -> str:
    if not values:
        return "-"
    return f"{form.format(np.mean(values))} ± {form.format(np.std(values, ddof=1))}"


_RECIPE = "reconstruct.yaml"
_ERROR_LIMIT = 0.5  # [m], brightest colour of depth errors
_NO_DEPTH_LOSSES = {"depth_weight": 0.0, "surface_weight": 0.0, "outline_weight": 0.0}
_SETTINGS = {
    "points": {"initialization": "points", "strategy": "default", **_NO_DEPTH_LOSSES},
    "depth_start": {"initialization": "depth", **_NO_DEPTH_LOSSES},
    "surfaces": {"initialization": "depth", "depth_weight": 0.0},
    "depth_term": {"initialization": "depth"},
}
"""Settings of each step that depart from the configuration of the study."""


@dataclass
class AblationStudy:
    """The content of `ablation.yaml`: which study a folder holds."""

    # Folders of the captures.
    captures: list[str] = field(default_factory=list)
    # How the arms are reconstructed, except for what makes them arms.
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)


def arm_config(arm: Arm, config: ReconstructConfig) -> ReconstructConfig:
    """Returns how an arm is reconstructed.

    The last arm of each representation follows `config`; that before it differs in `depth_weight`
    alone, and so isolates the paper's equation 2. The first sees no metric depth at all: it starts
    from points triangulated between the images and adds and removes Gaussians as Kerbl et al. 2023
    do ("default"), which it needs where no point is. The second starts from depth instead, and so
    has the strategy, the learning rates and the scale limits that go with that. All arms have the
    same steps, images, color losses, largest number of Gaussians, and the same estimate of the
    brightness of each image. The distance field, which is not measured here, is that of the
    captured depth in all of them.
    """
    return replace(
        config,
        representation=arm.representation,
        distance_field="captured",
        **_SETTINGS[arm.step],
    )


@holds_folder("out")
def run(
    captures: Sequence[Path], out: Path, config: ReconstructConfig, overwrite: bool = False
) -> AblationResult:
    """Reconstructs each capture in every arm, measures them and writes the study to `out`.

    Every arm is a scene folder `out/CAPTURE/ARM`. Arms that are there already, made of the same
    capture with the same settings, are not made again. `ablation.md` and `ablation.csv` have the
    table, `CAPTURE.png` the arms side by side, `ablation.yaml` which study it is; with `overwrite`
    it takes the place of another one in `out`.

    Raises:
        FileNotFoundError, ValueError, OSError: for a capture that is damaged or has no depth, two
            of one name, settings without held-out frames, something else in `out`, or a folder that
            cannot be written.
    """
    config.validate()
    require_renderer(config.device)
    if config.hold_out == 0 or config.iterations == 0:
        raise ValueError(
            f"hold_out is {config.hold_out} and iterations {config.iterations}: an ablation "
            "optimises, and measures on held-out frames; neither may be 0"
        )
    if config.iterations < 0:  # all arms take the same
        config = replace(config, iterations=MAX_STEPS)
    opened = [(path, _open(path, config.capture)) for path in captures]
    names = [capture.name for _, capture in opened]
    for path, capture in opened:
        if not capture.has_depth:
            raise ValueError(f"{path}: has no depth, so neither recipe nor measures can use it")
        if names.count(capture.name) > 1:
            raise ValueError(f"{path}: two captures are called {capture.name}; rename one folder")
    study = AblationStudy([str(path.resolve()) for path in captures], config)
    claim_folder(out / "ablation.yaml", study, overwrite)
    with resumable(lambda: f"arms that are finished are in {out}; the same command resumes"):
        result = AblationResult(
            {capture.name: _ablate(capture, out / capture.name, config) for _, capture in opened}
        )
    for _, capture in opened:
        _write_sheet(out / f"{capture.name}.png", capture, out / capture.name, result)
    _write_tables(out, result, config)
    print(result)
    return result


def _open(path: Path, config: CaptureConfig) -> Capture:
    """Opens a capture, or the one that a scene folder was made from."""
    if (path / "scene.yaml").is_file():
        return read_capture_of(path, read_scene_metadata(path))
    return read_capture(path, config)


def _ablate(capture: Capture, out: Path, config: ReconstructConfig) -> dict[str, SceneMetrics]:
    """Makes and measures the arms of one capture that are not there yet."""
    found = {}
    points = capture.points
    for arm in ARMS:
        scene = out / arm.key
        recipe = f"capture: {capture.folder}\n{dump_config(arm_config(arm, config))}"
        file = scene / _RECIPE
        if not file.is_file() or file.read_text() != recipe:
            print(f"{capture.name}: {arm.title}", flush=True)
            seen = capture
            if arm.step == "points":
                if points is None:
                    held_out = held_out_frames(capture, config)
                    fitted = [i for i in range(len(capture)) if i not in held_out]
                    points = triangulate(capture, fitted)
                seen = replace(capture, points=points)
            with resumable(partial(kept_work, scene)):
                reconstruct(seen, scene, arm_config(arm, config))
            with written_atomically(file) as written:
                written.write_text(recipe)
        found[arm.key] = read_metrics(scene) or measure_scene(scene, capture)
    return found


def _write_tables(out: Path, result: AblationResult, config: ReconstructConfig) -> None:
    heading, *rows = result.table()
    held_out = f"Every {config.hold_out}th frame"
    if config.hold_out < 0:
        held_out = f"Frames that the files hold out, or every {HOLD_OUT}th,"
    lines = [
        "# Reconstruction recipe ablation",
        "",
        f"{held_out} held out; {config.iterations} steps; images "
        f"{config.image_width or 'of full'} px wide. The paper's figures are of another scene (its "
        "LPIPS of another network), and of recipes without surface and outline losses.",
        "",
        "| " + " | ".join(heading) + " |",
        "|" + "---|" * len(heading),
        *("| " + " | ".join(row) + " |" for row in rows),
        "",
        *(f"- {line}" for line in result.verdicts()),
        "",
        *(f"![{name}]({name}.png)" for name in result.captures),
        "",
    ]
    with written_atomically(out / "ablation.md") as partial:
        partial.write_text("\n".join(lines))
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["capture", "arm", *COLUMNS])
    for name, arms in result.captures.items():
        writer.writerows(
            [name, arm.key, *(arms[arm.key].mean(column) for column in COLUMNS)] for arm in ARMS
        )
    writer.writerows(["paper", arm.key, *known.values()] for arm, known in paper_rows())
    with written_atomically(out / "ablation.csv") as partial:
        partial.write_text(text.getvalue())


def _write_sheet(path: Path, capture: Capture, out: Path, result: AblationResult) -> None:
    """Draws one held-out frame under the arms that the paper has: the one whose share of floaters
    in 3DGS from points is the median, so neither the best nor the worst."""
    arms = result.captures[capture.name]
    frames = arms["3dgs_points"].frames
    ordered = sorted(frames, key=lambda i: frames[i].floater_fraction or 0.0)
    i = ordered[len(ordered) // 2]
    of_paper = (arm for arm, _ in paper_rows())
    drawn = sorted(of_paper, key=lambda arm: (arm.step != "points", arm.key))
    scenes = {arm.key: SceneViews(out / arm.key, capture) for arm in drawn}
    frame = scenes[drawn[0].key].frame(i)
    truth, known = frame.image / 255, has_true_depth(frame.depth)
    depths, errors = depth_scale([frame.depth]), error_scale(_ERROR_LIMIT)
    true_depth = Panel(colorize(frame.depth, depths, known))
    rows: list[list[Panel | None]] = [[Panel(truth)], [None], [true_depth], [None]]
    for key, views in scenes.items():
        view, found = views.render(frame), arms[key].frames[i]
        image, _ = fit_exposure(view.color, truth, views.metadata.vignetting, frame.valid)
        error = np.abs(view.depth - np.where(known, frame.depth, 0))
        mask = floaters(view.depth, frame.depth)
        fraction, mae = found.floater_fraction or 0.0, found.depth_mae_m or 0.0
        rows[0].append(Panel(image, format_metric(found.psnr_db, "{:.1f} dB")))
        rows[1].append(Panel(mark_floaters(image, mask), f"{fraction:.1%}"))
        rows[2].append(Panel(colorize(view.depth, depths, view.alpha > 0)))
        rows[3].append(Panel(colorize(error, errors, known), f"{mae:.2f} m"))
    columns = ["captured", *(arm.title.partition(",")[0] for arm in drawn)]
    titles = [f"frame {i}", "floaters", "depth", "depth error"]
    write_sheet(path, rows, columns, titles, [None, None, depths, errors])
