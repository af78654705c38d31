"""What holds Gaussians to the surfaces that depth shows."""

from torch import Tensor

from splatpilot.training.reconstruction.losses import FAR
from splatpilot.training.reconstruction.splat_rendering import Rendering

# Of its depth, how far from a surface a Gaussian may stand to belong to it.
_REACH = 0.05


def surface_loss(rendering: Rendering, means: Tensor, viewmat: Tensor, depth: Tensor) -> Tensor:
    """Returns the mean of |log z - log depth| over the Gaussians that belong to what is seen.

    Expected depth is right already where some layers of a surface stand before it and others
    behind; then the median is wrong. So every Gaussian whose centre is seen within 5 % of the true
    depth at its pixel is drawn to that depth, and none across the edge of a thing.

    Args:
        rendering: which Gaussians are seen where.
        means: (N, 3) [m], of all Gaussians.
        viewmat: (1, 4, 4) world to camera.
        depth: (H, W) [m], the truth.
    """
    column, row = rendering.meta["means2d"].detach().floor().long().unbind(dim=1)
    height, width = depth.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    number = rendering.meta["gaussian_ids"][inside]
    truth = depth[row[inside], column[inside]]
    z = means[number] @ viewmat[0, 2, :3] + viewmat[0, 2, 3]
    near = (truth > 0) & (truth < FAR) & ((z.detach() - truth).abs() < _REACH * truth)
    return (z[near] / truth[near]).log().abs().sum() / near.sum().clamp(min=1)
