"""How far the depth that policies get is from the truth, at edges and away from them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

NEAR = 4.0
"""[m], true depths below which relative errors are looked at: what is flown around next."""

TOLERANCE, RELATIVE_TOLERANCE = 0.1, 0.05
"""[m], and as a fraction of the true depth; errors are wrong beyond the larger of the two."""

FAR_TOO_NEAR = 0.5
"""[m], how much too near a pixel must read to look like an obstacle that is not there."""

_EDGE_REACH = 2
"""[px], within which of a discontinuity a pixel is at an edge."""


class DepthFrame(NamedTuple):
    """What a camera says and what is there: planar depths [m]."""

    depth: NDArray[np.floating]  # (H, W), of the camera: 0 is too near, infinity too far
    truth: NDArray[np.floating]  # (H, W), infinite where nothing is; NaN where nobody knows


@dataclass(frozen=True)
class DepthErrors:
    """Errors of the pixels of some frames, as fractions of these, NaN of none."""

    pixels: int
    """Whose truth is known."""
    left_out: float
    """Fraction of all pixels whose truth is not."""
    bias: float
    """Median relative error of the depths nearer than `NEAR`; p5 and p95 are percentiles of it."""
    p5: float
    p95: float
    too_near: float
    """Wrong by more than the tolerance: nearer than the truth, or farther."""
    too_far: float
    far_too_near: float
    """Nearer than the truth by more than `FAR_TOO_NEAR`."""
    holes: float
    """The camera sees nothing where something is; they are also too far."""

    @classmethod
    def of(cls, depth: NDArray, truth: NDArray, reach: float) -> Self:
        """
        Compares depths (N,) [m] with the truth (N,) [m], NaN where unknown.

        Beyond `reach` [m] the camera says infinity. What is farther counts as being there, so that
        a surface at the end of the reach is no error and one in front of the sky is.
        """
        known = ~np.isnan(truth)
        left_out = 1 - known.mean() if len(truth) else np.nan
        depth, truth = depth[known], np.minimum(truth[known], reach)
        error = np.minimum(depth, reach) - truth
        tolerance = np.maximum(TOLERANCE, RELATIVE_TOLERANCE * truth)
        near = (truth < NEAR) & np.isfinite(depth)
        relative = error[near] / truth[near]
        p5, bias, p95 = np.percentile(relative, (5, 50, 95)) if near.any() else [np.nan] * 3
        wrong = (
            error < -tolerance,
            error > tolerance,
            error < -FAR_TOO_NEAR,
            (error > tolerance) & np.isinf(depth),
        )
        shares = [float(pixels.mean()) if len(truth) else np.nan for pixels in wrong]
        return cls(len(truth), float(left_out), float(bias), float(p5), float(p95), *shares)


def depth_errors(frames: Sequence[DepthFrame], reach: float) -> dict[str, DepthErrors]:
    """Errors of all pixels of some frames, of those "at edges", and of those "elsewhere".

    Args:
        frames: of any sizes.
        reach: [m], the farthest that the camera sees.
    """
    depth, truth = (
        np.concatenate([image.ravel() for image in k]) for k in zip(*frames, strict=True)
    )
    edge = np.concatenate([at_edges(frame.truth, reach).ravel() for frame in frames])
    parts = {"all": np.full(len(edge), True), "at edges": edge, "elsewhere": ~edge}
    return {name: DepthErrors.of(depth[on], truth[on], reach) for name, on in parts.items()}


def at_edges(truth: NDArray, reach: float) -> NDArray[np.bool_]:
    """Which pixels (H, W) lie within 2 px of a discontinuity of the true depth (H, W) [m].

    On a plane the inverse of the depth is linear in the image however steeply it is looked at; it
    is discontinuous where its second difference is more than 5 % of the largest of the three.
    """
    nearness = 1 / np.minimum(np.where(np.isnan(truth), np.inf, truth), reach)
    edge = np.zeros(truth.shape, bool)
    for w, found in ((nearness, edge), (nearness.T, edge.T)):
        bend = np.abs(w[2:] - 2 * w[1:-1] + w[:-2])
        largest = np.maximum(np.maximum(w[2:], w[:-2]), w[1:-1])
        found[1:-1] |= bend > RELATIVE_TOLERANCE * largest
    square = np.full((2 * _EDGE_REACH + 1,) * 2, True)
    return np.asarray(binary_dilation(edge, square), dtype=bool)
