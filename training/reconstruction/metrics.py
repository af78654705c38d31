"""How far rendered views are from what a camera saw: in colour, in depth and in floaters."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.splats.background import FAR, Background, put_behind
from splatpilot.systems.splats.baked_scene import BakedScene, RenderedView, create_renderer
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.losses import ssim_map
from splatpilot.training.reconstruction.lpips import Lpips
from splatpilot.training.reconstruction.photometry import vignette
from splatpilot.training.reconstruction.splat_rendering import render

NEAR = 1e-3
"""[m], with `FAR` the range of true depths that count, as in `log_depth_loss`."""

FLOATER_MARGIN = 0.1
"""[m], and as a fraction of the true depth: how far in front of the true surface floaters are."""

_SHOWN = {
    "psnr_db": "{:.2f} dB",
    "depth_mae_m": "{:.4f} m",
    "hole_fraction": "{:.2%} holes",
}


@dataclass(frozen=True)
class ViewMeasures:
    """One view against the truth. Depth is not measured where the truth has none, and nothing in
    pixels that are left out because they are invalid or no camera saw what they show. A measure
    without any pixel is None."""

    psnr_db: float | None  # [dB], before the scene's own background
    psnr_on_black_db: float | None  # [dB], before black, except where the truth is infinitely far
    ssim: float | None
    lpips: float | None  # LPIPS-squeeze; None without its weights, too
    depth_mae_m: float | None  # [m]
    depth_relative: float | None  # mean of |error| / true depth
    floater_fraction: float | None  # of the pixels with true depth
    hole_fraction: float | None  # of the pixels with true depth
    unseen_fraction: float  # of all pixels, those left out
    gain: float  # brightness of the true image relative to the scene


@dataclass(frozen=True)
class HeldOutMeasures:
    """The held-out frames of a reconstruction, against what it shows."""

    views: tuple[ViewMeasures, ...]

    def means(self) -> dict[str, float]:
        """Returns the mean PSNR and, where there is depth, the mean depth error and share of
        holes, by name; see `mean_measure`."""
        found = {name: mean_measure(self.views, name)[0] for name in _SHOWN}
        return {name: value for name, value in found.items() if value is not None}

    def __str__(self) -> str:
        return ", ".join(_SHOWN[name].format(value) for name, value in self.means().items())


def mean_measure(views: Iterable[ViewMeasures], name: str) -> tuple[float | None, int]:
    """Returns the mean of a measure over the views that have it, None if none has, and their
    number."""
    known = [value for view in views if (value := getattr(view, name)) is not None]
    return (float(np.mean(known)) if known else None), len(known)


def psnr_db(image: NDArray, truth: NDArray) -> float | None:
    """Returns -10 log10 of the mean squared difference of images in [0, 1]; infinite if equal, None
    if there are no pixels."""
    if not np.size(truth):
        return None
    with np.errstate(divide="ignore"):
        difference = np.asarray(image, np.float64) - truth
        return float(-10 * np.log10(np.mean(difference**2)))


def ssim(image: NDArray, truth: NDArray, seen: NDArray[np.bool_] | None = None) -> float | None:
    """Returns the mean structural similarity of images (H, W, 3) in [0, 1], 1 if they are equal.

    As in `photometric_loss`: a Gaussian window of 11 pixels, zeros outside the image. The mean is
    over the pixels `seen` (H, W), or all; windows about them reach over others as they are. None
    if there are no pixels.
    """
    if seen is not None and not seen.any():
        return None
    a, b = (torch.from_numpy(np.ascontiguousarray(x, np.float32)) for x in (image, truth))
    values = ssim_map(a, b)[0].mean(0).numpy()
    return float((values if seen is None else values[seen]).mean(dtype=np.float64))


def has_true_depth(truth: NDArray) -> NDArray[np.bool_]:
    """Returns where the true depth (H, W) [m] counts: between `NEAR` and `FAR`."""
    return (truth > NEAR) & (truth < FAR)


def depth_mae_m(depth: NDArray, truth: NDArray) -> float | None:
    """Returns the mean absolute error [m] over the pixels that have true depth; None if none has.

    `depth` is what depth cameras in the scene have, before they cut it to their range, and 0 in a
    hole, which so is wrong by all of its depth.
    """
    valid = has_true_depth(truth)
    if not valid.any():
        return None
    return float(np.abs(depth[valid] - truth[valid]).mean(dtype=np.float64))


def depth_relative(depth: NDArray, truth: NDArray) -> float | None:
    """Returns the mean of |error| / true depth over the same pixels as `depth_mae_m`."""
    valid = has_true_depth(truth)
    if not valid.any():
        return None
    error = np.abs(depth[valid] - truth[valid])
    return float((error / truth[valid]).mean(dtype=np.float64))


def floaters(depth: NDArray, truth: NDArray) -> NDArray[np.bool_]:
    """Returns which pixels (H, W) show a floater.

    A pixel with true depth D does if depth cameras see a surface in front of the true one, at a
    depth less than D - max(0.1 m, D / 10): what a policy takes for an obstacle. The margin leaves
    room for pixels that see both sides of an edge at a slight offset; a relative part is needed
    because such offsets grow with depth, an absolute one because nothing nearer than 0.1 m to a
    surface is flown through.
    """
    margin = FLOATER_MARGIN * np.maximum(1, truth)
    with np.errstate(invalid="ignore"):
        in_front = depth < truth - margin
    return has_true_depth(truth) & in_front & (depth > 0)


def floater_fraction(depth: NDArray, truth: NDArray) -> float | None:
    """Returns the share of `floaters` among the pixels with true depth; None if none has any."""
    valid = has_true_depth(truth)
    return float(floaters(depth, truth)[valid].mean()) if valid.any() else None


def hole_fraction(depth: NDArray, truth: NDArray) -> float | None:
    """Returns the share of holes among the pixels with true depth; None if none has any.

    A hole is where depth cameras see nothing, so that a policy takes it for open.
    """
    valid = has_true_depth(truth)
    return float((depth == 0)[valid].mean()) if valid.any() else None


def fit_exposure(
    color: NDArray, truth: NDArray, vignetting: float, seen: NDArray[np.bool_] | None = None
) -> tuple[NDArray, float]:
    """Returns a rendered image (H, W, 3) as the camera would have exposed it, and the gain.

    The corners are darkened by the vignetting of the capture, and all pixels multiplied by the one
    number that brings those `seen` (H, W), or all, closest to the true image (least squares): how a
    camera exposed a frame says nothing about the scene, and for a held-out frame it is unknown.
    """
    image = _darken_corners(color, vignetting)
    x, y = (image, truth) if seen is None else (image[seen], truth[seen])
    energy = float((x * x).sum())
    gain = float((x * y).sum()) / energy if energy > 0 else 1.0
    return np.clip(gain * image, 0, 1), gain


def _darken_corners(color: NDArray, vignetting: float) -> NDArray:
    height, width = color.shape[:2]
    return np.clip(color, 0, None) * vignette(vignetting, width, height)[..., None]


def measure_view(
    on_black: RenderedView,
    background: Background,
    frame: CaptureFrame,
    vignetting: float = 0.0,
    seen: NDArray[np.bool_] | None = None,
    lpips: Lpips | None = None,
    *,
    fit_gain: bool = True,
) -> ViewMeasures:
    """Compares a rendered view with what its camera saw.

    Args:
        on_black: what was rendered, before black.
        background: of the scene.
        frame: the truth, of the same size.
        vignetting: of the capture, see `vignette`.
        seen: (H, W), the pixels to measure, if they are valid, see `seen_pixels`; all if None. SSIM
            and LPIPS are means over these, although their windows reach over others.
        lpips: the perceptual distance; None leaves it out.
        fit_gain: compares colors as `fit_exposure` exposes them; otherwise the gain is 1.
    """

    def expose(color: NDArray) -> tuple[NDArray, float]:
        if fit_gain:
            return fit_exposure(color, truth, vignetting, seen)
        return _darken_corners(color, vignetting).clip(max=1), 1.0

    truth, far = frame.image / 255, frame.depth >= FAR
    seen = frame.valid if seen is None else seen & frame.valid
    true_depth = np.where(seen, frame.depth, 0)
    view = put_behind(on_black, background, frame.K, frame.X_WC)
    before_black = np.where(far[..., None], view.color, on_black.color)
    exposed, gain = expose(view.color)
    exposed_before_black, _ = expose(before_black)
    distance = None
    if lpips is not None and seen.any():
        with torch.no_grad():
            tensors = (torch.from_numpy(x.astype(np.float32)) for x in (exposed, truth, seen))
            distance = lpips(*tensors).item()
    return ViewMeasures(
        psnr_db=psnr_db(exposed[seen], truth[seen]),
        psnr_on_black_db=psnr_db(exposed_before_black[seen], truth[seen]),
        ssim=ssim(exposed, truth, seen),
        lpips=distance,
        depth_mae_m=depth_mae_m(view.depth, true_depth),
        depth_relative=depth_relative(view.depth, true_depth),
        floater_fraction=floater_fraction(view.depth, true_depth),
        hole_fraction=hole_fraction(view.depth, true_depth),
        unseen_fraction=float(1 - seen.mean()),
        gain=gain,
    )


class SceneRenderer:
    """Renders a scene as what it is: Gaussians ("3dgs") or surfels ("2dgs")."""

    def __init__(self, scene: GaussianScene, representation: str, threads: int = 1):
        self._renderer = create_renderer(threads)
        self._baked = BakedScene(scene, threads) if representation == "3dgs" else None
        arrays = (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh)
        means, quats, scales, opacities, sh = map(torch.from_numpy, arrays)
        self._tensors = (means, quats, scales, opacities, sh)

    def render(self, K: NDArray, width: int, height: int, X_WC: RigidTransform) -> RenderedView:
        """Renders colour on black, depth and alpha; see `BakedScene.render`."""
        if self._baked is not None:
            return self._baked.render(K, width, height, X_WC)
        with torch.no_grad():
            rendering = render(
                "2dgs",
                self._tensors,
                torch.tensor(X_WC.inverse().GetAsMatrix4(), dtype=torch.float32)[None],
                torch.tensor(K, dtype=torch.float32)[None],
                width,
                height,
                depth_mode="MD",
                renderer=self._renderer,
            )
        images = (rendering.color, rendering.depth, rendering.alpha)
        return RenderedView(*(image.numpy() for image in images))
