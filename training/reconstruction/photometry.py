"""How bright each image of a capture is beside the others, and how much its corners darken."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.linalg import lsqr
from torch import Tensor

from splatpilot.training.reconstruction.overlap import ThinnedFrame
from splatpilot.training.reconstruction.vignette import vignette

_SAMPLES_PER_PAIR = 100
_BRIGHTNESS = (0.1, 0.98)  # outside, noise or saturation spoils the ratio


@dataclass(frozen=True, eq=False)
class Photometry:
    """Relates image values I to those of the scene S: I = gain_i exp(vignetting rho^2) S.

    rho is the distance from the image centre, 1 in the corners. The scene has the mean brightness
    of the image centres: the logarithms of the gains have the mean 0.
    """

    gains: NDArray[np.float64]  # (n,), one for each image
    vignetting: float  # logarithm of the relative brightness of the corners, at most 0

    def factor(self, i: int, height: int, width: int) -> NDArray[np.float32]:
        """Returns I / S for the pixels of image i, (height, width)."""
        return (self.gains[i] * vignette(self.vignetting, width, height)).astype(np.float32)


def estimate_photometry(views: Sequence[ThinnedFrame], seed: int) -> Photometry:
    """Estimates gains and vignetting from the points that two views or more show.

    Each such point gives one equation, log I_i - log I_j = g_i - g_j + a (rho_i^2 - rho_j^2); they
    are solved for the log gains g and the vignetting a with the least sum of absolute residuals
    (iteratively reweighted least squares), since surfaces that shine break some of them. What the
    equations leave open is pulled to 0.
    """
    rng = np.random.default_rng(seed)
    n = len(views)
    first, second, log_ratio, radius_difference = [], [], [], []
    for i, view in enumerate(views):
        p_WQ, pixel_i = view.points(step=4)
        for j, other in enumerate(views):
            if i == j:
                continue
            number, pixel_j = other.find(p_WQ)
            I_i, I_j = view.luminance.flat[pixel_i[number]], other.luminance.flat[pixel_j]
            low, high = _BRIGHTNESS
            usable = np.flatnonzero((np.minimum(I_i, I_j) > low) & (np.maximum(I_i, I_j) < high))
            if len(usable) < _SAMPLES_PER_PAIR:
                continue
            usable = rng.choice(usable, _SAMPLES_PER_PAIR, replace=False)
            first.append(np.full(_SAMPLES_PER_PAIR, i))
            second.append(np.full(_SAMPLES_PER_PAIR, j))
            log_ratio.append(np.log(I_i[usable] / I_j[usable]))
            radius_difference.append(
                view.radius_squared.flat[pixel_i[number[usable]]]
                - other.radius_squared.flat[pixel_j[usable]]
            )
    if not first:
        return Photometry(np.ones(n), 0.0)
    i, j, b, r = map(np.concatenate, (first, second, log_ratio, radius_difference))
    equation = np.arange(len(b))
    A = coo_array(
        (
            np.concatenate([np.ones(len(b)), -np.ones(len(b)), r]),
            (np.tile(equation, 3), np.concatenate([i, j, np.full(len(b), n)])),
        ),
        shape=(len(b), n + 1),
    ).tocsr()
    weights, x = np.ones(len(b)), np.zeros(n + 1)
    for _ in range(8):
        x = lsqr(A * weights[:, None], b * weights, damp=1e-3)[0]
        weights = 1 / np.sqrt(np.maximum(np.abs(b - A @ x), 0.01))
    log_gains = x[:n] - x[:n].mean()
    return Photometry(np.exp(log_gains), float(min(x[n], 0)))


def fit_gain(color: Tensor, image: Tensor, valid: Tensor) -> float:
    """Returns the factor by which `color` (H, W, 3) comes nearest to `image` in the least-squares
    sense, over pixels `valid` (H, W) that are not saturated."""
    usable = (image < _BRIGHTNESS[1]) & valid[..., None]
    x, y = color[usable].double(), image[usable].double()
    return float((x * y).sum() / (x * x).sum().clamp(min=1e-9))
