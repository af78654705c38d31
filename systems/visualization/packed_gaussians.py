"""Gaussians as a page holds them, for `page/splats.js` to show."""

import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.splats.gaussian_scene import GaussianScene

_COVARIANCE_SCALE = 256.0
"""Keeps the covariances of 1 mm to 16 m within what a half holds."""


def pack_gaussians(scene: GaussianScene) -> NDArray[np.uint32]:
    """
    N Gaussians as the page's shader reads them, (N, 8) words each of 32 bits.

    The centre as three floats [m]; red, green, blue (without their dependence on direction) and
    opacity as bytes, lowest first; the covariance's xx, xy, xz, yy, yz, zz as halves
    [m^2 / 256], lowest first; and nothing.
    """
    words = np.zeros((len(scene.means), 8), np.uint32)
    words[:, :3] = scene.means.view(np.uint32)
    shades = np.column_stack([scene.base_colors, scene.opacities])
    words[:, 3] = np.round(255 * shades).astype(np.uint8).view(np.uint32)[:, 0]
    covariances = _COVARIANCE_SCALE * scene.covariances
    # What is larger than a half holds shrinks as a whole, and stays an ellipsoid.
    largest = np.abs(covariances).max(axis=(1, 2), keepdims=True)
    covariances *= np.minimum(1, np.finfo(np.float16).max / np.maximum(largest, 1e-30))
    halves = covariances[(slice(None), *np.triu_indices(3))]
    words[:, 4:7] = np.ascontiguousarray(halves, np.float16).view(np.uint32)
    return words
