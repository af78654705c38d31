"""Gaussians of foreign files, of which a few may be damaged."""

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
) -> GaussianScene:
    """The Gaussians of a file without those that are damaged, whose number is logged.

    Args:
        path: the file, for messages.
        means, quats, scales, opacities, sh: as in `GaussianScene`, not yet checked.

    Raises:
        ValueError: if there are none, or more than `MAX_DAMAGED` of them are damaged.
    """
    if len(means) == 0:
        raise ValueError(f"{path}: holds no Gaussians; export the scene again")
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
    return GaussianScene(*arrays)
