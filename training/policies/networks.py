"""The networks of depth policies, for torch; `systems.policies` flies them in numpy."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from splatpilot.systems.policies.agile_autonomy import (
    MODES,
    STATE_SIZE,
    WAYPOINT_SCALE,
    TrajectoryNetworkSpec,
)
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS
from splatpilot.systems.policies.recurrent_network import LEAK, Layer, NetworkSpec


class TrainableNetwork(nn.Module):
    """The network of `spec`, with the names and shapes of weights that `RecurrentNetwork` takes.

    `head_scale` multiplies the head's first weights: small ones begin with about hovering.
    """

    def __init__(self, spec: NetworkSpec, head_scale: float = 0.1) -> None:
        super().__init__()
        self.spec = spec
        self.convolutions = _convolutions(spec.convolutions)
        self.state_layer = nn.Linear(spec.state_size, spec.state_features)
        self.memory = nn.GRUCell(spec.image_features() + spec.state_features, spec.hidden_size)
        self.head = nn.Linear(spec.hidden_size, spec.output_size)
        with torch.no_grad():
            self.head.weight.mul_(head_scale)
            self.head.bias.zero_()

    def forward(self, image: Tensor, state: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Output (N, O) and memory (N, H) of images (N, height, width), states and memories."""
        x = image[:, None]
        for layer in self.convolutions:
            x = nn.functional.leaky_relu(layer(x), LEAK)
        features = nn.functional.leaky_relu(self.state_layer(state), LEAK)
        hidden = self.memory(torch.cat([x.flatten(1), features], 1), hidden)
        return self.head(hidden), hidden


class TrajectoryModule(nn.Module):
    """The network of a `TrajectoryNetworkSpec`, with the names of weights that
    `systems.policies.agile_autonomy.TrajectoryNetwork` takes."""

    def __init__(self, spec: TrajectoryNetworkSpec) -> None:
        super().__init__()
        self.spec = spec
        self.convolutions = _convolutions(spec.convolutions)
        joined = spec.image_features + spec.state_features
        self.image_layer = nn.Linear(spec.flat_features(), spec.image_features)
        self.state_layer = nn.Linear(STATE_SIZE, spec.state_features)
        self.state_layer_2 = nn.Linear(spec.state_features, spec.state_features)
        self.modes = nn.Linear(joined, MODES * spec.mode_features)
        self.head = nn.Linear(spec.mode_features, spec.head_features)
        self.output = nn.Linear(spec.head_features, 3 * NUM_WAYPOINTS + 1)

    def forward(self, image: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Waypoints (N, 3, 10, 3) [m] and costs (N, 3) of images (N, H, W) and states (N, 18)."""
        x = image[:, None]
        for layer in self.convolutions:
            x = nn.functional.leaky_relu(layer(x), LEAK)
        x = nn.functional.leaky_relu(self.image_layer(x.flatten(1)), LEAK)
        y = nn.functional.leaky_relu(self.state_layer(state), LEAK)
        y = nn.functional.leaky_relu(self.state_layer_2(y), LEAK)
        modes = nn.functional.leaky_relu(self.modes(torch.cat([x, y], 1)), LEAK)
        modes = modes.reshape(len(image), MODES, -1)
        output = self.output(nn.functional.leaky_relu(self.head(modes), LEAK))
        waypoints = WAYPOINT_SCALE * output[..., :-1].unflatten(2, (NUM_WAYPOINTS, 3))
        return waypoints, output[..., -1]


def _convolutions(layers: Sequence[Layer]) -> nn.ModuleList:
    inputs = [1, *(layer[0] for layer in layers)]
    return nn.ModuleList(
        nn.Conv2d(size, channels, kernel, stride, padding)
        for size, (channels, kernel, stride, padding) in zip(inputs, layers, strict=False)
    )
