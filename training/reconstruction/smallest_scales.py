"""How small Gaussians may be: no smaller than what any camera could tell."""

import torch
from torch import Tensor

from splatpilot.training.reconstruction.views import ReconstructionViews

# Variance in pixels of the closest camera, as in Mip-Splatting.
_VARIANCE = 0.2
# What is farther than this many times the depth that a view shows is hidden from it.
_HIDDEN = 1.1


@torch.no_grad()
def smallest_scales(means: Tensor, views: ReconstructionViews) -> Tensor:
    """Returns the standard deviations (N,) [m] that are added, squared, to those of Gaussians: the
    3D smoothing filter of Mip-Splatting (Yu et al. 2024).

    Each is that of a Gaussian with a variance of 0.2 square pixels in the closest of the views that
    see its centre, and 0 where none does. Smaller Gaussians are seen by the blur of colours alone:
    depth, which has none, would look through between them, and so would a camera that comes closer.

    Args:
        means: (N, 3) [m].
        views: what is fitted.
    """
    K, viewmats = views.K[0].to(means.device), views.viewmats.to(means.device)
    closest = torch.full_like(means[:, 0], torch.inf)  # [m]
    for k, X_CW in enumerate(viewmats):
        p_CQ = means @ X_CW[:3, :3].T + X_CW[:3, 3]
        z = p_CQ[:, 2]
        u, v, _ = (p_CQ / z[:, None] @ K.T).unbind(dim=1)
        inside = (z > 0) & (u >= 0) & (u < views.width) & (v >= 0) & (v < views.height)
        number = inside.nonzero()[:, 0]
        row, column = v[number].long().cpu(), u[number].long().cpu()
        shown = views.depths[k][row, column].to(means.device)
        number = number[(shown <= 0) | (z[number] < _HIDDEN * shown)]
        closest[number] = torch.minimum(closest[number], z[number])
    return torch.where(closest.isfinite(), _VARIANCE**0.5 / K[0, 0] * closest, 0)
