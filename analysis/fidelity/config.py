"""What the fidelity study tries, and what counts as trusted."""

from dataclasses import dataclass, field

import numpy as np

from splatpilot.training.reconstruction.config import ReconstructConfig


@dataclass(kw_only=True)
class FidelityConfig:
    """What is tried, and what counts as trusted."""

    offsets: list[float] = field(
        default_factory=lambda: [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0]
    )
    """[m], to the left and right of the path, in worlds that can be rendered."""
    clearance: float = 0.2
    """[m], that a displaced camera keeps from everything."""
    stretches: list[int] = field(default_factory=lambda: [1, 3, 7, 13])
    """Lengths of the stretches of frames that are withheld, in turn, where nothing can be
    rendered."""
    kept: int = 5
    """Frames kept between them."""
    max_depth_error: float = 0.05
    """Relative error of depth, mean over a view, of which the median view is still trusted."""
    max_psnr_drop: float = 6.0
    """[dB] below the held-out frames on the path that is still trusted: errors twice as large."""
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)
    """How to reconstruct without the withheld frames."""

    def validate(self) -> None:
        """Raises ValueError for values that make no sense."""
        self.reconstruct.validate()
        if sorted(set(self.offsets)) != self.offsets or not self.offsets or self.offsets[0] < 0:
            raise ValueError(f"offsets are {self.offsets}; at least one, rising from 0 is needed")
        if not self.stretches or min(self.stretches) < 1 or self.kept < 1:
            raise ValueError(
                f"stretches are {self.stretches} and kept is {self.kept}: at least 1 is needed"
            )
        for name in ("clearance", "max_depth_error", "max_psnr_drop"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, more than 0 is needed")


@dataclass
class StudiedScenes:
    """The content of `fidelity.yaml`: which study a folder holds."""

    scenes: dict[str, str] = field(default_factory=dict)
    """Folders of the scenes, and what each was made from."""
    config: FidelityConfig = field(default_factory=FidelityConfig)
    """What was tried, and what counts as trusted."""
