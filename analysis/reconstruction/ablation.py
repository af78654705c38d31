"""What depth supervision is worth: two representations, with and without it, on held-out frames.

The study of the paper's Table II, over any number of captures.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydrake.common.yaml import yaml_dump_typed

from splatpilot.analysis.reconstruction.figures import (
    Panel,
    colorize,
    depth_scale,
    error_scale,
    mark_floaters,
    write_sheet,
)
from splatpilot.analysis.reconstruction.measure_scene import (
    NAMES,
    SceneMeasures,
    SceneViews,
    format_measure,
    measure_scene,
    read_capture_of,
    read_measures,
)
from splatpilot.diagrams.worlds.scene_metadata import read_scene_metadata
from splatpilot.systems.files import require_writable_folder, written_atomically
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.read_capture import read_capture
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.measures import fit_exposure, floaters, has_true_depth
from splatpilot.training.reconstruction.reconstruct import reconstruct
from splatpilot.training.reconstruction.triangulation import triangulate

COLUMNS = ("psnr_db", "ssim", "lpips", "depth_mae_m", "floater_fraction")
_RECIPE = "reconstruct.yaml"
_ERROR_LIMIT = 0.5  # [m], brightest colour of depth errors


@dataclass(frozen=True)
class Arm:
    """One way to reconstruct, and what the paper found for it on its one scene."""

    key: str
    title: str
    representation: str
    depth: bool
    paper: tuple[float, float, float, float, float]  # in the order of COLUMNS


ARMS = (
    Arm("3dgs", "Vanilla 3DGS", "3dgs", False, (29.35, 0.8706, 0.215, 0.974, 0.115)),
    Arm("2dgs", "Vanilla 2DGS", "2dgs", False, (29.07, 0.8656, 0.228, 1.466, 0.130)),
    Arm("2dgs_depth", "2DGS + depth", "2dgs", True, (28.26, 0.8518, 0.213, 0.212, 0.015)),
    Arm("3dgs_depth", "3DGS + depth (ours)", "3dgs", True, (28.89, 0.8676, 0.184, 0.085, 0.004)),
)


def arm_config(arm: Arm, config: ReconstructConfig) -> ReconstructConfig:
    """Returns how an arm is reconstructed.

    Arms with depth follow `config`. The geometry of photometric arms sees no metric depth at all:
    they start from points triangulated between the images, have no depth term, and add and remove
    Gaussians as Kerbl et al. 2023 do ("default"), which they need where no point is. All arms have
    the same steps, images, losses of colour, largest number of Gaussians, and the same estimate of
    the brightness of each image, which is no geometry. The distance field, which is not measured
    here, is that of the captured depth in all of them.
    """
    config = replace(config, representation=arm.representation, distance_field="captured")
    if arm.depth:
        return replace(config, initialization="depth")
    return replace(config, initialization="points", depth_weight=0.0, strategy="default")


@dataclass(frozen=True)
class AblationResult:
    """The measures of all arms on one capture or more."""

    captures: dict[str, dict[str, SceneMeasures]]  # by name of the capture and key of the arm

    def values(self, arm: Arm, name: str) -> list[float]:
        """Returns a measure of an arm on each capture that has it."""
        found = (measures[arm.key].mean(name) for measures in self.captures.values())
        return [value for value in found if value is not None]

    def verdicts(self) -> list[str]:
        """Returns what depth supervision did to 3DGS and 2DGS on each capture."""
        lines = []
        for name, arms in self.captures.items():
            for plain, ours in (("3dgs", "3dgs_depth"), ("2dgs", "2dgs_depth")):
                before, after = arms[plain], arms[ours]
                gain = (after.mean("psnr_db") or 0) - (before.mean("psnr_db") or 0)
                lines.append(
                    f"{name}, {plain.upper()}: depth supervision divides the depth error by "
                    f"{_ratio(before, after, 'depth_mae_m')} and floaters by "
                    f"{_ratio(before, after, 'floater_fraction')}, PSNR {gain:+.2f} dB"
                )
        return lines

    def table(self) -> list[list[str]]:
        """Returns the table, heading first: each capture, the mean over them, and the paper."""
        rows = [["capture", "arm", *(NAMES[name][0] for name in COLUMNS)]]
        for capture, arms in self.captures.items():
            for arm in ARMS:
                cells = [
                    format_measure(arms[arm.key].mean(name), NAMES[name][1]) for name in COLUMNS
                ]
                rows.append([capture, arm.title, *cells])
        if len(self.captures) > 1:
            for arm in ARMS:
                cells = [_spread(self.values(arm, name), NAMES[name][1]) for name in COLUMNS]
                rows.append(["mean ± spread", arm.title, *cells])
        for arm in ARMS:
            cells = [NAMES[n][1].format(v) for n, v in zip(COLUMNS, arm.paper, strict=True)]
            rows.append(["paper", arm.title, *cells])
        return rows

    def __str__(self) -> str:
        rows = self.table()
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in rows]
        return "\n".join([*lines, "", *self.verdicts()])


def run(captures: Sequence[Path], out: Path, config: ReconstructConfig) -> AblationResult:
    """Reconstructs each capture in four ways, measures them and writes the study to `out`.

    Every arm is a scene folder `out/CAPTURE/ARM`. Arms that are there already, made with the same
    settings, are not made again. `ablation.md` and `ablation.csv` have the table, `CAPTURE.png` the
    arms side by side.

    Raises:
        FileNotFoundError, ValueError, OSError: for a capture that is damaged or has no depth, two
            of one name, settings without held-out frames, arms in `out` made with other settings,
            or a folder that cannot be written.
    """
    config.validate()
    if config.hold_out == 0 or config.iterations == 0:
        raise ValueError(
            f"hold_out is {config.hold_out} and iterations {config.iterations}: an ablation "
            "optimises, and measures on held-out frames; neither may be 0"
        )
    opened = [(path, _open(path, config.capture)) for path in captures]
    names = [capture.name for _, capture in opened]
    for path, capture in opened:
        if not capture.has_depth:
            raise ValueError(f"{path}: has no depth, so neither recipe nor measures can use it")
        if names.count(capture.name) > 1:
            raise ValueError(f"{path}: two captures are called {capture.name}; rename one folder")
    require_writable_folder(out)
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


def _ablate(capture: Capture, out: Path, config: ReconstructConfig) -> dict[str, SceneMeasures]:
    """Makes and measures the arms of one capture that are not there yet."""
    found = {}
    points = capture.points
    for arm in ARMS:
        scene = out / arm.key
        recipe = yaml_dump_typed(arm_config(arm, config)) or ""
        file = scene / _RECIPE
        if file.is_file() and file.read_text() != recipe:
            raise ValueError(
                f"{file}: this arm was made with other settings; choose another --out, or delete "
                f"{scene}"
            )
        if not file.is_file():
            print(f"{capture.name}: {arm.title}")
            seen = capture
            if not arm.depth:
                if points is None:
                    fitted = [i for i in range(len(capture)) if i % config.hold_out]
                    points = triangulate(capture, fitted)
                seen = replace(capture, points=points)
            reconstruct(seen, scene, arm_config(arm, config))
            with written_atomically(file) as partial:
                partial.write_text(recipe)
        found[arm.key] = read_measures(scene) or measure_scene(scene, capture)
    return found


def _write_tables(out: Path, result: AblationResult, config: ReconstructConfig) -> None:
    heading, *rows = result.table()
    lines = [
        "# Reconstruction recipe ablation",
        "",
        f"Every {config.hold_out}th frame held out; {config.iterations} steps; images "
        f"{config.image_width or 'of full'} px wide. The paper's figures are of another scene (its "
        "LPIPS of another network), for the order of the arms.",
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
    writer.writerows(["paper", arm.key, *arm.paper] for arm in ARMS)
    with written_atomically(out / "ablation.csv") as partial:
        partial.write_text(text.getvalue())


def _write_sheet(path: Path, capture: Capture, out: Path, result: AblationResult) -> None:
    """Draws one held-out frame under all arms: the one whose share of floaters in plain 3DGS is the
    median, so neither the best nor the worst."""
    arms = result.captures[capture.name]
    frames = arms["3dgs"].frames
    ordered = sorted(frames, key=lambda i: frames[i].floater_fraction or 0.0)
    i = ordered[len(ordered) // 2]
    order = (ARMS[1], ARMS[0], ARMS[2], ARMS[3])
    scenes = [(arm, SceneViews(out / arm.key, capture)) for arm in order]
    frame = scenes[0][1].frame(i)
    truth, known = frame.image / 255, has_true_depth(frame.depth)
    depths, errors = depth_scale([frame.depth]), error_scale(_ERROR_LIMIT)
    true_depth = Panel(colorize(frame.depth, depths, known))
    rows: list[list[Panel | None]] = [[Panel(truth)], [None], [true_depth], [None]]
    for arm, views in scenes:
        view, found = views.render(frame), arms[arm.key].frames[i]
        image, _ = fit_exposure(view.color, truth, views.metadata.vignetting)
        error = np.abs(view.depth - np.where(known, frame.depth, 0))
        mask = floaters(view.depth, view.alpha, frame.depth)
        fraction, mae = found.floater_fraction or 0.0, found.depth_mae_m or 0.0
        rows[0].append(Panel(image, f"{found.psnr_db:.1f} dB"))
        rows[1].append(Panel(mark_floaters(image, mask), f"{fraction:.1%}"))
        rows[2].append(Panel(colorize(view.depth, depths, view.alpha > 0)))
        rows[3].append(Panel(colorize(error, errors, known), f"{mae:.2f} m"))
    columns = ["captured", "2DGS", "3DGS", "2DGS + depth", "3DGS + depth (ours)"]
    titles = [f"frame {i}", "floaters", "depth", "depth error"]
    write_sheet(path, rows, columns, titles, [None, None, depths, errors])


def _ratio(before: SceneMeasures, after: SceneMeasures, name: str) -> str:
    a, b = before.mean(name), after.mean(name)
    if a is None or b is None:
        return "-"
    return f"{a / b:.1f}" if b > 0 else "infinity"


def _spread(values: Sequence[float], form: str) -> str:
    if not values:
        return "-"
    return f"{form.format(np.mean(values))} ± {form.format(np.std(values, ddof=1))}"
