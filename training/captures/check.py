"""Whether poses, intrinsics and depth of a capture agree, and if not, which mistake explains it.

The capture as it was read and readings with one known mistake each are measured on the same pairs
of frames, see `frame_agreement`. Of a capture without depth only what was read is reported.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frame_agreement import (
    ReadingFit,
    choose_pairs,
    measure_reading,
    reading_of,
)
from splatpilot.training.captures.known_mistakes import fit_readings, undo_mistakes
from splatpilot.training.captures.read_capture import read_capture
from splatpilot.training.captures.registration import ColorFit, fit_color_camera

_FEWEST = 200
"""Points, of all pairs together, below which nothing can be told."""
TOLERANCE = 0.02
"""Median relative error up to which a capture agrees with itself."""
_NEGLIGIBLE = 0.002
"""Median relative error below which no other reading is looked for."""
_BETTER = 0.5
"""What fraction of the error another reading must leave to be believed."""


@dataclass(frozen=True)
class CheckReport:
    """What `check_capture` found."""

    capture: str
    frames: int
    dropped: tuple[str, ...]
    notes: tuple[str, ...]
    metric: bool
    pairs: int = 0
    agreement: ReadingFit | None = None
    """None if there is no depth to compare."""
    others: tuple[ReadingFit, ...] = ()
    """Other readings, the best first."""
    color: ColorFit | None = None
    mistake: str = ""
    """The most likely mistake in one sentence; empty if none was found."""

    @property
    def agrees(self) -> bool:
        """Whether poses, intrinsics and depth were compared, and agree."""
        return self.agreement is not None and not self.mistake

    def __str__(self) -> str:
        lines = [
            f"{self.capture}",
            f"{self.frames} frames, {len(self.dropped)} left out, {self.pairs} pairs compared",
            *(f"  left out: {message}" for message in self.dropped[:10]),
            *self.notes,
        ]
        if not self.metric:
            lines.append("the scale is unknown; capture.scale gives it, if flights are to be flown")
        if self.agreement is None:
            return "\n".join([*lines, "not compared: there is no depth"])
        lines.append(f"{'median error':>12}  {'overlap':>7}  reading")
        lines += [
            f"{each.error:12.2%}  {each.inside:7.0%}  {each.name}"
            for each in (self.agreement, *self.others[:12])
        ]
        if self.color is not None:
            lines += ["color against depth, 1 - correlation between frames:", str(self.color)]
        lines.append("does not agree" if self.mistake else "agrees")
        return "\n".join(lines)


@dataclass(kw_only=True)
class CheckConfig:
    """How a capture is checked."""

    pairs: int = 12
    """How many pairs of frames are compared."""
    capture: CaptureConfig = field(default_factory=CaptureConfig)
    """What the capture's files leave open."""

    def validate(self) -> None:
        """Raises ValueError for values that make no sense."""
        if not 1 <= self.pairs <= 1000:
            raise ValueError(f"pairs is {self.pairs}; 1 to 1000 are needed")


def run(*, capture: str | Path, config: CheckConfig) -> CheckReport:
    """Checks the capture in a folder and prints the report.

    Raises:
        FileNotFoundError, OSError: if files are missing.
        ValueError: if the capture is damaged or cannot be compared.
    """
    config.validate()
    report = check_capture(read_capture(capture, config.capture), config.pairs)
    print(report)
    return report


def doubts(capture: Capture) -> tuple[str, ...]:
    """Returns, as a warning or none, what `check_capture` holds against a capture with depth."""
    if not capture.has_depth:
        return ()
    try:
        mistake = check_capture(capture).mistake
    except ValueError as error:
        return (f"not checked whether the capture agrees with itself: {error}",)
    if not mistake:
        return ()
    return (
        f"the capture does not agree with itself, {mistake}; `splatpilot capture check` tells more",
    )


def check_capture(capture: Capture, pairs: int = 12) -> CheckReport:
    """Measures how well a capture agrees with itself, as it is read and in other readings.

    A capture agrees if its median relative error is at most 2 %, no other reading leaves less than
    half of an error above 0.2 %, and colors follow depth about as well as they can.

    Args:
        pairs: how many pairs of frames are compared.

    Raises:
        ValueError: if it has depth, but too little of it to tell.
    """
    report = CheckReport(
        capture=capture.source,
        frames=len(capture),
        dropped=tuple(capture.dropped),
        notes=tuple(capture.notes),
        metric=capture.metric,
    )
    if not capture.has_depth:
        return report
    found = choose_pairs(capture, pairs)
    if sum(len(pair.depth) for pair in found) < _FEWEST:
        raise ValueError(f"{capture.source}: too few pixels have depth in two frames to compare")
    as_read = reading_of(capture)
    agreement = measure_reading(as_read, found)
    others = [measure_reading(other, found) for other in undo_mistakes(as_read, capture)]
    others += [measure_reading(other, found) for other in fit_readings(as_read, found)]
    others.sort(key=lambda each: each.error)
    best = others[0]
    color = None
    mistake = ""
    if _stands_still(capture):
        mistake = (
            f"all {len(capture)} poses are the same; if the camera moved, look at the file that "
            "they were read from"
        )
    elif agreement.error > _NEGLIGIBLE and best.error < _BETTER * agreement.error:
        mistake = (
            f"most likely {best.name}: the median error would be {best.error:.2%} instead of "
            f"{agreement.error:.2%}"
        )
    elif agreement.error > TOLERANCE:
        mistake = (
            f"the median error of depth between frames is {agreement.error:.1%}, at most "
            f"{TOLERANCE:.0%} is needed, and no known mistake explains it (the best, {best.name}, "
            f"leaves {best.error:.1%}); poses may be inaccurate, which capture.refine_poses may "
            "mend, or things may have moved"
        )
    else:
        color = fit_color_camera(capture, [pair.frames for pair in found])
        mistake = color.mistake if color is not None else ""
    return replace(
        report,
        pairs=len(found),
        agreement=agreement,
        others=tuple(others),
        color=color,
        mistake=mistake,
    )


def _stands_still(capture: Capture) -> bool:
    X_CW = capture.X_WCs[0].inverse()
    return all((X_CW @ X_WC).IsNearlyIdentity(1e-9) for X_WC in capture.X_WCs)
