"""Exports the network of a policy as ONNX, for other programs and processors.

python -m splatpilot.training.policies.export distilled_rgb out/distilled_rgb.onnx

The module of the policy in `systems/policies` defines its inputs and its command.
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor, nn

from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.policies.agile_autonomy import AGILE_NETWORK
from splatpilot.systems.policies.checkpoint import (
    PolicyCheckpoint,
    checkpoint_policy,
    shipped_weights,
)
from splatpilot.systems.policies.depthnav import DEPTHNAV_NETWORK
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.systems.policies.diffaero_rgb import CHANNELS, HEIGHT, WIDTH
from splatpilot.systems.policies.student import load_checkpoint
from splatpilot.training.policies.networks import (
    StudentModule,
    TrainableNetwork,
    TrajectoryModule,
    load_weights,
)
from splatpilot.training.policies.train_diffaero_rgb import DistilledRgbModule

_NETWORKS = {
    "diffaero": (DIFFAERO_NETWORK, TrainableNetwork),
    "diffaero_tof": (DIFFAERO_NETWORK, TrainableNetwork),
    "depthnav": (DEPTHNAV_NETWORK, TrainableNetwork),
    "agile_autonomy": (AGILE_NETWORK, TrajectoryModule),
}


class _Distilled(nn.Module):
    """Both networks of `distilled_rgb`, from a view to an output."""

    def __init__(self, networks: DistilledRgbModule) -> None:
        super().__init__()
        self.networks = networks

    def forward(self, view: Tensor, state: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        image, _ = self.networks.see(view, bfloat16=False)
        return self.networks.policy(image, state, hidden)


def export(weights: Path, out: Path) -> None:
    """Writes the network of a file of weights to an ONNX file, for one image at a time. Inputs are
    `image`, `state` and, with memory, `hidden`; outputs `output` and `next_hidden`, or `waypoints`
    and `costs`."""
    policy = checkpoint_policy(weights)
    if policy in _NETWORKS:
        spec, make = _NETWORKS[policy]
        module = network = make(spec)
        load_weights(module, PolicyCheckpoint.load(weights, policy, spec))
        image = spec.image_size()[1:]
    elif policy == "distilled_rgb":
        networks = DistilledRgbModule(str(weights))
        module, network, image = _Distilled(networks), networks.policy, (CHANNELS, HEIGHT, WIDTH)
    elif policy in ("student_rgb", "student_depth"):
        checkpoint = load_checkpoint(str(weights), policy.removeprefix("student_"))
        module = network = StudentModule(checkpoint.spec)
        load_weights(module, checkpoint)
        image = 3, checkpoint.spec.height, checkpoint.spec.width
    else:
        raise ValueError(f"{weights}: the policy {policy!r} has no export")
    sizes = [image, (network.state_layer.in_features,)]
    if isinstance(network, TrainableNetwork):
        sizes.append((network.memory.hidden_size,))
    outputs = ["output", "next_hidden"] if len(sizes) == 3 else ["waypoints", "costs"]
    with written_atomically(out) as partial:
        torch.onnx.export(
            module.eval(),
            tuple(torch.zeros(1, *size) for size in sizes),
            partial,
            input_names=["image", "state", "hidden"][: len(sizes)],
            output_names=outputs,
            dynamo=True,
            external_data=False,
            verbose=False,
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("weights", help="file of weights, or the name of a policy that ships")
    parser.add_argument("out", type=Path, help="ONNX file")
    options = parser.parse_args()
    given = Path(options.weights)
    export(given if given.is_file() else shipped_weights(options.weights), options.out)
