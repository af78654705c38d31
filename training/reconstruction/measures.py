"""How far rendered views are from what a camera saw: in colour, in depth and in floaters."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.splats.baked_scene import BakedScene, RenderedView, create_renderer
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.training.reconstruction.losses import photometric_loss
from splatpilot.training.reconstruction.lpips import Lpips
from splatpilot.training.reconstruction.splat_rendering import render
from splatpilot.training.reconstruction.vignette import vignette

NEAR, FAR = 1e-3, 150.0
"""[m], true depths that count: the range of `log_depth_loss`."""

FLOATER_MARGIN = 0.1
"""[m], and as a fraction of the true depth: how far in front of the true surface floaters are."""
FLOATER_ALPHA = 0.5


@dataclass(frozen=True)
class ViewMeasures:
    """One view against the truth. Depth is not measured where the truth has none."""

    psnr_db: float  # [dB]
    ssim: float
    lpips: float | None  # LPIPS-squeeze; None without its weights
    depth_mae_m: float | None  # [m]
    depth_relative: float | None  # mean of |error| / true depth
    floater_fraction: float | None  # of the pixels with true depth
    gain: float  # brightness of the true image relative to the scene


@dataclass(frozen=True)
class HeldOutMeasures:
    """The frames that were withheld from a reconstruction, against what it shows."""

    views: tuple[ViewMeasures, ...]

    def means(self) -> dict[str, float]:
        """Returns the mean PSNR and, where there is depth, the mean depth error, by name."""
        found = {name: mean_measure(self.views, name) for name in ("psnr_db", "depth_mae_m")}
        return {name: value for name, value in found.items() if value is not None}

    def __str__(self) -> str:
        units = {"psnr_db": "{:.2f} dB", "depth_mae_m": "{:.4f} m"}
        return ", ".join(units[name].format(value) for name, value in self.means().items())


def mean_measure(views: Iterable[ViewMeasures], name: str) -> float | None:
    """Returns the mean of a measure over the views that have it; None if none has."""
    known = [value for view in views if (value := getattr(view, name)) is not None]
    return float(np.mean(known)) if known else None


def psnr_db(image: NDArray, truth: NDArray) -> float:
    """Returns -10 log10 of the mean squared difference of images in [0, 1]; infinite if equal."""
    with np.errstate(divide="ignore"):
        difference = np.asarray(image, np.float64) - truth
        return float(-10 * np.log10(np.mean(difference**2)))


def ssim(image: NDArray, truth: NDArray) -> float:
    """Returns the mean structural similarity of images (H, W, 3) in [0, 1], 1 if they are equal.

    As in `photometric_loss`: a Gaussian window of 11 pixels, zeros outside the image.
    """
    a, b = (torch.from_numpy(np.ascontiguousarray(x, np.float32)) for x in (image, truth))
    return 1 - photometric_loss(a, b, ssim_weight=1.0).item()


def has_true_depth(truth: NDArray) -> NDArray[np.bool_]:
    """Returns where the true depth (H, W) [m] counts: between `NEAR` and `FAR`."""
    return (truth > NEAR) & (truth < FAR)


def depth_mae_m(depth: NDArray, truth: NDArray) -> float | None:
    """Returns the mean absolute error [m] over the pixels that have true depth; None if none has.

    `depth` is the expected depth and 0 where nothing was drawn: a hole is wrong by all of its
    depth.
    """
    valid = has_true_depth(truth)
    return float(np.abs(depth - truth)[valid].mean(dtype=np.float64)) if valid.any() else None


def depth_relative(depth: NDArray, truth: NDArray) -> float | None:
    """Returns the mean of |error| / true depth over the same pixels as `depth_mae_m`."""
    valid = has_true_depth(truth)
    if not valid.any():
        return None
    return float((np.abs(depth - truth)[valid] / truth[valid]).mean(dtype=np.float64))


def floaters(depth: NDArray, alpha: NDArray, truth: NDArray) -> NDArray[np.bool_]:
    """Returns which pixels (H, W) show a floater.

    A pixel with true depth D does if the rendered surface stands in front of the true one, at a
    depth less than D - max(0.1 m, D / 10), and covers it by more than half (alpha > 1/2).

    The rendered surface is the expected depth sum w z / sum w, which is what depth cameras here
    show, so what a policy would take for an obstacle. A veil of little weight far in front counts
    as soon as it draws that depth forward by the margin, though the median depth would be behind it
    still. The margin leaves room for pixels that see both sides of an edge at a slight offset; a
    relative part is needed because such offsets grow with depth, an absolute one because nothing
    nearer than 0.1 m to a surface is flown through.
    """
    margin = FLOATER_MARGIN * np.maximum(1, truth)
    with np.errstate(invalid="ignore"):
        in_front = depth < truth - margin
    return has_true_depth(truth) & in_front & (alpha > FLOATER_ALPHA)


def floater_fraction(depth: NDArray, alpha: NDArray, truth: NDArray) -> float | None:
    """Returns the share of `floaters` among the pixels with true depth; None if none has any."""
    count = has_true_depth(truth).sum()
    return float(floaters(depth, alpha, truth).sum() / count) if count else None


def fit_exposure(color: NDArray, truth: NDArray, vignetting: float) -> tuple[NDArray, float]:
    """Returns a rendered image (H, W, 3) as the camera would have exposed it, and the gain.

    The corners are darkened by the vignetting of the capture, and all pixels multiplied by the one
    number that brings them closest to the true image (least squares): how a camera exposed a frame
    says nothing of the place, and for a frame that is withheld from the fit nobody knows it.
    """
    height, width = color.shape[:2]
    image = np.clip(color, 0, None) * vignette(vignetting, width, height)[..., None]
    energy = float((image * image).sum())
    gain = float((image * truth).sum()) / energy if energy > 0 else 1.0
    return np.clip(gain * image, 0, 1), gain


def measure_view(
    view: RenderedView,
    image: NDArray[np.uint8],
    depth: NDArray[np.float32],
    vignetting: float = 0.0,
    lpips: Lpips | None = None,
) -> ViewMeasures:
    """Compares a rendered view with what its camera saw.

    Colours are compared as `fit_exposure` exposes them.

    Args:
        view: what was rendered.
        image: (H, W, 3), the true image, of the same size.
        depth: (H, W) [m], the true depth.
        vignetting: of the capture, see `vignette`.
        lpips: the perceptual distance; None leaves it out.
    """
    truth = image / 255
    exposed, gain = fit_exposure(view.color, truth, vignetting)
    distance = None
    if lpips is not None:
        with torch.no_grad():
            a, b = (torch.from_numpy(x.astype(np.float32)) for x in (exposed, truth))
            distance = lpips(a, b).item()
    return ViewMeasures(
        psnr_db=psnr_db(exposed, truth),
        ssim=ssim(exposed, truth),
        lpips=distance,
        depth_mae_m=depth_mae_m(view.depth, depth),
        depth_relative=depth_relative(view.depth, depth),
        floater_fraction=floater_fraction(view.depth, view.alpha, depth),
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

    def render(
        self, K: NDArray, width: int, height: int, X_WC: RigidTransform, background: ArrayLike
    ) -> RenderedView:
        """Renders colour over the background, expected depth and alpha; see `BakedScene.render`."""
        if self._baked is not None:
            return self._baked.render(K, width, height, X_WC, background=background)
        with torch.no_grad():
            rendering = render(
                "2dgs",
                self._tensors,
                torch.tensor(X_WC.inverse().GetAsMatrix4(), dtype=torch.float32)[None],
                torch.tensor(K, dtype=torch.float32)[None],
                width,
                height,
                background=torch.tensor(np.asarray(background), dtype=torch.float32)[None],
                depth_mode="ED",
                renderer=self._renderer,
            )
        images = (rendering.color, rendering.depth, rendering.alpha)
        return RenderedView(*(image.numpy() for image in images))
