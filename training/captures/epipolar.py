"""Two-view geometry of matched features: agreement of poses and intrinsics without depth."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import Capture

_FEATURES = 2000  # maximum number in an image
_RATIO = 0.8  # of the distances of the best and the second match (Lowe 2004)
_MIN_MATCHES = 40  # of a pair that is used
_MIN_MOTION = 0.04  # median motion of features between the frames, relative to the image's width
_STEPS = (1, 2, 4, 8, 16)  # frames between the images of a pair
_MAX_RESIDUAL = 2.0  # [px] of matches to the best epipolar geometry of any camera


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Features that two frames show."""

    frames: tuple[int, int]
    pixels: tuple[NDArray[np.float64], NDArray[np.float64]]  # (n, 2) [px] in each


def match_frames(capture: Capture, count: int) -> list[MatchedPair]:
    """Matches SIFT features of `count` frames, each with a later one in which they have moved."""
    found: dict[int, tuple] = {}

    def features(i: int) -> tuple:
        if i not in found:
            gray = cv2.cvtColor(capture.load_image(i), cv2.COLOR_RGB2GRAY)
            valid = np.broadcast_to(capture.load_valid(i), gray.shape)
            sift = cv2.SIFT.create(_FEATURES)
            points, descriptors = sift.detectAndCompute(gray, 255 * valid.astype(np.uint8))
            found[i] = np.array([p.pt for p in points]).reshape(-1, 2) + 0.5, descriptors
        return found[i]

    pairs = []
    for i in np.unique(np.linspace(0, len(capture) - 2, count).astype(int)).tolist():
        best = None
        for j in (i + step for step in _STEPS if i + step < len(capture)):
            pixels = _match(features(i), features(j))
            if len(pixels[0]) < _MIN_MATCHES:
                break
            best = MatchedPair((i, j), pixels)
            motion = np.median(np.linalg.norm(pixels[1] - pixels[0], axis=1))
            if motion > _MIN_MOTION * capture.width:
                break
        if best is not None:
            pairs.append(best)
    return pairs


def _match(first: tuple, second: tuple) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    (p, a), (q, b) = first, second
    nothing = np.zeros((0, 2)), np.zeros((0, 2))
    if a is None or b is None or min(len(a), len(b)) < _MIN_MATCHES:
        return nothing
    matches = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a, b, k=2)
    kept = [m for m, other in matches if m.distance < _RATIO * other.distance]
    if len(kept) < _MIN_MATCHES:
        return nothing
    p, q = p[[m.queryIdx for m in kept]], q[[m.trainIdx for m in kept]]
    cv2.setRNGSeed(0)
    _, inliers = cv2.findFundamentalMat(p, q, cv2.FM_RANSAC, _MAX_RESIDUAL, 0.999)
    if inliers is None:
        return nothing
    valid = inliers.ravel() > 0
    return p[valid], q[valid]


def epipolar_errors(
    K: NDArray[np.float64], bend: float, pair: MatchedPair, X_BA: RigidTransform
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Returns the distances of matches from their epipolar lines (Sampson's approximation), in
    focal lengths, and which of the points lie before both cameras, (n,).

    Args:
        K: (3, 3) [px], intrinsics.
        bend: coefficient k1 of radial distortion that the images still have.
        pair: the matches.
        X_BA: pose of the first camera A in the second camera B.
    """
    rays = []
    for pixels in pair.pixels:
        ray = (pixels - K[:2, 2]) / np.diag(K)[:2]
        ray = ray / (1 + bend * (ray**2).sum(axis=1, keepdims=True))
        rays.append(np.column_stack([ray, np.ones(len(ray))]))
    a, b = rays
    R, p = X_BA.rotation().matrix(), X_BA.translation()
    if not np.linalg.norm(p) > 1e-9:
        return np.full(len(a), np.inf), np.zeros(len(a), dtype=bool)
    t = p / np.linalg.norm(p)
    E = np.cross(t, R.T).T  # [t]x R
    Ea, Eb = a @ E.T, b @ E
    slope = np.sqrt((Ea[:, :2] ** 2).sum(axis=1) + (Eb[:, :2] ** 2).sum(axis=1))
    errors = np.abs((b * Ea).sum(axis=1)) / np.maximum(slope, 1e-12)
    turned = a @ R.T
    across = np.cross(b, turned)
    depth = -(across * np.cross(b, t)).sum(1) / np.maximum((across**2).sum(1), 1e-300)
    return errors, (depth > 0) & (depth * turned[:, 2] + t[2] > 0)
