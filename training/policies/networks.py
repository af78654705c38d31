"""Networks of depth policies in torch; their weights have the names that flight expects."""

import torch
from torch import Tensor, nn

from splatpilot.systems.policies.agile_autonomy import (
    MODES,
    STATE_SIZE,
    WAYPOINT_SCALE,
    TrajectoryNetworkSpec,
)
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS
from splatpilot.systems.policies.networks import LEAK, Convolution, DepthSpec, NetworkSpec


class TrainableNetwork(nn.Module):
    """The network of a `NetworkSpec`; `head_scale` multiplies the head's initial weights."""

    def __init__(self, spec: NetworkSpec, head_scale: float = 0.1) -> None:
        super().__init__()
        self.spec = spec
        self.convolutions = _convolutions(spec)
        self.state_layer = nn.Linear(spec.state_size, spec.state_features)
        self.memory = nn.GRUCell(spec.image_outputs() + spec.state_features, spec.hidden_size)
        self.head = nn.Linear(spec.hidden_size, spec.output_size)
        with torch.no_grad():
            self.head.weight.mul_(head_scale)
            self.head.bias.zero_()

    def forward(self, image: Tensor, state: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Computes outputs (N, O) and hidden states (N, H) from images (N, height, width), or of
        several channels, states (N, S) and hidden states."""
        x = image if image.dim() == 4 else image[:, None]
        for layer in self.convolutions:
            x = _leaky(layer(x))
        features = _leaky(self.state_layer(state))
        hidden = self.memory(torch.cat([x.flatten(1), features], 1), hidden)
        return self.head(hidden), hidden


class TrajectoryModule(nn.Module):
    """The network of a `TrajectoryNetworkSpec`."""

    def __init__(self, spec: TrajectoryNetworkSpec) -> None:
        super().__init__()
        self.spec = spec
        self.convolutions = _convolutions(spec)
        joined = spec.image_features + spec.state_features
        self.image_layer = nn.Linear(spec.image_outputs(), spec.image_features)
        self.state_layer = nn.Linear(STATE_SIZE, spec.state_features)
        self.state_layer_2 = nn.Linear(spec.state_features, spec.state_features)
        self.modes = nn.Linear(joined, MODES * spec.mode_features)
        self.head = nn.Linear(spec.mode_features, spec.head_features)
        self.output = nn.Linear(spec.head_features, 3 * NUM_WAYPOINTS + 1)

    def forward(self, image: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Computes waypoints (N, 3, 10, 3) [m] and costs (N, 3) from images (N, H, W) and states
        (N, 18)."""
        x = image[:, None]
        for layer in self.convolutions:
            x = _leaky(layer(x))
        x = _leaky(self.image_layer(x.flatten(1)))
        y = _leaky(self.state_layer_2(_leaky(self.state_layer(state))))
        modes = _leaky(self.modes(torch.cat([x, y], 1))).reshape(len(image), MODES, -1)
        output = self.output(_leaky(self.head(modes)))
        waypoints = WAYPOINT_SCALE * output[..., :-1].unflatten(2, (NUM_WAYPOINTS, 3))
        return waypoints, output[..., -1]


def load_weights(module: nn.Module, checkpoint: PolicyCheckpoint, prefix: str = "") -> None:
    """Loads the weights whose names begin with `prefix`."""
    weights = checkpoint.weights.items()
    state = {
        k.removeprefix(prefix): torch.from_numpy(v) for k, v in weights if k.startswith(prefix)
    }
    module.load_state_dict(state)


def _leaky(x: Tensor) -> Tensor:
    return nn.functional.leaky_relu(x, LEAK)


def _convolutions(spec: DepthSpec) -> nn.ModuleList:
    return nn.ModuleList(map(make_convolution, spec.image_layers()))


def make_convolution(layer: Convolution) -> nn.Conv2d:
    """Makes the module of a layer, without activation and skip."""
    sizes = layer.inputs, layer.outputs, layer.kernel, layer.stride, layer.padding
    return nn.Conv2d(*sizes, layer.dilation, layer.groups)
