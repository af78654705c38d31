"""How well a reconstruction shows frames that it was not fitted to, for the progress bar."""

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from splatpilot.training.reconstruction.splat_rendering import render
from splatpilot.training.reconstruction.views import ReconstructionViews


@dataclass(frozen=True)
class HeldOutFigures:
    """Means over the withheld frames."""

    psnr_db: float
    depth_mae_m: float  # NaN without depth
    gains: tuple[float, ...]  # brightness of each frame relative to the scene

    def scalars(self) -> dict[str, float]:
        """The figures by name, for a log."""
        return {"psnr_db": self.psnr_db, "depth_mae_m": self.depth_mae_m}

    def __str__(self) -> str:
        depth = "" if np.isnan(self.depth_mae_m) else f", {self.depth_mae_m:.4f} m"
        return f"{self.psnr_db:.2f} dB{depth}"


def measure_held_out(
    representation: str,
    gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    views: ReconstructionViews,
    background: Tensor,
    threads: int,
    far: float = 150.0,
) -> HeldOutFigures:
    """Renders each view and compares it: colours under the gain that suits best, expected depth
    where the true one lies between 0 and `far` [m]."""
    squares, depth_errors, gains = [], [], []
    for k in range(len(views)):
        rendering = render(
            representation,
            gaussians,
            views.viewmats[k : k + 1].to(background.device),
            views.K.to(background.device),
            views.width,
            views.height,
            background=background,
            depth_mode="ED",
            threads=threads,
        )
        color = rendering.color.cpu() * views.vignette[..., None]
        image = views.image(k)
        gains.append(best_gain(color, image))
        color = (gains[-1] * color).clamp(0, 1)
        squares.append(float(((color - image) ** 2).mean()))
        depth = views.depths[k]
        valid = (depth > 0) & (depth < far)
        if valid.any():
            error = (rendering.depth.cpu() - depth)[valid].abs()
            depth_errors.append(float(error.mean()))
    return HeldOutFigures(
        psnr_db=float(np.mean(-10 * np.log10(np.maximum(squares, 1e-12)))),
        depth_mae_m=float(np.mean(depth_errors)) if depth_errors else float("nan"),
        gains=tuple(gains),
    )


def best_gain(color: Tensor, image: Tensor) -> float:
    """Returns the factor by which `color` (H, W, 3) comes nearest to `image` in the least-squares
    sense, over pixels that are not saturated."""
    usable = image < 0.98
    x, y = color[usable].double(), image[usable].double()
    return float((x * y).sum() / (x * x).sum().clamp(min=1e-9))
