"""Refines poses, which drift, so that depth and brightness of all frames agree: direct bundle
adjustment by Gauss-Newton (Kerl, Sturm and Cremers 2013; Schops, Sattler and Pollefeys 2019)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.sparse import coo_matrix, csc_matrix, eye, kron
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from splatpilot.systems.common.progress import Progress, say
from splatpilot.systems.common.validation import errors_about
from splatpilot.training.captures.capture import (
    Capture,
    CaptureFrame,
    back_project,
    project,
    shrink,
    shrink_factor,
)
from splatpilot.training.captures.capture_config import (
    CaptureConfig,
    cache_folder,
    cache_key,
    cached_folder,
)

_WIDTH = 320  # [px] Approximate width of compared images, to which lengths in pixels below refer
_REACH = 0.08
"""[-] Relative difference of depth up to which two frames can show the same surface, and maximum
change of its inverse depth from one pixel to the next."""
_NUM_POINTS, _MIN_POINTS = 1000, 50  # maximum compared points per frame, and minimum per pair
_FINE, _COARSE = 1.5, 10.0
"""[px] Brightness is blurred by the first, to be smooth over steps, and divided by what the second
leaves: exposure and vignetting cancel in the ratio."""
_BLACK = 0.05  # added to the divisor of brightness (0 to 1)
_AROUND = np.ones((5, 5), np.uint8)
_PARTNERS, _OVERLAP, _PROBES = 16, 0.2, 64
"""Maximum number of frames that each is compared with, and the fraction of so many of its points
that these must see."""
_REACHES = _REACH, 0.06, 0.05, 0.04  # reach in the first rounds; the last holds for all later ones
_ROUNDS, _SETTLED = 30, 1e-3  # maximum number of rounds, and steps [m], [rad] below which they end
_SPREADS = np.array([0.01, 0.03])
"""Standard deviations of residuals in the first round; later ones measure them."""
_INDEPENDENT = 10
"""Number of independent points that the points of a pair count for: neighbors share errors."""
_DRIFT, _BELIEF = 0.005, 0.1
"""[m], [rad] Standard deviations of the drift from one frame to the next, and of poses: poses that
no other frame constrains move as the frames before and after."""
_VERSION = 1  # version of the result for the same frames


@dataclass(frozen=True, eq=False)
class ComparedFrame:
    """Depth and contrast of a frame."""

    K: NDArray[np.float64]  # (3, 3) [px]
    inverse_depth: NDArray[np.float32]
    """(H, W) [1/m]; 0 where it is unknown or not of one surface all around."""
    contrast: NDArray[np.float32]  # (H, W), brightness relative to its neighborhood
    p_CQ: NDArray[np.float64]  # (n, 3) [m], points that it sees
    point_contrast: NDArray[np.float64]  # (n,), of these

    @classmethod
    def prepare(cls, frame: CaptureFrame) -> "ComparedFrame":
        """Prepares a frame that is about `_WIDTH` wide."""
        depth = np.where(np.isfinite(frame.depth), frame.depth, 0).astype(np.float32)
        lower, upper = cv2.erode(depth, _AROUND), cv2.dilate(depth, _AROUND)
        surface = (lower > 0) & (upper < (1 + _REACH) * lower)
        # On a plane it is linear in the pixel coordinates, and a blur preserves it.
        inverse = cv2.GaussianBlur(1 / np.where(depth > 0, depth, 1), _AROUND.shape, 0)
        inverse = np.where(surface, inverse, 0).astype(np.float32)
        gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
        fine, coarse = (cv2.GaussianBlur(gray, (0, 0), sigma) for sigma in (_FINE, _COARSE))
        contrast = (fine / (coarse + _BLACK)).astype(np.float32)
        chosen = np.random.default_rng(0).permutation(np.flatnonzero(surface))[:_NUM_POINTS]
        rows, columns = np.divmod(chosen, depth.shape[1])
        z = 1 / inverse.flat[chosen].astype(np.float64)
        p_CQ = back_project(frame.K, columns + 0.5, rows + 0.5, z)
        return cls(frame.K, inverse, contrast, p_CQ, contrast.flat[chosen].astype(np.float64))

    def sees(
        self, p_CQ: NDArray[np.float64], reach: float = _REACH
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
        """Returns which of the points (n, 3) are on surfaces that it sees within `reach`; the image
        coordinates (2, n) of all; and its inverse depth there with derivatives (3, n)."""
        x, y, z = p_CQ.T
        u = np.array(project(self.K, x, y, z.clip(min=1e-3)))
        inverse = _sample(self.inverse_depth, u)
        # Next to unknown depth it falls to zero.
        steep = np.abs(inverse[1:]).max(axis=0) > _REACH * inverse[0]
        same = np.abs(inverse[0] * p_CQ[:, 2] - 1) < reach
        return (inverse[0] > 0) & ~steep & same, u, inverse


@dataclass(frozen=True, eq=False)
class Comparison:
    """Differences of two frames at points that both see."""

    residuals: NDArray[np.float64]
    """(2, n): e = w(u) q_z - 1, the relative difference of depth of a point that one frame sees and
    that is at q in the other, in the pixel u, of inverse depth w(u); and c(u) - c, of contrast."""
    derivatives: NDArray[np.float64]
    """(2, n, 12), by small rotations [rad] of one frame about its center, its translation [m], and
    those of the other, all in the axes of the world."""


def compare_frames(
    one: ComparedFrame,
    other: ComparedFrame,
    X_WC: RigidTransform,
    X_WC_other: RigidTransform,
    reach: float,
) -> Comparison | None:
    """Compares the points of one frame with what another sees there; None if it sees too few."""
    R, p = X_WC_other.rotation().matrix(), X_WC_other.translation()
    p_WQ = one.p_CQ @ X_WC.rotation().matrix().T + X_WC.translation()
    q = (p_WQ - p) @ R
    same, u, inverse = other.sees(q, reach)
    if same.sum() < _MIN_POINTS:
        return None
    p_WQ, q, u, inverse = p_WQ[same], q[same], u[:, same], inverse[:, same]
    contrast = _sample(other.contrast, u)
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


def _sample(image: NDArray[np.float32], u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns an image and its derivatives [1/px], (3, n), at u (2, n); zero outside."""
    x, y = (u - 0.5).clip(-9, 1e4).astype(np.float32)[:, None]
    values = [
        cv2.remap(image, x + a, y + b, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)[0]
        for a, b in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    center, right, left, below, above = np.array(values, dtype=np.float64)
    return np.array([center, (right - left) / 2, (below - above) / 2])


@dataclass(frozen=True, eq=False)
class RefinedPoses:
    """Poses, and the agreement of frames in them."""

    X_WCs: list[RigidTransform]
    moved: float  # [m], mean over frames
    rotated: float  # [rad], mean over frames
    depth: tuple[float, float]
    """Median relative difference of depth between frames, before and after."""
    contrast: tuple[float, float]  # median difference of contrast, before and after

    def __str__(self) -> str:
        rotated = np.rad2deg(self.rotated)
        text = f"poses moved by {self.moved:.3f} m and {rotated:.1f} degrees on average"
        for name, (before, after) in (("depth", self.depth), ("contrast", self.contrast)):
            text += f"; {name} differs between frames by {after:.2%}, before by {before:.2%}"
        return text


def refine_poses(frames: Sequence[ComparedFrame], X_WCs: Iterable[RigidTransform]) -> RefinedPoses:
    """Returns the poses of frames in sequence with the smallest squared residuals over their
    spreads, see `Comparison`. Removes drift of centimeters and a degree or two, not lost tracking:
    points whose depths differ by more than 8 % are not compared."""
    poses = given = list(X_WCs)
    pairs = _pairs(frames, poses)
    spreads = _SPREADS
    history = []
    with Progress(range(_ROUNDS), "refining poses", unit="round") as rounds:
        for number in rounds:
            reach = _REACHES[min(number, len(_REACHES) - 1)]
            compared = [
                (i, j, found)
                for i, j in pairs
                if (found := compare_frames(frames[i], frames[j], poses[i], poses[j], reach))
            ]
            if not compared:
                raise ValueError(
                    "no two frames see the same surfaces, so poses cannot be refined; see "
                    "`splatpilot capture check`"
                )
            differences = [np.median(np.abs(found.residuals), axis=1) for _, _, found in compared]
            history.append(np.median(differences, axis=0))
            step = _step(compared, spreads, _corrections(poses, given))
            poses = [_moved(X_WC, by) for X_WC, by in zip(poses, step, strict=True)]
            # A median of absolute values is that of a normal distribution times 0.6745.
            spreads = np.maximum(history[-1] / 0.6745, 1e-4)
            largest = np.abs(step).max()
            rounds.set_postfix_str(f"largest step {largest:.4f}")
            if number >= len(_REACHES) and largest < _SETTLED:
                break
    rotated, moved = np.linalg.norm(_corrections(poses, given).reshape(-1, 2, 3), axis=2).mean(
        axis=0
    )
    depth, contrast = zip(history[0].tolist(), history[-1].tolist(), strict=True)
    return RefinedPoses(poses, float(moved), float(rotated), depth, contrast)


def _pairs(
    frames: Sequence[ComparedFrame], X_WCs: Sequence[RigidTransform]
) -> list[tuple[int, int]]:
    """Returns pairs of each frame with frames that see it, fewer of those farther in sequence."""
    X_CWs = np.array([X_WC.inverse().GetAsMatrix34() for X_WC in X_WCs])
    height, width = frames[0].contrast.shape
    pairs = []
    for i in Progress(range(len(frames)), "comparing frames", unit="frame"):
        p_WQ = X_WCs[i].multiply(frames[i].p_CQ[:_PROBES].T)
        if p_WQ.size < 3 * _PROBES:
            continue
        p_CQs = X_CWs[:, :, :3] @ p_WQ + X_CWs[:, :, 3:]  # (N, 3, n)
        x, y, z = np.moveaxis(frames[i].K @ p_CQs, -2, 0)
        inside = (z > 0) & (x > 0) & (x < width * z) & (y > 0) & (y < height * z)
        seeing = [
            j
            for j in np.flatnonzero(inside.mean(axis=1) > _OVERLAP).tolist()
            if j != i and frames[j].sees(p_CQs[j].T)[0].mean() > _OVERLAP
        ]
        seeing.sort(key=lambda j: abs(j - i))
        ranks = np.geomspace(1, max(len(seeing), 1), _PARTNERS).round().astype(int)
        pairs += [(i, seeing[rank - 1]) for rank in np.unique(ranks) if seeing]
    return pairs


def _step(
    pairs: Sequence[tuple[int, int, Comparison]],
    spreads: NDArray[np.float64],
    corrections: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Returns the step (N, 6) of Gauss-Newton from poses with `corrections` (N, 6) so far."""
    count = len(corrections)
    unknowns, hessians = np.zeros((len(pairs), 12), int), np.zeros((len(pairs), 12, 12))
    gradient = np.zeros(6 * count)
    for k, (i, j, found) in enumerate(pairs):
        weight = np.sqrt(_INDEPENDENT / found.residuals.shape[1]) / spreads
        J = (found.derivatives * weight[:, None, None]).reshape(-1, 12)
        unknowns[k] = np.add.outer([6 * i, 6 * j], np.arange(6)).ravel()
        hessians[k] = J.T @ J
        gradient[unknowns[k]] += J.T @ (found.residuals * weight[:, None]).ravel()
    rows, columns = unknowns[:, :, None], unknowns[:, None, :]
    rows, columns = (np.broadcast_to(each, hessians.shape).ravel() for each in (rows, columns))
    H = coo_matrix((hessians.ravel(), (rows, columns)), shape=(6 * count, 6 * count))
    change = eye(count - 1, count) - eye(count - 1, count, k=1)
    believed = kron(change.T @ change / _DRIFT**2 + eye(count) / _BELIEF**2, eye(6))
    step = splu(csc_matrix(H + believed)).solve(-gradient - believed @ corrections.ravel())
    return step.reshape(-1, 6)


def _moved(X_WC: RigidTransform, step: NDArray[np.float64]) -> RigidTransform:
    """Returns a pose rotated by step[:3] [rad] about its center and moved by step[3:] [m]."""
    turn = RotationMatrix(Rotation.from_rotvec(step[:3]).as_matrix())
    R_WC = RotationMatrix.ProjectToRotationMatrix((turn @ X_WC.rotation()).matrix())
    return RigidTransform(R_WC, X_WC.translation() + step[3:])


def _corrections(
    X_WCs: Sequence[RigidTransform], given: Sequence[RigidTransform]
) -> NDArray[np.float64]:
    """Returns the rotations [rad] and translations [m] of poses from those given, (N, 6)."""
    pairs = list(zip(X_WCs, given, strict=True))
    turns = [(X_WC.rotation() @ X_WG.rotation().inverse()).matrix() for X_WC, X_WG in pairs]
    moves = [X_WC.translation() - X_WG.translation() for X_WC, X_WG in pairs]
    return np.concatenate([Rotation.from_matrix(turns).as_rotvec(), moves], axis=1)


def refined_capture(capture: Capture, path: Path, config: CaptureConfig) -> Capture:
    """Returns a capture, as read from `path`, with refined poses, which the cache keeps."""
    if not capture.has_depth:
        raise ValueError(f"{path}: capture.refine_poses needs depth, and it has none; omit it")
    settings = replace(config, cache="").settings()
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    key = cache_key(
        filter(Path.is_file, files), _VERSION, np.__version__, capture.camera_digest(), settings
    )

    def write(folder: Path) -> None:
        factor = shrink_factor(capture.width, _WIDTH)
        loaded = Progress(capture.frames(), "loading frames", len(capture), unit="frame")
        frames = [ComparedFrame.prepare(shrink(frame, factor)) for frame in loaded]
        with errors_about(path):
            refined = refine_poses(frames, capture.X_WCs)
        say(f"{path}: {refined}")
        np.save(folder / "poses.npy", [X_WC.GetAsMatrix34() for X_WC in refined.X_WCs])

    folder = cached_folder(cache_folder(config, "poses", key), write)
    X_WCs = [
        RigidTransform(RotationMatrix(X[:, :3]), X[:, 3]) for X in np.load(folder / "poses.npy")
    ]
    return replace(capture, X_WCs=X_WCs)
