"""Networks of policies in torch; their weights have the names that flight expects."""

import os
from pathlib import Path

import torch
from torch import Tensor, nn
from torchvision.models import mobilenet_v2

from splatpilot.systems.policies import student
from splatpilot.systems.policies.agile_autonomy import (
    MODES,
    STATE_SIZE,
    WAYPOINT_SCALE,
    TrajectoryNetworkSpec,
)
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS
from splatpilot.systems.policies.lattice import BASIS, reference_trajectory
from splatpilot.systems.policies.networks import LEAK, Convolution, DepthSpec, NetworkSpec


class TrainableNetwork(nn.Module):
    """The network of a `NetworkSpec`; `head_scale` multiplies the head's initial weights."""

    def __init__(self, spec: NetworkSpec, head_scale: float = 0.1) -> None:
        super().__init__()
        self.spec = spec
        self.convolutions = _Convolutions(spec)
        self.state_layer = nn.Linear(spec.state_size, spec.state_features)
        self.memory = nn.GRUCell(spec.image_outputs() + spec.state_features, spec.hidden_size)
        self.head = nn.Linear(spec.hidden_size, spec.output_size)
        with torch.no_grad():
            self.head.weight.mul_(head_scale)
            self.head.bias.zero_()

    def forward(self, image: Tensor, state: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Computes outputs (N, O) and hidden states (N, H) of images (N, H, W) or (N, C, H, W)."""
        x = self.convolutions(image if image.dim() == 4 else image[:, None])
        features = _leaky(self.state_layer(state))
        hidden = self.memory(torch.cat([x.flatten(1), features], 1), hidden)
        return self.head(hidden), hidden


class TrajectoryModule(nn.Module):
    """The network of a `TrajectoryNetworkSpec`."""

    def __init__(self, spec: TrajectoryNetworkSpec) -> None:
        super().__init__()
        self.spec = spec
        self.convolutions = _Convolutions(spec)
        joined = spec.image_features + spec.state_features
        self.image_layer = nn.Linear(spec.image_outputs(), spec.image_features)
        self.state_layer = nn.Linear(STATE_SIZE, spec.state_features)
        self.state_layer_2 = nn.Linear(spec.state_features, spec.state_features)
        self.modes = nn.Linear(joined, MODES * spec.mode_features)
        self.head = nn.Linear(spec.mode_features, spec.head_features)
        self.output = nn.Linear(spec.head_features, 3 * NUM_WAYPOINTS + 1)

    def forward(self, image: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Computes waypoints (N, 3, 10, 3) [m] and costs (N, 3) from images and states (N, 18)."""
        x = _leaky(self.image_layer(self.convolutions(image[:, None]).flatten(1)))
        y = _leaky(self.state_layer_2(_leaky(self.state_layer(state))))
        modes = _leaky(self.modes(torch.cat([x, y], 1))).reshape(len(image), MODES, -1)
        output = self.output(_leaky(self.head(modes)))
        waypoints = WAYPOINT_SCALE * output[..., :-1].unflatten(2, (NUM_WAYPOINTS, 3))
        return waypoints, output[..., -1]


def load_weights(module: nn.Module, checkpoint: PolicyCheckpoint, prefix: str = "") -> None:
    """Loads the weights whose names begin with `prefix`."""
    chosen = {k: w for k, w in checkpoint.weights.items() if k.startswith(prefix)}
    module.load_state_dict({k.removeprefix(prefix): torch.from_numpy(chosen[k]) for k in chosen})


def _leaky(x: Tensor) -> Tensor:
    return nn.functional.leaky_relu(x, LEAK)


class _Convolutions(nn.Sequential):
    """The convolutions of an image, each with a leaky ReLU."""

    def __init__(self, spec: DepthSpec) -> None:
        super().__init__(*map(make_convolution, spec.image_layers()))

    def forward(self, input: Tensor) -> Tensor:
        for layer in self:
            input = _leaky(layer(input))
        return input


def make_convolution(layer: Convolution) -> nn.Conv2d:
    """Makes the module of a layer, without activation and skip."""
    sizes = layer.inputs, layer.outputs, layer.kernel, layer.stride, layer.padding
    return nn.Conv2d(*sizes, layer.dilation, layer.groups)


IMAGE_MODULES = student.BLOCKS + 1  # that an image passes: of the encoder, and of its cells


class StudentModule(nn.Module):
    """The network of a `StudentSpec`, with the names of weights of `StudentNetwork`. The encoder is
    torchvision's with a bias instead of each batch norm."""

    _basis: Tensor

    def __init__(self, spec: student.StudentSpec) -> None:
        super().__init__()
        self.spec = spec
        self.features = mobilenet_v2(norm_layer=_Bias).features
        self._initialize_encoder()
        self.cell_layer = nn.Linear(student.CHANNELS, spec.cell_features)
        self.state_layer = nn.Linear(student.STATE_SIZE, spec.state_features)
        self.state_layer_2 = nn.Linear(spec.state_features, spec.state_features)
        joined = spec.image_features + spec.state_features
        self.hidden_layer = nn.Linear(joined, spec.head_features)
        self.head = nn.Linear(spec.head_features, student.HYPOTHESES * (3 * NUM_WAYPOINTS + 1))
        self.register_buffer("_basis", torch.from_numpy(BASIS).float(), persistent=False)

    def _initialize_encoder(self) -> None:
        """Keeps the variance of activations without batch norms; modules with a skip add zero."""
        weights = self.state_dict()
        for block in student.mobilenet_blocks():
            rectified = False
            for layer in block:
                kind = "relu" if rectified else "linear"
                nn.init.kaiming_normal_(weights[layer.weight], nonlinearity=kind)
                rectified = bool(layer.activation)
            if block[-1].skip:
                nn.init.zeros_(weights[block[-1].weight])

    def image_modules(self, count: int) -> nn.ModuleList:
        """Returns the first of the `IMAGE_MODULES`."""
        return nn.ModuleList([*self.features, self.cell_layer][:count])

    def encode_image(self, image: Tensor, first: int, last: int = IMAGE_MODULES) -> Tensor:
        """Passes images, or the output of modules before `first`, through those before `last`."""
        if first < last:
            image = self.features[first:last](image)
        if first < last == IMAGE_MODULES:
            image = self.cell_layer(image.flatten(2).mT).relu().flatten(1)
        return image

    def forward(self, image: Tensor, state: Tensor, first: int = 0) -> tuple[Tensor, Tensor]:
        """Computes waypoints (N, 3, 10, 3) [m] and costs (N, 3) from `encode_state` (N, 9) and
        images (N, 3, height, width), or the output of the `IMAGE_MODULES` before `first`."""
        with torch.autocast(image.device.type, torch.bfloat16, enabled=image.is_cuda):
            cells = self.encode_image(image, first)
        y = self.state_layer_2(self.state_layer(state).relu()).relu()
        hidden = self.hidden_layer(torch.cat([cells.float(), y], 1)).relu()
        output = self.head(hidden).unflatten(1, (student.HYPOTHESES, -1))
        waypoints = output[..., :-1].unflatten(2, (NUM_WAYPOINTS, 3))
        v_B, direction, up_B = state.unflatten(1, (3, 3)).unbind(1)
        goal_B = self.spec.reach * direction
        reference = reference_trajectory(v_B, goal_B, up_B, self.spec.nominal_speed, self._basis)
        return reference[:, None] + student.deviations(waypoints, goal_B), output[..., -1]


class _Bias(nn.Module):
    """A batch norm that is folded into the convolution before it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.bias[:, None, None]


# In `$SPLATPILOT_DATA`; and in torch's folder, by torchvision's `mobilenet_v2(weights="DEFAULT")`.
IN_DATA = Path("weights") / "mobilenet_v2_imagenet.pt"
_DOWNLOADED = Path("checkpoints") / "mobilenet_v2-7ebf99e0.pth"
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # [-] of torchvision's images, 0 to 1


def imagenet_weights() -> dict[str, Tensor]:
    """Reads the encoder's weights by the names of `mobilenet_shapes`, for images of -1 to 1, from a
    state dictionary of torchvision's `mobilenet_v2`: `IN_DATA` or a download. Batch norms and
    scaling of the input are folded in; a file with trivial batch norms is for images of -1 to 1."""
    data = os.environ.get("SPLATPILOT_DATA")
    paths = [Path(data) / IN_DATA] if data else []
    paths.append(Path(torch.hub.get_dir()) / _DOWNLOADED)
    path = next(filter(Path.is_file, paths), None)
    if path is None:
        raise FileNotFoundError(
            f"No such file: {' or '.join(map(str, paths))}; download the weights of MobileNetV2 "
            "with \"import torchvision; torchvision.models.mobilenet_v2(weights='DEFAULT')\", or "
            "train from scratch with pretrained=false"
        )
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        return _folded({name: values.float() for name, values in state.items()})
    except Exception as error:
        raise ValueError(
            f"{path}: must be a state dictionary of torchvision's mobilenet_v2 ({str(error)[:200]})"
        ) from None


def _folded(state: dict[str, Tensor]) -> dict[str, Tensor]:
    weights: dict[str, Tensor] = {}
    scaled = True
    for block in student.mobilenet_blocks():
        for layer in block:
            norm = layer.bias.removesuffix("bias")
            variance, mean = state[f"{norm}running_var"], state[f"{norm}running_mean"]
            scale = state[f"{norm}weight"] / (variance + 1e-5).sqrt()
            scaled &= bool((variance - 1.0).abs().max() < 1e-3)
            weights[layer.weight] = state[layer.weight] * scale[:, None, None, None]
            weights[layer.bias] = state[layer.bias] - mean * scale
    if not scaled:
        first = student.mobilenet_blocks()[0][0]
        mean, std = torch.tensor(_MEAN), torch.tensor(_STD)
        filters = weights[first.weight] / std[:, None, None]
        weights[first.bias] += (filters.sum((2, 3)) * (0.5 - mean)).sum(1)
        weights[first.weight] = 0.5 * filters
    return weights
