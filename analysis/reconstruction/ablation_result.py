"""What the ablation compares, and its table."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

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

    captures: dict[str, dict[str, SceneMeasures]]  # by name of the capture and key of the arm

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
                    format_measure(arms[arm.key].mean(name), NAMES[name][1]) for name in COLUMNS
                ]
                rows.append([capture, arm.title, *cells])
        if len(self.captures) > 1:
            for arm in ARMS:
                cells = [_spread(self.values(arm, name), NAMES[name][1]) for name in COLUMNS]
                rows.append(["mean ± spread", arm.title, *cells])
        for arm, known in paper_rows():
            cells = [format_measure(known.get(name), NAMES[name][1]) for name in COLUMNS]
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


def _ratio(before: SceneMeasures, after: SceneMeasures, name: str) -> str:
    a, b = before.mean(name), after.mean(name)
    if a is None or b is None:
        return "-"
    return f"{a / b:.1f}" if b > 0 else "infinity"


def _spread(values: Sequence[float], form: str) -> str:
    if not values:
        return "-"
    return f"{form.format(np.mean(values))} ± {form.format(np.std(values, ddof=1))}"
