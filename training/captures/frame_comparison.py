"""How depth and brightness of what two frames see differ, and how that changes with their poses."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.captures.lens import back_project

WIDTH = 320
"""[px] That images to be compared are about wide: what is in pixels below is of such."""
REACH = 0.08
"""[-] Relative difference of depth up to which two frames can show the same, and change of inverse
depth from one pixel to the next that a surface can have."""
_POINTS, _FEWEST = 1000, 50
"""Of each frame that are compared, at most; and of a pair at least."""
_FINE, _COARSE = 1.5, 10.0
"""[px] Brightness is blurred by the first, so that it is smooth over the steps that are made, and
divided by what the second leaves: neither exposure nor the lens's dark corners are in the ratio."""
_BLACK = 0.05
"""Added to what brightness (0 to 1) is divided by."""

_AROUND = np.ones((5, 5), np.uint8)


@dataclass(frozen=True, eq=False)
class ComparedFrame:
    """What of a frame is compared."""

    K: NDArray[np.float64]  # (3, 3) [px]
    inverse_depth: NDArray[np.float32]
    """(H, W) [1/m]; 0 where it is not known, or not of one surface all around."""
    contrast: NDArray[np.float32]  # (H, W), brightness relative to what is around
    p_CQ: NDArray[np.float64]  # (n, 3) [m], points that it sees
    point_contrast: NDArray[np.float64]  # (n,), of these

    @classmethod
    def of(cls, frame: CaptureFrame) -> "ComparedFrame":
        """Prepares a frame that is about `WIDTH` wide."""
        depth = np.where(np.isfinite(frame.depth), frame.depth, 0).astype(np.float32)
        least, most = cv2.erode(depth, _AROUND), cv2.dilate(depth, _AROUND)
        surface = (least > 0) & (most < (1 + REACH) * least)
        # That of a plane is linear in the pixel coordinates: a blur leaves it as it is.
        inverse = cv2.GaussianBlur(1 / np.where(depth > 0, depth, 1), _AROUND.shape, 0)
        inverse = np.where(surface, inverse, 0).astype(np.float32)
        gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
        fine, coarse = (cv2.GaussianBlur(gray, (0, 0), sigma) for sigma in (_FINE, _COARSE))
        contrast = (fine / (coarse + _BLACK)).astype(np.float32)
        chosen = np.random.default_rng(0).permutation(np.flatnonzero(surface))[:_POINTS]
        rows, columns = np.divmod(chosen, depth.shape[1])
        z = 1 / inverse.flat[chosen].astype(np.float64)
        p_CQ = back_project(frame.K, columns + 0.5, rows + 0.5, z)
        return cls(frame.K, inverse, contrast, p_CQ, contrast.flat[chosen].astype(np.float64))

    def sees(
        self, p_CQ: NDArray[np.float64], reach: float = REACH
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
        """Returns which of the points (n, 3) are on the surfaces that it sees, up to a relative
        difference of depth; the image coordinates (2, n) of all; and its inverse depth there, see
        `_at`."""
        z = p_CQ[:, 2].clip(min=1e-3)
        u = np.array([self.K[k, k] * p_CQ[:, k] / z + self.K[k, 2] for k in (0, 1)])
        inverse = _at(self.inverse_depth, u)
        # Beside what is not known it falls to zero.
        steep = np.abs(inverse[1:]).max(axis=0) > REACH * inverse[0]
        same = np.abs(inverse[0] * p_CQ[:, 2] - 1) < reach
        return (inverse[0] > 0) & ~steep & same, u, inverse


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two frames, where both see the same."""

    residuals: NDArray[np.float64]
    """(2, n): e = w(u) q_z - 1, the relative difference of depth of a point that one sees and the
    other has at q, in the pixel u, with the inverse depth w(u); and c(u) - c, that of contrast."""
    derivatives: NDArray[np.float64]
    """(2, n, 12), by small turns [rad] of one frame about its centre, its steps [m], and those of
    the other, all in the axes of the world."""


def compare_frames(
    one: ComparedFrame,
    other: ComparedFrame,
    X_WC: RigidTransform,
    X_WC_other: RigidTransform,
    reach: float,
) -> Comparison | None:
    """Returns how the points of one frame differ from what the other sees there; None where less
    than fifty are on surfaces that it sees, see `ComparedFrame.sees`."""
    R, p = X_WC_other.rotation().matrix(), X_WC_other.translation()
    p_WQ = one.p_CQ @ X_WC.rotation().matrix().T + X_WC.translation()
    q = (p_WQ - p) @ R
    same, u, inverse = other.sees(q, reach)
    if same.sum() < _FEWEST:
        return None
    p_WQ, q, u, inverse = p_WQ[same], q[same], u[:, same], inverse[:, same]
    contrast = _at(other.contrast, u)
    residuals = np.array([inverse[0] * q[:, 2] - 1, contrast[0] - one.point_contrast[same]])
    # A plane has w = m . ray, so that e = m . q - 1.
    f, c = np.diag(other.K)[:2, None], other.K[:2, 2, None]
    w_x, w_y = inverse[1:] * f
    x, y = (u - c) / f
    c_x, c_y = contrast[1:] * f / q[:, 2]
    by_q = np.array([[w_x, w_y, inverse[0] - x * w_x - y * w_y], [c_x, c_y, -x * c_x - y * c_y]])
    by_p_WQ = by_q.transpose(0, 2, 1) @ R.T  # (2, n, 3)
    turn, turn_other = (np.cross(p_WQ - center, by_p_WQ) for center in (X_WC.translation(), p))
    return Comparison(residuals, np.concatenate([turn, by_p_WQ, -turn_other, -by_p_WQ], axis=2))


def _at(image: NDArray[np.float32], u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns an image and its derivatives [1/px] along rows and columns, (3, n), at the image
    coordinates u (2, n); zero outside."""
    x, y = (u - 0.5).clip(-9, 1e4).astype(np.float32)[:, None]
    values = [
        cv2.remap(image, x + a, y + b, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)[0]
        for a, b in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    center, right, left, below, above = np.array(values, dtype=np.float64)
    return np.array([center, (right - left) / 2, (below - above) / 2])
