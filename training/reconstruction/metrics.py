"""Metrics of rendered views against captured frames: color, depth, floaters and holes."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from splatpilot.systems.splats.background import FAR, Background, RenderedView, put_behind
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.losses import ssim_map
from splatpilot.training.reconstruction.lpips import Lpips
from splatpilot.training.reconstruction.photometry import vignette

_MIN_DEPTH = 1e-3  # [m], minimum true depth that counts, as in `log_depth_loss`
_FLOATER_MARGIN = 0.1  # [m], and as a fraction of the true depth
_SHOWN = {
    "psnr_db": "{:.2f} dB",
    "depth_mae_m": "{:.4f} m",
    "hole_fraction": "{:.2%} holes",
}


@dataclass(frozen=True)
class ViewMetrics:
    """Metrics of one view, over its valid pixels that a camera saw; see `depth_metrics` for those
    of depth. A metric without any pixel is None."""

    psnr_db: float | None  # [dB], before the scene's background
    psnr_on_black_db: float | None  # [dB], before black, except in the sky
    ssim: float | None
    lpips: float | None  # LPIPS-squeeze; None without its weights, too
    depth_mae_m: float | None  # [m]
    depth_relative: float | None
    floater_fraction: float | None
    hole_fraction: float | None
    unseen_fraction: float  # of all pixels, those left out
    gain: float  # brightness of the true image relative to the scene


@dataclass(frozen=True)
class HeldOutMetrics:
    """Metrics of the held-out frames of a reconstruction."""

    views: tuple[ViewMetrics, ...]

    def means(self) -> dict[str, float]:
        """Returns the mean PSNR and, with depth, the mean depth error and hole fraction."""
        found = {name: mean_metric(self.views, name)[0] for name in _SHOWN}
        return {name: value for name, value in found.items() if value is not None}

    def __str__(self) -> str:
        return ", ".join(_SHOWN[name].format(value) for name, value in self.means().items())


def mean_metric(views: Iterable[ViewMetrics], name: str) -> tuple[float | None, int]:
    """Returns the mean of a metric over the views that have it, or None, and their number."""
    known = [value for view in views if (value := getattr(view, name)) is not None]
    return (float(np.mean(known)) if known else None), len(known)


def psnr_db(image: NDArray, truth: NDArray) -> float | None:
    """Returns -10 log10 of the mean squared difference of images in [0, 1]; infinite if equal, None
    without pixels."""
    if not np.size(truth):
        return None
    with np.errstate(divide="ignore"):
        difference = np.asarray(image, np.float64) - truth
        return float(-10 * np.log10(np.mean(difference**2)))


def ssim(image: NDArray, truth: NDArray, seen: NDArray[np.bool_]) -> float | None:
    """Returns the mean structural similarity of images (H, W, 3) in [0, 1], as in
    `photometric_loss`, over the pixels `seen` (H, W); None without pixels."""
    if not seen.any():
        return None
    a, b = (torch.from_numpy(np.ascontiguousarray(x, np.float32)) for x in (image, truth))
    values = ssim_map(a, b)[0].mean(0).numpy()
    return float(values[seen].mean(dtype=np.float64))


def has_true_depth(truth: NDArray) -> NDArray[np.bool_]:
    """Returns where the true depth (H, W) [m] counts."""
    return (truth > _MIN_DEPTH) & (truth < FAR)


def depth_metrics(depth: NDArray, truth: NDArray) -> dict[str, float | None]:
    """Compares the depth (H, W) [m] of cameras of unlimited range, 0 in a hole, with the truth.

    Over pixels with true depth: the mean absolute error [m], which is the true depth in a hole; the
    mean of |error| / true depth; the fraction of `floaters`; and the fraction of holes, which
    policies take for free space. None without any.
    """
    known = has_true_depth(truth)
    error = np.abs(depth[known] - truth[known])
    metrics = {
        "depth_mae_m": error,
        "depth_relative": error / truth[known],
        "floater_fraction": floaters(depth, truth)[known],
        "hole_fraction": depth[known] == 0,
    }
    return {
        name: float(values.mean(dtype=np.float64)) if len(values) else None
        for name, values in metrics.items()
    }


def floaters(depth: NDArray, truth: NDArray) -> NDArray[np.bool_]:
    """Returns the pixels (H, W) that show a surface in front of the true one, an obstacle to a
    policy: at a depth below D - max(0.1 m, D / 10), with the true depth D.

    The relative margin is for edges, which may be off by pixels; the absolute one, because nothing
    flies within 0.1 m of a surface.
    """
    margin = _FLOATER_MARGIN * np.maximum(1, truth)
    with np.errstate(invalid="ignore"):
        in_front = depth < truth - margin
    return has_true_depth(truth) & in_front & (depth > 0)


def fit_exposure(
    color: NDArray,
    truth: NDArray,
    vignetting: float,
    seen: NDArray[np.bool_],
    gain: float | None = None,
) -> tuple[NDArray, float]:
    """Returns a rendered image (H, W, 3) with vignetting and exposure of the camera, and its gain.
    Without a `gain`, it is the least-squares fit to the true image over the pixels `seen` (H, W),
    because the exposure of a held-out frame does not depend on the scene."""
    height, width = color.shape[:2]
    image = np.clip(color, 0, None) * vignette(vignetting, width, height)[..., None]
    if gain is None:
        x, y = image[seen], truth[seen]
        energy = float((x * x).sum())
        gain = float((x * y).sum()) / energy if energy > 0 else 1.0
    return np.clip(gain * image, 0, 1), gain


def measure_view(
    on_black: RenderedView,
    background: Background,
    frame: CaptureFrame,
    vignetting: float = 0.0,
    seen: NDArray[np.bool_] | None = None,
    lpips: Lpips | None = None,
    *,
    gain: float | None = None,
) -> ViewMetrics:
    """Compares a view that is rendered before black with the frame of its camera: colors after
    `fit_exposure`, by default over all pixels, else over those `seen` (H, W). The windows of SSIM
    and LPIPS reach over others."""
    truth, sky = frame.image / 255, frame.depth >= FAR
    seen = frame.valid if seen is None else seen & frame.valid
    camera = truth, vignetting, seen, gain
    view = put_behind(on_black, background, frame.K, frame.X_WC)
    exposed, gain = fit_exposure(view.color, *camera)
    before_black = np.where(sky[..., None], view.color, on_black.color)
    exposed_before_black, _ = fit_exposure(before_black, *camera)
    distance = None
    if lpips is not None and seen.any():
        tensors = [torch.from_numpy(x.astype(np.float32)) for x in (exposed, truth, seen)]
        with torch.no_grad():
            distance = lpips(*tensors).item()
    return ViewMetrics(
        psnr_db=psnr_db(exposed[seen], truth[seen]),
        psnr_on_black_db=psnr_db(exposed_before_black[seen], truth[seen]),
        ssim=ssim(exposed, truth, seen),
        lpips=distance,
        **depth_metrics(view.depth, np.where(seen, frame.depth, 0)),
        unseen_fraction=float(1 - seen.mean()),
        gain=gain,
    )
