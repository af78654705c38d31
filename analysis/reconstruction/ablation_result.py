"""What the ablation compares, and its table."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatpilot.analysis.reconstruction.scene_measures import (
    NAMES,
    SceneMeasures,
    format_measure,
)

COLUMNS = (
    "psnr_db",
    "ssim",
    "lpips",
    "depth_mae_m",
    "floater_fraction",
    "hole_fraction",
    "psnr_on_black_db",
)


@dataclass(frozen=True)
class Arm:
    """One way to reconstruct, and what the paper found for it on its one scene."""

    key: str
    title: str
    representation: str
    depth: bool
    paper: tuple[float, float, float, float, float]  # in the order of the first of COLUMNS


ARMS = (
    Arm("3dgs", "Vanilla 3DGS", "3dgs", False, (29.35, 0.8706, 0.215, 0.974, 0.115)),
    Arm("2dgs", "Vanilla 2DGS", "2dgs", False, (29.07, 0.8656, 0.228, 1.466, 0.130)),
    Arm("2dgs_depth", "2DGS + depth", "2dgs", True, (28.26, 0.8518, 0.213, 0.212, 0.015)),
    Arm("3dgs_depth", "3DGS + depth (ours)", "3dgs", True, (28.89, 0.8676, 0.184, 0.085, 0.004)),
)


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
            known = dict(zip(COLUMNS, arm.paper, strict=False))
            cells = [format_measure(known.get(name), NAMES[name][1]) for name in COLUMNS]
            rows.append(["paper", arm.title, *cells])
        return rows

    def __str__(self) -> str:
        rows = self.table()
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in rows]
        return "\n".join([*lines, "", *self.verdicts()])


def _ratio(before: SceneMeasures, after: SceneMeasures, name: str) -> str:
    a, b = before.mean(name), after.mean(name)
    if a is None or b is None:
        return "-"
    return f"{a / b:.1f}" if b > 0 else "infinity"


def _spread(values: Sequence[float], form: str) -> str:
    if not values:
        return "-"
    return f"{form.format(np.mean(values))} ± {form.format(np.std(values, ddof=1))}"
