"""Refines poses so that depth and brightness of all frames agree.

Poses of phones, KinectFusion and odometry drift by centimeters and degrees, and a reconstruction
shows every surface twice. This is direct bundle adjustment of RGB-D frames (Kerl, Sturm and Cremers
2013; Schops, Sattler and Pollefeys 2019), by Gauss-Newton, of all frames at once.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.sparse import coo_matrix, csc_matrix, eye, kron
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.progress import Progress, say
from splatpilot.training.captures.capture import (
    Capture,
    cache_folder,
    cache_key,
    prepare_cache,
    shrink,
    shrink_factor,
)
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frame_comparison import (
    REACH,
    WIDTH,
    ComparedFrame,
    Comparison,
    compare_frames,
)

_PARTNERS, _OVERLAP, _PROBES = 16, 0.2, 64
"""Maximum number of frames that each is compared with, and the fraction of so many of its points
that these must see."""
_REACHES = REACH, 0.06, 0.05, 0.04
"""Of the first rounds; the last of all later ones."""
_ROUNDS, _SETTLED = 30, 1e-3
"""Maximum number of rounds, and steps [m], [rad] below which they end."""
_SPREADS = np.array([0.01, 0.03])
"""Of residuals in the first round; later ones measure them."""
_INDEPENDENT = 10
"""Number of independent points that the points of a pair count for: neighbors share errors."""
_DRIFT, _BELIEF = 0.005, 0.1
"""[m], [rad] Standard deviations of the drift from one frame to the next, and of poses: what no
other frame constrains moves as the frames before and after it."""
_VERSION = 1
"""Of the result for the same frames."""


@dataclass(frozen=True, eq=False)
class RefinedPoses:
    """Poses, and the agreement of frames in them."""

    X_WCs: list[RigidTransform]
    moved: float  # [m], mean over frames
    rotated: float  # [rad], mean over frames
    depth: tuple[float, float]
    """Median relative difference of depth between frames, before and after."""
    contrast: tuple[float, float]
    """Median difference of contrast, before and after."""

    def __str__(self) -> str:
        rotated = np.rad2deg(self.rotated)
        lines = [f"poses moved by {self.moved:.3f} m and {rotated:.1f} degrees on average"]
        for name in ("depth", "contrast"):
            before, after = getattr(self, name)
            lines.append(f"{name} differs between frames by {after:.2%}, before by {before:.2%}")
        return "; ".join(lines)


def refine_poses(frames: Sequence[ComparedFrame], X_WCs: Iterable[RigidTransform]) -> RefinedPoses:
    """Returns the poses of the smallest squared residuals over their spreads, see `Comparison`.

    This removes drift of centimeters and of a degree or two, not lost tracking: points whose depths
    differ by more than 8 % are not compared. Robust weights as narrow as the noise of a sensor
    would keep frames where they are.

    Args:
        frames: in the order in which they were taken.
        X_WCs: their poses.

    Raises:
        ValueError: if no two frames see the same.
    """
    poses = given = list(X_WCs)
    pairs = _pairs(frames, poses)
    spreads = _SPREADS
    history = []
    with Progress(range(_ROUNDS), "refining poses", unit="round") as rounds:
        for number in rounds:
            reach = _REACHES[min(number, len(_REACHES) - 1)]
            terms, differences = [], []
            for i, j in pairs:
                found = compare_frames(frames[i], frames[j], poses[i], poses[j], reach)
                if found is not None:
                    terms.append(_Term.of(i, j, found, spreads))
                    differences.append(np.median(np.abs(found.residuals), axis=1))
            if not terms:
                raise ValueError(
                    "no two frames see the same surfaces, so poses cannot be refined; look at what "
                    "`splatpilot capture check` says of them"
                )
            history.append(np.median(differences, axis=0))
            step = _step(terms, _corrections(poses, given))
            poses = [_moved(X_WC, by) for X_WC, by in zip(poses, step, strict=True)]
            # A median of absolute values is that of a normal distribution times 0.6745.
            spreads = np.maximum(history[-1] / 0.6745, 1e-4)
            largest = np.abs(step).max()
            rounds.set_postfix_str(f"largest step {largest:.4f}")
            if number >= len(_REACHES) and largest < _SETTLED:
                break
    rotated, moved = np.split(_corrections(poses, given), 2, axis=1)
    (depth, contrast), (depth_after, contrast_after) = history[0].tolist(), history[-1].tolist()
    return RefinedPoses(
        poses,
        float(np.linalg.norm(moved, axis=1).mean()),
        float(np.linalg.norm(rotated, axis=1).mean()),
        (depth, depth_after),
        (contrast, contrast_after),
    )


def _pairs(
    frames: Sequence[ComparedFrame], X_WCs: Sequence[RigidTransform]
) -> list[tuple[int, int]]:
    """Returns pairs of each frame with frames that see it: most of the nearest in the sequence, and
    fewer of those farther away."""
    X_CWs = np.array([X_WC.inverse().GetAsMatrix34() for X_WC in X_WCs])
    pairs = []
    for i in Progress(range(len(frames)), "comparing frames", unit="frame"):
        p_WQ = X_WCs[i].multiply(frames[i].p_CQ[:_PROBES].T)
        if p_WQ.size < 3 * _PROBES:
            continue
        p_CQs = X_CWs[:, :, :3] @ p_WQ + X_CWs[:, :, 3:]  # (N, 3, n)
        seeing = [
            j
            for j in np.flatnonzero(_inside(frames[i], p_CQs).mean(axis=1) > _OVERLAP).tolist()
            if j != i and frames[j].sees(p_CQs[j].T)[0].mean() > _OVERLAP
        ]
        seeing.sort(key=lambda j: abs(j - i))
        ranks = np.geomspace(1, max(len(seeing), 1), _PARTNERS).round().astype(int)
        pairs += [(i, seeing[rank - 1]) for rank in np.unique(ranks) if seeing]
    return pairs


def _inside(frame: ComparedFrame, p_CQs: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns which points p_CQ (..., 3, n) fall into the image of a frame, (..., n)."""
    height, width = frame.contrast.shape
    x, y, z = np.moveaxis(frame.K @ p_CQs, -2, 0)
    return (z > 0) & (x > 0) & (x < width * z) & (y > 0) & (y < height * z)


@dataclass(frozen=True, eq=False)
class _Term:
    """The part of one pair in the normal equations of all frames, six unknowns each."""

    unknowns: NDArray[np.intp]  # (12,), their indices
    hessian: NDArray[np.float64]  # (12, 12), of Gauss-Newton
    gradient: NDArray[np.float64]  # (12,)

    @classmethod
    def of(cls, i: int, j: int, found: Comparison, spreads: NDArray[np.float64]) -> "_Term":
        weight = np.sqrt(_INDEPENDENT / found.residuals.shape[1]) / spreads
        J = (found.derivatives * weight[:, None, None]).reshape(-1, 12)
        unknowns = np.add.outer([6 * i, 6 * j], np.arange(6)).ravel()
        return cls(unknowns, J.T @ J, J.T @ (found.residuals * weight[:, None]).ravel())


def _step(terms: Sequence[_Term], corrections: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the step (N, 6) of Gauss-Newton from poses with `corrections` (N, 6) so far."""
    count = len(corrections)
    unknowns = np.array([term.unknowns for term in terms])
    hessians = np.array([term.hessian for term in terms])
    rows, columns = unknowns[:, :, None], unknowns[:, None, :]
    rows, columns = (np.broadcast_to(each, hessians.shape).ravel() for each in (rows, columns))
    H = coo_matrix((hessians.ravel(), (rows, columns)), shape=(6 * count, 6 * count))
    gradient = np.zeros(6 * count)
    np.add.at(gradient, unknowns, np.array([term.gradient for term in terms]))
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
    turns = [
        (X_WC.rotation() @ X_WG.rotation().inverse()).matrix()
        for X_WC, X_WG in zip(X_WCs, given, strict=True)
    ]
    moves = [
        X_WC.translation() - X_WG.translation() for X_WC, X_WG in zip(X_WCs, given, strict=True)
    ]
    return np.concatenate([Rotation.from_matrix(turns).as_rotvec(), moves], axis=1)


def refined_capture(capture: Capture, path: Path, config: CaptureConfig) -> Capture:
    """Returns a capture with refined poses of all its frames, held-out ones too; the cache keeps
    them.

    Args:
        capture: as read from `path`.

    Raises:
        ValueError, OSError: if it has no depth, no two frames see the same, or the cache cannot be
            written.
    """
    if not capture.has_depth:
        raise ValueError(
            f"{path}: capture.refine_poses needs depth, which this capture is without; omit it"
        )
    file = cache_folder(config, "poses") / f"poses-{_key(capture, path)}.npy"
    if not file.is_file():
        prepare_cache(file.parent)
        factor = shrink_factor(capture.width, WIDTH)
        numbers = Progress(range(len(capture)), "loading frames", unit="frame")
        frames = [ComparedFrame.of(shrink(capture.frame(i), factor)) for i in numbers]
        try:
            refined = refine_poses(frames, capture.X_WCs)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        say(f"{path}: {refined}")
        with written_atomically(file) as written, written.open("wb") as stream:
            np.save(stream, np.array([X_WC.GetAsMatrix34() for X_WC in refined.X_WCs]))
    X_WCs = [RigidTransform(RotationMatrix(X[:, :3]), X[:, 3]) for X in np.load(file)]
    return replace(capture, X_WCs=X_WCs)


def _key(capture: Capture, path: Path) -> str:
    """Returns the cache key of a capture, by its files and their reading."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    parts = [capture.K, *(X_WC.GetAsMatrix34() for X_WC in capture.X_WCs)]
    if capture.depth_camera is not None:
        parts += [capture.depth_camera.K, capture.depth_camera.X_CD.GetAsMatrix34()]
    read = hashlib.sha256(b"".join(each.tobytes() for each in parts)).hexdigest()
    return cache_key((file for file in files if file.is_file()), _VERSION, np.__version__, read)
