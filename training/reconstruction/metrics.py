"""Metrics of rendered views against captured frames: color, LPIPS, depth, floaters and holes."""

import importlib.util
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, conv2d

from splatpilot.systems.common.files import data_folder
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.background import FAR, Background, RenderedView, put_behind
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.losses import ssim_map
from splatpilot.training.reconstruction.photometry import vignette

# ImageNet's, which LPIPS applies as a shift and a scale of images in [-1, 1].
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_MIN_SIZE = 17  # [px] for the last pooling

# SqueezeNet 1.1 (Iandola et al. 2016) without its classifier, with torchvision's names of weights.
# Torchvision loads Triton, whose LLVM aborts the process if Mesa's OpenGL has loaded another.


class Fire(nn.Module):
    """A 1x1 convolution to few channels, then parallel 1x1 and 3x3 convolutions to many."""

    def __init__(self, inputs: int, narrow: int, wide: int):
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, narrow, 1)
        self.expand1x1 = nn.Conv2d(narrow, wide, 1)
        self.expand3x3 = nn.Conv2d(narrow, wide, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.squeeze(x).relu()
        return torch.cat([self.expand1x1(x).relu(), self.expand3x3(x).relu()], 1)


def squeezenet_features() -> nn.Sequential:
    """Returns the untrained layers of SqueezeNet, (N, 3, H, W) to (N, 512, h, w)."""

    def pool() -> nn.MaxPool2d:
        return nn.MaxPool2d(3, 2, ceil_mode=True)

    return nn.Sequential(
        *(nn.Conv2d(3, 64, 3, 2), nn.ReLU(), pool()),
        *(Fire(64, 16, 64), Fire(128, 16, 64), pool()),
        *(Fire(128, 32, 128), Fire(256, 32, 128), pool()),
        *(Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)),
    )


_TAPS = 1, 4, 7, 9, 10, 11, 12
"""The layers whose features are compared."""
_CHANNELS = 64, 128, 256, 384, 384, 512, 512
_FILE = Path("weights", "lpips_squeeze.pt")


class Lpips:
    """LPIPS v0.1 with the SqueezeNet 1.1 backbone (Zhang et al., "The Unreasonable Effectiveness
    of Deep Features as a Perceptual Metric", CVPR 2018): the sum over layers of the mean over
    pixels of w_l . (f_l(a) - f_l(b))^2, with features f_l of unit length.

    Weights are `{"squeezenet1_1": state dict, "lin": state dict}` in `lpips_squeeze.pt` of
    `$SPLATPILOT_DATA/weights`, or else torchvision's downloaded backbone with the linear layers of
    the installed package `lpips`.
    """

    def __init__(self) -> None:
        self._source = _find_weights()
        _load(self._source, torch.device("cpu"))

    def __call__(self, a: Tensor, b: Tensor, weights: Tensor | None = None) -> Tensor:
        """Returns the mean distance, differentiable in `a`, of images (..., H, W, 3) float32, RGB
        in [0, 1]. `weights` (..., H, W) of pixels are equal by default, as published."""
        valid = a.shape == b.shape and a.ndim >= 3 and a.shape[-1] == 3
        require(
            valid and min(a.shape[-3:-1]) >= _MIN_SIZE,
            "images",
            f"(..., H, W, 3) of one size of at least {_MIN_SIZE} pixels",
            f"{tuple(a.shape)} and {tuple(b.shape)}",
        )
        layers, linear = _load(self._source, a.device)
        features = _features(layers, a)
        with torch.no_grad():
            other_features = _features(layers, b)
        means = []
        for x, y, w in zip(features, other_features, linear, strict=True):
            distances = conv2d((x - y).square(), w)  # (N, 1, h, w)
            if weights is None:
                means.append(distances.mean())
                continue
            images = weights.reshape(-1, 1, *weights.shape[-2:])
            shares = adaptive_avg_pool2d(images, distances.shape[-2:])  # pyright: ignore
            means.append((shares * distances).sum() / shares.sum())
        return torch.stack(means).sum()


def _features(layers: nn.Sequential, images: Tensor) -> list[Tensor]:
    """Returns the features of images (..., H, W, 3), of unit length over channels."""
    x = images.reshape(-1, *images.shape[-3:])
    x = ((x - x.new_tensor(_MEAN)) / x.new_tensor(_STD)).movedim(-1, 1)
    features = []
    for i, layer in enumerate(layers):
        x = layer(x)
        if i in _TAPS:
            features.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10))
    return features


def _find_weights() -> tuple[Path, ...]:
    data = data_folder()
    if data is not None and (data / _FILE).is_file():
        return (data / _FILE,)
    backbone = Path(torch.hub.get_dir()) / "checkpoints" / "squeezenet1_1-b8a52dc0.pth"
    package = importlib.util.find_spec("lpips")
    if backbone.is_file() and package is not None and package.origin is not None:
        return (backbone, Path(package.origin).parent / "weights" / "v0.1" / "squeeze.pth")
    raise FileNotFoundError(
        f"LPIPS has no weights: neither $SPLATPILOT_DATA/{_FILE} nor torchvision's {backbone} with "
        "the package `lpips` exists; run `pip install lpips` and `python -c "
        "\"import torchvision; torchvision.models.squeezenet1_1(weights='DEFAULT')\"` once"
    )


@cache
def _load(source: tuple[Path, ...], device: torch.device) -> tuple[nn.Sequential, list[Tensor]]:
    """Returns the layers of the backbone and the weights of the linear layers, (1, C, 1, 1)."""
    try:
        files = [torch.load(file, map_location="cpu", weights_only=True) for file in source]
        if len(files) == 1:
            files = [files[0][name] for name in ("squeezenet1_1", "lin")]
        backbone, linear = files
        layers = squeezenet_features()
        names = (name for name in backbone if name.startswith("features."))
        layers.load_state_dict({n.removeprefix("features."): backbone[n].float() for n in names})
        weights = [linear[f"lin{i}.model.1.weight"].float() for i in range(len(_TAPS))]
        if [w.shape for w in weights] != [(1, channels, 1, 1) for channels in _CHANNELS]:
            raise ValueError("linear layers have other sizes")
    except Exception as error:  # unpickling may raise anything
        raise ValueError(
            f"{' and '.join(map(str, source))}: no LPIPS-squeeze weights ({str(error)[:200]}); "
            "get them again"
        ) from error
    layers.requires_grad_(False).eval().to(device)
    return layers, [w.to(device) for w in weights]


_MIN_DEPTH = 1e-3  # [m], minimum true depth that counts, as in `log_depth_loss`
_FLOATER_MARGIN = 0.1  # [m], and as a fraction of the true depth
_SHOWN = {"psnr_db": "{:.2f} dB", "depth_mae_m": "{:.4f} m", "hole_fraction": "{:.2%} holes"}


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
    """Returns -10 log10 of the mean squared difference of images in [0, 1]; None without pixels."""
    if not np.size(truth):
        return None
    with np.errstate(divide="ignore"):
        difference = np.asarray(image, np.float64) - truth
        return float(-10 * np.log10(np.mean(difference**2)))


def ssim(image: NDArray, truth: NDArray, seen: NDArray[np.bool_]) -> float | None:
    """Returns the mean SSIM of images (H, W, 3) over the pixels `seen` (H, W); None without any."""
    if not seen.any():
        return None
    a, b = (torch.from_numpy(np.ascontiguousarray(x, np.float32)) for x in (image, truth))
    values = ssim_map(a, b)[0].mean(0).numpy()
    return float(values[seen].mean(dtype=np.float64))


def has_true_depth(truth: NDArray) -> NDArray[np.bool_]:
    """Returns where the true depth (H, W) [m] counts."""
    return (truth > _MIN_DEPTH) & (truth < FAR)


def depth_metrics(depth: NDArray, truth: NDArray) -> dict[str, float | None]:
    """Compares depth (H, W) [m], 0 in a hole, with the truth, over pixels with true depth: the mean
    absolute error [m], which is the true depth in a hole; the mean of |error| / true depth; and the
    fractions of `floaters` and of holes, which policies take for free space. None without any."""
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
    policy: at a depth below D - max(0.1 m, D / 10), with the true depth D."""
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
    """Returns a rendered image (H, W, 3) with vignetting and exposure of the camera, and its gain,
    by default the least-squares fit to the true image over the pixels `seen` (H, W)."""
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
    `fit_exposure`, over all pixels or those `seen` (H, W). Windows of SSIM and LPIPS reach on."""
    truth, sky = frame.image / 255, frame.depth >= FAR
    seen = frame.valid if seen is None else seen & frame.valid
    camera = truth, vignetting, seen, gain
    view = put_behind(on_black, background, frame.slopes, frame.X_WC)
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
