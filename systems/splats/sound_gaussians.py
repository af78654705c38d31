"""Gaussians of foreign files, of which a few may be damaged."""

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.far_origin import choose_origin
from splatpilot.systems.splats.gaussian_scene import GaussianScene

_log = logging.getLogger(__name__)

MAX_DAMAGED = 0.2
"""The largest part of a file's Gaussians that is left out without refusing the file."""


def sound_gaussians(
    path: Path,
    means: NDArray,
    quats: NDArray,
    scales: NDArray,
    opacities: NDArray,
    sh: NDArray,
    recenter: bool = True,
) -> GaussianScene:
    """The Gaussians of a file without those that are damaged, whose number is logged, and so is the
    new origin of those that are far from 0, see `choose_origin`.

    Args:
        path: the file, for messages.
        means, quats, scales, opacities, sh: as in `GaussianScene`, not yet checked.
        recenter: whether the origin may move.

    Raises:
        ValueError: if there are none, or more than `MAX_DAMAGED` of them are damaged.
    """
    if len(means) == 0:
        raise ValueError(f"{path}: holds no Gaussians; export the scene again")
    origin = (0.0, 0.0, 0.0)
    if recenter and len(known := means[np.isfinite(means).all(axis=1)]):
        x, y, z = choose_origin(np.asarray(known, dtype=np.float64)).tolist()
        if origin != (x, y, z):
            origin, means = (x, y, z), means - np.array([x, y, z])
            where = ", ".join(f"{each:.10g}" for each in origin)
            _log.warning(
                "%s: positions are relative to %s, about which its Gaussians are", path, where
            )
    with np.errstate(over="ignore", invalid="ignore"):
        arrays = [np.asarray(a, np.float32) for a in (means, quats, scales, opacities, sh)]
        finite = [np.isfinite(a.reshape(len(a), -1)).all(axis=1) for a in arrays]
        turns = np.linalg.norm(arrays[1].astype(float), axis=1) > 1e-6
        visible = (arrays[3] > 0) & (arrays[3] <= 1)
    sound = np.logical_and.reduce([*finite, turns, (arrays[2] > 0).all(axis=1), visible])
    damaged = int((~sound).sum())
    if damaged > MAX_DAMAGED * len(sound):
        try:
            return GaussianScene(*arrays)  # which says of the first what is wrong
        except ValueError as error:
            raise ValueError(
                f"{path}: {damaged} of {len(sound)} Gaussians are damaged; {error}"
            ) from None
    if damaged:
        _log.warning("%s: %d of %d Gaussians are damaged and left out", path, damaged, len(sound))
        arrays = [a[sound] for a in arrays]
    return GaussianScene(*arrays, origin=origin)
