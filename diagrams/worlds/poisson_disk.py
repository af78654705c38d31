"""Random points that keep their distance from each other."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

_TRIES = 24
"""Candidates around each point before it is given up, as Bridson (2007) has it."""


def poisson_disk(
    lower: ArrayLike, upper: ArrayLike, spacing: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Fills the rectangle [lower, upper] with points no two of which are closer than `spacing`.

    Bridson's algorithm: new points are drawn from the ring of 1 to 2 spacings about old ones and
    kept when no point is too close, looked up on a grid of cells that hold one point at most.

    Args:
        lower, upper: (2,) [m].
        spacing: [m], least distance of two points.

    Returns:
        Points (N, 2) [m].
    """
    lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    cell = spacing / np.sqrt(2)
    grid = np.full((*(np.floor((upper - lower) / cell).astype(int) + 5), 2), np.inf)

    def index(p):  # two cells of padding on every side
        i, j = ((p - lower) / cell).astype(int) + 2
        return i, j

    first = rng.uniform(lower, upper)
    grid[index(first)] = first
    points, active = [first], [first]
    while active:
        k = int(rng.integers(len(active)))
        angle = rng.uniform(0, 2 * np.pi, _TRIES)
        radius = spacing * np.sqrt(rng.uniform(1, 4, _TRIES))
        ring = active[k] + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        for p in ring[((ring >= lower) & (ring <= upper)).all(axis=1)]:
            i, j = index(p)
            near = grid[i - 2 : i + 3, j - 2 : j + 3]
            if (np.square(near - p).sum(axis=-1) >= spacing**2).all():
                grid[i, j] = p
                points.append(p)
                active.append(p)
                break
        else:
            active[k] = active[-1]
            active.pop()
    return np.array(points)
