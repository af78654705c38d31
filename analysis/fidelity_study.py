"""Errors of a scene's views beside the path of its capture, and how far they can be trusted."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flysplat.analysis.trust import monotone_fit, reach
from flysplat.training.measures import ViewMeasures


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
        assert found.depth_mae_m is not None
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
        """[m], the largest offset up to which mean errors stay within the limits."""
        return self._reach("offset")

    @cached_property
    def unseen_limit(self) -> float:
        """The largest unseen share of a view at which mean errors stay within the limits."""
        return self._reach("unseen")

    def at(self, offset: float) -> dict[str, float]:
        """Returns PSNR and depth errors at an offset [m], from the monotone fits; NaN where nothing
        was measured."""
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
            f"{self.on_path_psnr_db:.2f} dB",
            f"{'offset [m]':>12} {'PSNR [dB]':>10} {'depth MAE [m]':>14} {'relative':>9}",
        ]
        for offset in (0.0, 0.1, 0.25, 0.5, 0.75, 1.0):
            row = self.at(offset)
            if np.isfinite(row["psnr_db"]):
                lines.append(
                    f"{offset:>12.2f} {row['psnr_db']:>10.2f} {row['depth_mae_m']:>14.3f} "
                    f"{row['depth_relative']:>9.2%}"
                )
        inside, outside = self.agreement()
        lines += [
            f"within limits to {self.reach:.2f} m: on average, depth errors up to "
            f"{self.max_depth_error:.0%} and PSNR up to {self.max_psnr_drop:g} dB lower",
            f"trusted views: those seen to {1 - self.unseen_limit:.0%} or more; {inside:.0%} of "
            f"them keep these limits, {outside:.0%} of the others",
        ]
        return "\n".join(lines)
