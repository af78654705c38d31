"""The figures of a scene against the frames of its capture: `metrics.json`."""

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from splatpilot.training.reconstruction.measures import ViewMeasures, mean_measure

METRICS = "metrics.json"
NAMES = {
    "psnr_db": ("PSNR [dB]", "{:.2f}"),
    "psnr_on_black_db": ("PSNR on black [dB]", "{:.2f}"),
    "ssim": ("SSIM", "{:.4f}"),
    "lpips": ("LPIPS-squeeze", "{:.3f}"),
    "depth_mae_m": ("depth MAE [m]", "{:.3f}"),
    "depth_relative": ("depth error, relative", "{:.2%}"),
    "floater_fraction": ("floaters", "{:.2%}"),
    "hole_fraction": ("holes", "{:.2%}"),
    "unseen_fraction": ("left out as unseen", "{:.2%}"),
}
"""How measures are called and written in tables."""
_MOSTLY_UNSEEN = 0.5
"""Share of the pixels of the default flight from which on a warning is given."""


@dataclass(frozen=True)
class SceneMeasures:
    """A scene against the frames of its capture."""

    held_out: bool
    """Whether the frames had no part in making the scene."""
    width: int  # [px], at which it was measured: images are shrunk as they were for the making
    height: int
    frames: dict[int, ViewMeasures]
    """In the pixels that show what the scene was made from, exposed to fit."""
    strict_frames: dict[int, ViewMeasures]
    """In all pixels, with a gain of 1."""
    lpips_missing: str
    """Why there is no LPIPS; empty if there is."""
    flight_unseen_fraction: float | None
    """See `unseen_share`; None of a scene that cannot be flown in."""

    def mean(self, name: str) -> float | None:
        """Returns the mean of a measure over the frames that have it; None if none has."""
        return mean_measure(self.frames.values(), name)[0]

    def strict_mean(self, name: str) -> float | None:
        """Returns the same in all pixels, with a gain of 1."""
        return mean_measure(self.strict_frames.values(), name)[0]

    @property
    def worst_hole_fraction(self) -> float | None:
        """The share of holes in the frame that has most; None if none has true depth."""
        found = (frame.hole_fraction for frame in self.frames.values())
        return max((share for share in found if share is not None), default=None)

    def as_json(self) -> dict:
        """Returns the content of `metrics.json`: means, over how many frames, and the measures of
        each frame."""
        return {
            **{name: self.mean(name) for name in NAMES},
            "counts": {name: mean_measure(self.frames.values(), name)[1] for name in NAMES},
            "strict": {name: self.strict_mean(name) for name in NAMES},
            "worst_hole_fraction": self.worst_hole_fraction,
            "held_out": self.held_out,
            "width": self.width,
            "height": self.height,
            "lpips_missing": self.lpips_missing,
            "flight_unseen_fraction": self.flight_unseen_fraction,
            "frames": {str(i): asdict(frame) for i, frame in self.frames.items()},
            "strict_frames": {str(i): asdict(f) for i, f in self.strict_frames.items()},
        }

    def __str__(self) -> str:
        kind = "held-out frames" if self.held_out else "frames the scene was made from"
        lines = [
            f"{'measured on':<22} {len(self.frames)} {kind}, {self.width} x {self.height}",
            f"{'':<22} {'seen pixels, gain fitted':<26} all pixels, no gain",
        ]
        for name, (title, form) in NAMES.items():
            mean, count = mean_measure(self.frames.values(), name)
            told = format_measure(mean, form)
            if 0 < count < len(self.frames):
                told += f" ({count} of {len(self.frames)} frames)"
            strict = format_measure(self.strict_mean(name), form)
            lines.append(f"{title:<22} {told:<26} {strict}")
        worst = format_measure(self.worst_hole_fraction, NAMES["hole_fraction"][1])
        lines.append(f"{'holes, worst frame':<22} {worst}")
        unseen = self.flight_unseen_fraction
        lines.append(f"{'unseen in flight':<22} {format_measure(unseen, '{:.1%}')}")
        if unseen is not None and unseen > _MOSTLY_UNSEEN:
            lines.append(
                "warning: a flight from the default start to the default goal looks mostly into "
                "space that no camera saw; capture it looking ahead along such routes"
            )
        if self.lpips_missing:
            lines.append(f"no LPIPS: {self.lpips_missing}")
        return "\n".join(lines)


def format_measure(value: float | None, form: str) -> str:
    """Returns a figure as text, a dash for None."""
    return "-" if value is None else form.format(value)


def read_measures(scene: Path) -> SceneMeasures | None:
    """Returns what `metrics.json` of the scene folder says; None if there is none.

    Raises:
        ValueError: if the file is damaged.
    """
    file = scene / METRICS
    if not file.is_file():
        return None
    try:
        content = json.loads(file.read_text())
        said = {field.name: content[field.name] for field in fields(SceneMeasures)}
        for name in ("frames", "strict_frames"):
            said[name] = {int(i): ViewMeasures(**frame) for i, frame in said[name].items()}
        return SceneMeasures(**said)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{file}: {error!r}; delete the file and measure again") from error
