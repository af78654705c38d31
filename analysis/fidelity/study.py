"""Errors of a scene's views beside the path of its capture, and how far they can be trusted."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from splatpilot.analysis.fidelity.trust import band, monotone_fit, reach
from splatpilot.training.reconstruction.measures import ViewMeasures


@dataclass(frozen=True)
class Sample:
    """One view beside the path."""

    frame: int  # of the capture: the one displaced, or the one withheld
    offset: float  # [m] from the path, or from the nearest camera that was kept
    unseen: float  # share of the view that no camera saw like it, see `ViewSupport`
    psnr_db: float
    depth_mae_m: float
    depth_relative: float
    floater_fraction: float

    @classmethod
    def of(cls, frame: int, offset: float, unseen: float, found: ViewMeasures) -> "Sample":
        """Returns the sample of a view that has been measured, with true depth."""
        assert found.psnr_db is not None and found.depth_mae_m is not None
        assert found.depth_relative is not None and found.floater_fraction is not None
        return cls(
            frame=frame,
            offset=offset,
            unseen=unseen,
            psnr_db=found.psnr_db,
            depth_mae_m=found.depth_mae_m,
            depth_relative=found.depth_relative,
            floater_fraction=found.floater_fraction,
        )


@dataclass(frozen=True)
class FidelityStudy:
    """The samples of one scene and what follows from them."""

    name: str
    kind: str
    """Where the truth is from: "rendered", or "withheld" frames."""
    on_path_psnr_db: float
    """Of the held-out frames on the path."""
    samples: list[Sample]
    max_depth_error: float
    max_psnr_drop: float

    def column(self, name: str) -> np.ndarray:
        """Returns one figure of all samples."""
        return np.array([getattr(sample, name) for sample in self.samples])

    @cached_property
    def reach(self) -> float:
        """[m], the largest offset up to which the median view stays within the limits."""
        return self._reach("offset")

    @cached_property
    def unseen_limit(self) -> float:
        """The largest unseen share of a view at which the median view stays within the limits."""
        return self._reach("unseen")

    def at(self, offset: float) -> dict[str, float]:
        """Returns what the median view has at an offset [m], from the monotone fits; NaN where
        nothing was measured."""
        x = self.column("offset")
        if not x.min() - 1e-9 <= offset <= x.max() + 1e-9:
            return dict.fromkeys(("psnr_db", "depth_mae_m", "depth_relative"), float("nan"))
        found = {}
        for name, sign in (("psnr_db", -1), ("depth_mae_m", 1), ("depth_relative", 1)):
            at, fit = monotone_fit(x, sign * self.column(name))
            found[name] = sign * float(np.interp(offset, at, fit))
        return found

    def _reach(self, name: str) -> float:
        x = self.column(name)
        drop = self.on_path_psnr_db - self.column("psnr_db")
        return min(
            reach(x, self.column("depth_relative"), self.max_depth_error),
            reach(x, drop, self.max_psnr_drop),
        )

    def agreement(self) -> tuple[float, float]:
        """Returns the share of views that keep the limits among those that are trusted by what of
        them is unseen, and among the others; NaN where there are none."""
        drop = self.on_path_psnr_db - self.column("psnr_db")
        kept = (self.column("depth_relative") <= self.max_depth_error) & (
            drop <= self.max_psnr_drop
        )
        trusted = self.column("unseen") <= self.unseen_limit
        inside, outside = (
            float(kept[which].mean()) if which.any() else float("nan")
            for which in (trusted, ~trusted)
        )
        return inside, outside

    def __str__(self) -> str:
        lines = [
            f"{self.name}: {len(self.samples)} views, truth {self.kind}; on the path "
            f"{self.on_path_psnr_db:.2f} dB; medians and 10 to 90 % of the views",
            f"{'offset [m]':>10} {'views':>6} {'PSNR [dB]':>21} {'depth MAE [m]':>24} "
            f"{'relative [%]':>20}",
        ]
        x = self.column("offset")
        bands = [
            band(x, factor * self.column(name))
            for name, factor in (("psnr_db", 1), ("depth_mae_m", 1), ("depth_relative", 100))
        ]
        for k, (at, count) in enumerate(zip(bands[0].at, bands[0].counts, strict=True)):
            psnr, mae, relative = (
                f"{b.middle[k]:.{digits}f} ({b.low[k]:.{digits}f} to {b.high[k]:.{digits}f})"
                for b, digits in zip(bands, (1, 3, 1), strict=True)
            )
            lines.append(f"{at:>10.2f} {count:>6} {psnr:>21} {mae:>24} {relative:>20}")
        inside, outside = self.agreement()
        lines += [
            f"the median view is within limits to {self.reach:.2f} m: depth errors up to "
            f"{self.max_depth_error:.0%} and PSNR up to {self.max_psnr_drop:g} dB lower",
            f"trusted views: those seen to {1 - self.unseen_limit:.0%} or more; {inside:.0%} of "
            f"them keep these limits, {outside:.0%} of the others",
        ]
        return "\n".join(lines)
