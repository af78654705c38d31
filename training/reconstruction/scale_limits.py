"""How small and how large Gaussians may be, by how close cameras came to them."""

from typing import NamedTuple

import torch
from torch import Tensor

from splatpilot.training.reconstruction.views import ReconstructionViews

# Variance in pixels of the closest camera, as in Mip-Splatting.
_VARIANCE = 0.2
# Standard deviation as a fraction of the depth from the closest camera.
_LARGEST = 0.05
# What is farther than this many times the depth that a view shows is hidden from it.
_HIDDEN = 1.1


class ScaleLimits(NamedTuple):
    """Of N Gaussians, by the depth from the closest of the views that see their centres."""

    smallest: Tensor  # (N,) [m], added, squared, to their standard deviations; 0 where none sees it
    largest: Tensor  # (N,) [m], of their standard deviations

    @classmethod
    def none(cls, like: Tensor) -> "ScaleLimits":
        """No limits for as many Gaussians as `like` (N,) has numbers."""
        return cls(torch.zeros_like(like), torch.full_like(like, torch.inf))

    def rebuild(self, rows: Tensor, added: int) -> "ScaleLimits":
        """The limits of the Gaussians `rows`, and of `added` ones, which have none."""
        kept = ScaleLimits(*(values[rows] for values in self))
        new = ScaleLimits.none(self.smallest.new_empty(added))
        return ScaleLimits(*(torch.cat(pair) for pair in zip(kept, new, strict=True)))


@torch.no_grad()
def scale_limits(means: Tensor, views: ReconstructionViews, bounded: bool) -> ScaleLimits:
    """Returns how small and large Gaussians may be.

    The smallest is the 3D smoothing filter of Mip-Splatting (Yu et al. 2024), a variance of 0.2
    square pixels in the closest view: smaller Gaussians are seen by the blur of colours alone;
    depth, which has none, would look through between them, and so would a camera that comes closer.
    The largest is a twentieth of the depth, or, where none sees the centre, of the distance from
    the closest camera: Gaussians are drawn as if perspective were the same all over each, so that
    large ones stand as haze before cameras that come close, and nothing says what those are that no
    view sees whole; they grow through rooms, and stand as walls before cameras that come by.

    Args:
        means: (N, 3) [m].
        views: what is fitted.
        bounded: whether there is a largest. Gaussians that do not start on surfaces need to reach.
    """
    K, viewmats = views.K[0].to(means.device), views.viewmats.to(means.device)
    closest = torch.full_like(means[:, 0], torch.inf)  # [m]
    nearest = torch.full_like(means[:, 0], torch.inf)  # [m], camera, whether or not it sees it
    for k, X_CW in enumerate(viewmats):
        p_CQ = means @ X_CW[:3, :3].T + X_CW[:3, 3]
        nearest = torch.minimum(nearest, p_CQ.norm(dim=1))
        z = p_CQ[:, 2]
        u, v, _ = (p_CQ / z[:, None] @ K.T).unbind(dim=1)
        inside = (z > 0) & (u >= 0) & (u < views.width) & (v >= 0) & (v < views.height)
        number = inside.nonzero()[:, 0]
        row, column = v[number].long().cpu(), u[number].long().cpu()
        shown = views.depths[k][row, column].to(means.device)
        number = number[(shown <= 0) | (z[number] < _HIDDEN * shown)]
        closest[number] = torch.minimum(closest[number], z[number])
    seen = closest.isfinite()
    smallest = torch.where(seen, _VARIANCE**0.5 / K[0, 0] * closest, 0)
    largest = torch.full_like(closest, torch.inf)
    if bounded:
        largest = _LARGEST * torch.where(seen, closest, nearest)
    return ScaleLimits(smallest, largest)
