"""The networks of depth policies, for torch; `systems.policies.recurrent_network` flies them."""

import torch
from torch import Tensor, nn

from flysplat.systems.policies.convolutions import LEAK
from flysplat.systems.policies.recurrent_network import NetworkSpec


class TrainableNetwork(nn.Module):
    """The network of `spec`, with the names and shapes of weights that `RecurrentNetwork` takes."""

    def __init__(self, spec: NetworkSpec) -> None:
        super().__init__()
        self.spec = spec
        inputs = [1, *(layer[0] for layer in spec.convolutions)]
        self.convolutions = nn.ModuleList(
            nn.Conv2d(size, channels, kernel, stride, padding)
            for size, (channels, kernel, stride, padding) in zip(
                inputs, spec.convolutions, strict=False
            )
        )
        self.state_layer = nn.Linear(spec.state_size, spec.state_features)
        self.memory = nn.GRUCell(spec.image_features() + spec.state_features, spec.hidden_size)
        self.head = nn.Linear(spec.hidden_size, spec.output_size)
        with torch.no_grad():  # begins with about hovering
            self.head.weight.mul_(0.1)
            self.head.bias.zero_()

    def forward(self, image: Tensor, state: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Output (N, O) and memory (N, H) of images (N, height, width), states and memories."""
        x = image[:, None]
        for layer in self.convolutions:
            x = nn.functional.leaky_relu(layer(x), LEAK)
        features = nn.functional.leaky_relu(self.state_layer(state), LEAK)
        hidden = self.memory(torch.cat([x.flatten(1), features], 1), hidden)
        return self.head(hidden), hidden
