"""The student's network for torch; `systems.policies.student_inference` flies it."""

import math
import os
from pathlib import Path

import torch
from torch import Tensor, nn
from torchvision.models import mobilenet_v2

from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS
from splatpilot.systems.policies.lattice import BASIS
from splatpilot.systems.policies.student import (
    BLOCKS,
    CHANNELS,
    FARTHEST,
    HYPOTHESES,
    NEAREST,
    STATE_SIZE,
    StudentSpec,
    adds_input,
    mobilenet_blocks,
)

IMAGE_MODULES = BLOCKS + 1
"""Modules that an image goes through: the encoder's, and the layer of its cells."""


class StudentModule(nn.Module):
    """The network of a `StudentSpec`, with the names of weights that `StudentNetwork` takes.

    The encoder is torchvision's, with a bias in the place of each batch norm: what is trained is
    what flies, and no sample depends on the others of its batch.
    """

    _basis: Tensor

    def __init__(self, spec: StudentSpec) -> None:
        super().__init__()
        self.spec = spec
        self.features = mobilenet_v2(norm_layer=_Bias).features
        self._initialize_encoder()
        self.cell_layer = nn.Linear(CHANNELS, spec.cell_features)
        self.state_layer = nn.Linear(STATE_SIZE, spec.state_features)
        self.state_layer_2 = nn.Linear(spec.state_features, spec.state_features)
        joined = spec.image_features() + spec.state_features
        if spec.head_features:
            self.hidden_layer = nn.Linear(joined, spec.head_features)
        self.head = nn.Linear(spec.head_features or joined, HYPOTHESES * (3 * NUM_WAYPOINTS + 1))
        self.register_buffer("_basis", torch.from_numpy(BASIS).float(), persistent=False)

    def _initialize_encoder(self) -> None:
        """Has numbers keep their size through the encoder, as no batch norm sees to it: a rectifier
        halves their squares, and modules that add their input begin with adding nothing."""
        weights = self.state_dict()
        for block in mobilenet_blocks():
            rectified = False
            for layer in block:
                kind = "relu" if rectified else "linear"
                nn.init.kaiming_normal_(weights[layer.weight], nonlinearity=kind)
                rectified = layer.rectified
            if adds_input(block):
                nn.init.zeros_(weights[block[-1].weight])

    def load_encoder(self, weights: dict[str, Tensor]) -> None:
        """Has the encoder begin with weights by the names of `mobilenet_shapes`."""
        with torch.no_grad():
            for name, value in self.state_dict().items():
                if name in weights:
                    value.copy_(weights[name])

    def image_modules(self, count: int) -> nn.ModuleList:
        """The first of the `IMAGE_MODULES`."""
        return nn.ModuleList([*self.features, self.cell_layer][:count])

    def freeze(self, count: int) -> None:
        """Has the first of the `IMAGE_MODULES` keep their weights."""
        self.image_modules(count).requires_grad_(False)

    def encode_image(self, image: Tensor, first: int = 0, last: int = IMAGE_MODULES) -> Tensor:
        """What the `IMAGE_MODULES` from `first` to before `last` make of images (N, 3, height,
        width), or of what those before `first` made of them."""
        if first < last:
            image = self.features[first:last](image)
        if first < last == IMAGE_MODULES:
            image = self.cell_layer(image.flatten(2).mT).relu().flatten(1)
        return image

    def forward(self, image: Tensor, state: Tensor, first: int = 0) -> tuple[Tensor, Tensor]:
        """Waypoints (N, 3, 10, 3) [m] and costs (N, 3).

        Args:
            image: (N, 3, height, width), or what the `first` of the `IMAGE_MODULES` made of it.
            state: (N, 9), see `encode_state`.
            first: module that takes `image`.
        """
        # On a GPU convolutions of half the bits take half the time.
        with torch.autocast(image.device.type, torch.bfloat16, enabled=image.is_cuda):
            cells = self.encode_image(image, first)
        cells = cells.float()
        y = self.state_layer_2(self.state_layer(state).relu()).relu()
        joined = torch.cat([cells, y], 1)
        if self.spec.head_features:
            joined = self.hidden_layer(joined).relu()
        output = self.head(joined).unflatten(1, (HYPOTHESES, -1))
        waypoints = output[..., :-1].unflatten(2, (NUM_WAYPOINTS, 3))
        v_B, towards, up_B = state.unflatten(1, (3, 3)).unbind(1)
        goal_B = self.spec.reach * towards
        way = self.spec.way(v_B, goal_B, up_B, self.spec.nominal_speed, self._basis)
        return way[:, None] + self.spec.deviations(waypoints, goal_B), output[..., -1]


class _Bias(nn.Module):
    """What is left of a batch norm that is folded into the convolution before it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.bias[:, None, None]


def encode_state(R_WB: Tensor, v_B: Tensor, goal_B: Tensor, reach: float) -> Tensor:
    """What the network is told (N, 9), see `student_observation`: of attitudes (N, 3, 3),
    velocities (N, 3) [m/s] and vectors to the goal (N, 3) [m], whose lengths are told within
    `reach` [m]."""
    towards = goal_B / goal_B.norm(dim=1, keepdim=True).clamp(min=reach)
    return torch.cat([v_B, towards, R_WB[:, 2]], 1)


def encode_color(color: Tensor) -> Tensor:
    """Colours (N, H, W, 3), 0 to 255, as (N, 3, H, W): -1 to 1."""
    return color.movedim(3, 1) / 127.5 - 1.0


def encode_depth(depth: Tensor) -> Tensor:
    """Planar depth (N, H, W) [m] as grey images (N, 3, H, W), see `student_observation`."""
    z = depth.clamp(NEAREST, FARTHEST).log()
    near, far = math.log(NEAREST), math.log(FARTHEST)
    encoded = (far + near - 2.0 * z) / (far - near)
    return encoded[:, None].expand(-1, 3, -1, -1)


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
