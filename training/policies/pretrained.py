"""Weights of MobileNetV2 that learned to tell what is in photographs, to begin with."""

import os
from pathlib import Path

import torch
from torch import Tensor

from splatpilot.systems.policies.mobilenet import mobilenet_blocks

IN_DATA = Path("weights") / "mobilenet_v2_imagenet.pt"
"""In the folder `$SPLATPILOT_DATA`."""

_DOWNLOADED = Path("checkpoints") / "mobilenet_v2-7ebf99e0.pth"
"""What torchvision's `mobilenet_v2(weights="DEFAULT")` leaves in torch's folder."""

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""[-] Of the images that torchvision's weights were trained with, 0 to 1."""


def imagenet_weights(file: str = "") -> dict[str, Tensor]:
    """
    The encoder's weights by the names of `mobilenet_shapes`, for images of -1 to 1.

    Batch norms are folded into the convolutions before them. The input scaling of torchvision's
    weights, (x - mean) / std of each channel, is folded into the first, but for its border: there
    padding stands for grey of -1 to 1 and not for the mean.

    Args:
        file: a state dictionary of torchvision's `mobilenet_v2`, as torch saves it; in one whose
            batch norms are folded already (variances of 1) images are -1 to 1. If empty,
            `$SPLATPILOT_DATA/weights/mobilenet_v2_imagenet.pt`, or else what torchvision has
            downloaded.

    Raises:
        FileNotFoundError: if there is no such file; the message says how to get one.
        ValueError: if it holds something else.
    """
    path = _find(file)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        return _folded({name: values.float() for name, values in state.items()})
    except Exception as error:
        raise ValueError(
            f"{path}: no weights of MobileNetV2 ({str(error)[:200]}); give a state dictionary of "
            "torchvision's mobilenet_v2"
        ) from None


def _find(file: str) -> Path:
    data = os.environ.get("SPLATPILOT_DATA")
    places = [Path(data) / IN_DATA] if data else []
    places = [Path(file)] if file else [*places, Path(torch.hub.get_dir()) / _DOWNLOADED]
    for path in places:
        if path.is_file():
            return path
    raise FileNotFoundError(
        f"no weights of MobileNetV2 at {' or '.join(map(str, places))}; download them with "
        "\"import torchvision; torchvision.models.mobilenet_v2(weights='DEFAULT')\", or train from "
        "nothing with pretrained=false"
    )


def _folded(state: dict[str, Tensor]) -> dict[str, Tensor]:
    weights: dict[str, Tensor] = {}
    scaled = True
    for block in mobilenet_blocks():
        for layer in block:
            norm = layer.bias.removesuffix("bias")
            variance, mean = state[f"{norm}running_var"], state[f"{norm}running_mean"]
            scale = state[f"{norm}weight"] / (variance + 1e-5).sqrt()
            scaled &= bool((variance - 1.0).abs().max() < 1e-3)
            weights[layer.weight] = state[layer.weight] * scale[:, None, None, None]
            weights[layer.bias] = state[layer.bias] - mean * scale
    if not scaled:
        first = mobilenet_blocks()[0][0]
        mean, std = torch.tensor(_MEAN), torch.tensor(_STD)
        filters = weights[first.weight] / std[:, None, None]
        weights[first.bias] += (filters.sum((2, 3)) * (0.5 - mean)).sum(1)
        weights[first.weight] = 0.5 * filters
    return weights
