"""LPIPS, the learned perceptual distance between images, on SqueezeNet or VGG."""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, conv2d

from splatpilot.systems.common.files import data_folder
from splatpilot.systems.common.validation import require

# ImageNet's, which LPIPS applies as a shift and a scale of images in [-1, 1].
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_MIN_SIZE = 17  # [px] for the last pooling

# SqueezeNet 1.1 (Iandola et al. 2016) and VGG-16 (Simonyan and Zisserman 2015) without classifiers,
# with torchvision's names of weights. Importing torchvision takes seconds and loads Triton, whose
# LLVM aborts the process if Mesa's OpenGL has loaded another.


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


def vgg_features() -> nn.Sequential:
    """Returns the untrained layers of VGG-16, (N, 3, H, W) to (N, 512, h, w)."""
    layers: list[nn.Module] = []
    inputs = 3
    for count, width in ((2, 64), (2, 128), (3, 256), (3, 512), (3, 512)):
        layers += [nn.MaxPool2d(2)] if layers else []
        for _ in range(count):
            layers += [nn.Conv2d(inputs, width, 3, padding=1), nn.ReLU()]
            inputs = width
    return nn.Sequential(*layers)


@dataclass(frozen=True)
class _Backbone:
    """A network whose features are compared after the layers `taps`, of so many `channels`."""

    layers: Callable[[], nn.Sequential]
    taps: tuple[int, ...]
    channels: tuple[int, ...]
    key: str  # of its state dict in the file of all weights, and its name in torchvision
    download: str  # file of torchvision


_BACKBONES = {
    "squeeze": _Backbone(
        squeezenet_features,
        (1, 4, 7, 9, 10, 11, 12),
        (64, 128, 256, 384, 384, 512, 512),
        "squeezenet1_1",
        "squeezenet1_1-b8a52dc0.pth",
    ),
    "vgg": _Backbone(
        vgg_features,
        (3, 8, 15, 22, 29),
        (64, 128, 256, 512, 512),
        "vgg16",
        "vgg16-397923af.pth",
    ),
}


class Lpips:
    """LPIPS v0.1 with the SqueezeNet 1.1 or VGG-16 backbone (Zhang et al., "The Unreasonable
    Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018).

    With f_l the features of layer l, each pixel's scaled to unit length over channels, the distance
    is the sum over layers of the mean over pixels of w_l . (f_l(a) - f_l(b))^2. Distances of
    different backbones are not comparable. Weights of "squeeze" are `{"squeezenet1_1": state dict,
    "lin": state dict}` in `$SPLATPILOT_DATA/weights/lpips_squeeze.pt`, those of "vgg" `{"vgg16":
    ..., "lin": ...}` in `lpips_vgg.pt`. Without the file they are torchvision's downloaded backbone
    with the linear layers of the installed package `lpips`.
    """

    def __init__(self, backbone: str = "squeeze"):
        self._backbone, self._source = backbone, _find_weights(backbone)
        _load(backbone, self._source, torch.device("cpu"))

    def __call__(self, a: Tensor, b: Tensor, weights: Tensor | None = None) -> Tensor:
        """Returns the distance of two images (..., H, W, 3) float32, RGB in [0, 1], a scalar at
        least 0, differentiable in `a`; that of several is their mean. `weights` (..., H, W) of the
        pixels are averaged over each cell of a layer; equal by default, as published."""
        valid = a.shape == b.shape and a.ndim >= 3 and a.shape[-1] == 3
        require(
            valid and min(a.shape[-3:-1]) >= _MIN_SIZE,
            "images",
            f"(..., H, W, 3) of one size of at least {_MIN_SIZE} pixels",
            f"{tuple(a.shape)} and {tuple(b.shape)}",
        )
        layers, linear = _load(self._backbone, self._source, a.device)
        taps = _BACKBONES[self._backbone].taps
        features = _features(layers, taps, a)
        with torch.no_grad():
            other_features = _features(layers, taps, b)
        distances = [
            _weighted_mean(conv2d((x - y).square(), w), weights)
            for x, y, w in zip(features, other_features, linear, strict=True)
        ]
        return torch.stack(distances).sum()


def _weighted_mean(distances: Tensor, weights: Tensor | None) -> Tensor:
    """Returns the mean of a layer's distances (N, 1, h, w), weighted by pixels (..., H, W)."""
    if weights is None:
        return distances.mean()
    images = weights.reshape(-1, 1, *weights.shape[-2:])
    height, width = distances.shape[-2:]
    shares = adaptive_avg_pool2d(images, (height, width))
    return (shares * distances).sum() / shares.sum()


def _features(layers: nn.Sequential, taps: tuple[int, ...], images: Tensor) -> list[Tensor]:
    """Returns the features of images (..., H, W, 3), of unit length over channels."""
    x = images.reshape(-1, *images.shape[-3:])
    x = ((x - x.new_tensor(_MEAN)) / x.new_tensor(_STD)).movedim(-1, 1)
    features = []
    for i, layer in enumerate(layers):
        x = layer(x)
        if i in taps:
            features.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10))
    return features


def _find_weights(name: str) -> tuple[Path, ...]:
    data, file = data_folder(), f"weights/lpips_{name}.pt"
    if data is not None and (data / file).is_file():
        return (data / file,)
    network = _BACKBONES[name]
    backbone = Path(torch.hub.get_dir()) / "checkpoints" / network.download
    package = importlib.util.find_spec("lpips")
    if backbone.is_file() and package is not None and package.origin is not None:
        return (backbone, Path(package.origin).parent / "weights" / "v0.1" / f"{name}.pth")
    raise FileNotFoundError(
        f"LPIPS has no weights: neither $SPLATPILOT_DATA/{file} nor torchvision's {backbone} with "
        "the package `lpips` exists; run `pip install lpips` and `python -c "
        f"\"import torchvision; torchvision.models.{network.key}(weights='DEFAULT')\"` once"
    )


@cache
def _load(
    name: str, source: tuple[Path, ...], device: torch.device
) -> tuple[nn.Sequential, list[Tensor]]:
    """Returns the layers of the backbone and the weights of the linear layers, (1, C, 1, 1)."""
    network = _BACKBONES[name]
    try:
        files = [torch.load(file, map_location="cpu", weights_only=True) for file in source]
        backbone, linear = (files[0][network.key], files[0]["lin"]) if len(files) == 1 else files
        layers = network.layers()
        names = (name for name in backbone if name.startswith("features."))
        layers.load_state_dict({n.removeprefix("features."): backbone[n].float() for n in names})
        weights = [linear[f"lin{i}.model.1.weight"].float() for i in range(len(network.taps))]
        if [w.shape for w in weights] != [(1, channels, 1, 1) for channels in network.channels]:
            raise ValueError("linear layers have other sizes")
    except Exception as error:  # unpickling may raise anything
        raise ValueError(
            f"{' and '.join(map(str, source))}: no LPIPS-{name} weights ({str(error)[:200]}); "
            "get them again"
        ) from error
    layers.requires_grad_(False).eval().to(device)
    return layers, [w.to(device) for w in weights]
