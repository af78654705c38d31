"""How lenses darken the corners of images: I = exp(vignetting rho^2) S."""

import numpy as np
from numpy.typing import NDArray


def radius_squared(width: int, height: int) -> NDArray[np.float64]:
    """Returns rho^2 (height, width) of each pixel: rho is the distance from the image's centre, 1
    in the corners."""
    x = np.arange(width) + 0.5 - width / 2
    y = (np.arange(height) + 0.5 - height / 2)[:, None]
    return (x**2 + y**2) / ((width**2 + height**2) / 4)


def vignette(vignetting: float, width: int, height: int) -> NDArray[np.float64]:
    """Returns the brightness (height, width) of each pixel relative to the image's centre.

    Args:
        vignetting: logarithm of the relative brightness of the corners.
        width, height: [px].
    """
    return np.exp(vignetting * radius_squared(width, height))
