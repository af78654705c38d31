"""DiffAero's network in colours for torch; `systems.policies.diffaero_rgb_inference` flies it."""

import torch
from torch import Tensor, nn

from splatpilot.systems.policies.convolutions import LEAK
from splatpilot.systems.policies.diffaero_inference import DIFFAERO_NETWORK
from splatpilot.systems.policies.diffaero_rgb_inference import DIFFAERO_RGB_NETWORK
from splatpilot.systems.policies.monocular_depth import Layer, MonocularSpec
from splatpilot.systems.policies.policy_checkpoint import PolicyCheckpoint
from splatpilot.training.policies.network import TrainableNetwork


class MonocularModule(nn.Module):
    """The network of a `MonocularSpec`, with the names of weights that `MonocularDepth` takes."""

    def __init__(self, spec: MonocularSpec) -> None:
        super().__init__()
        made = {layer.name: _convolution(layer) for layer in spec.layers()}

        def blocks(name: str, count: int) -> nn.Sequential:
            return nn.Sequential(
                *(_Block(made[f"{name}.{i}.0"], made[f"{name}.{i}.1"]) for i in range(count))
            )

        self.stem, self.halving, self.head = made["stem"], made["halving"], made["head"]
        self.fine = blocks("fine", len(spec.fine_dilations))
        self.coarse = blocks("coarse", len(spec.coarse_dilations))

    def forward(self, view: Tensor) -> Tensor:
        """Inverse depths and logarithms of their errors (N, 2, 9, 16) of views (N, 6, 90, 160)."""
        x = self.fine(nn.functional.leaky_relu(self.stem(view), LEAK))
        return self.head(self.coarse(nn.functional.leaky_relu(self.halving(x), LEAK)))


class _Block(nn.Sequential):
    """Two convolutions whose output is added to the input; it begins with adding nothing."""

    def __init__(self, first: nn.Conv2d, second: nn.Conv2d) -> None:
        super().__init__(first, second)
        nn.init.zeros_(second.weight)

    def forward(self, input: Tensor) -> Tensor:
        first, second = self
        return input + second(nn.functional.leaky_relu(first(input), LEAK))


class DiffAeroRgbModule(nn.Module):
    """What sees, which learns, and what decides, which has learned."""

    def __init__(self) -> None:
        super().__init__()
        self.monocular = MonocularModule(DIFFAERO_RGB_NETWORK.monocular)
        self.monocular = self.monocular.to(memory_format=torch.channels_last)
        self.policy = TrainableNetwork(DIFFAERO_RGB_NETWORK.policy).requires_grad_(False)

    def load_policy(self, weights: str) -> None:
        """Has the policy be DiffAero of a file of weights, of those that ship if empty."""
        checkpoint = PolicyCheckpoint.load(weights, "diffaero", DIFFAERO_NETWORK)
        self.policy.load_state_dict(
            {name: torch.from_numpy(values) for name, values in checkpoint.weights.items()}
        )

    def load_sight(self, weights: str) -> None:
        """Has it see as the `diffaero_rgb` of a file of weights."""
        checkpoint = PolicyCheckpoint.load(weights, "diffaero_rgb", DIFFAERO_RGB_NETWORK)
        self.monocular.load_state_dict(
            {
                name.removeprefix("monocular."): torch.from_numpy(values)
                for name, values in checkpoint.weights.items()
                if name.startswith("monocular.")
            }
        )


def _convolution(layer: Layer) -> nn.Conv2d:
    return nn.Conv2d(
        layer.inputs,
        layer.outputs,
        layer.kernel,
        layer.stride,
        layer.dilation * (layer.kernel // 2),
        layer.dilation,
    )
