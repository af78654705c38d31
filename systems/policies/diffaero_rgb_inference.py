"""What DiffAero's policy that sees in colours has learned, and how it decides."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.systems.policies.diffaero_inference import DIFFAERO_NETWORK, decide_by_grid
from splatpilot.systems.policies.monocular_depth import (
    MonocularDepth,
    MonocularSpec,
    encode_view,
)
from splatpilot.systems.policies.policy_checkpoint import PolicyCheckpoint, check_weights
from splatpilot.systems.policies.recurrent_network import NetworkSpec, RecurrentNetwork


@dataclass(frozen=True)
class DiffAeroRgbSpec:
    """The architecture: what sees, and what decides."""

    monocular: MonocularSpec = field(default_factory=MonocularSpec)
    policy: NetworkSpec = DIFFAERO_NETWORK


DIFFAERO_RGB_NETWORK = DiffAeroRgbSpec()


class DiffAeroRgbNetwork:
    """Both networks with their weights, whose names begin with `monocular.` and `policy.`.

    Raises:
        ValueError: if an array is missing, of another shape or not finite.
    """

    def __init__(self, spec: DiffAeroRgbSpec, weights: dict[str, np.ndarray]) -> None:
        def part(name: str, shapes: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
            checked = check_weights(weights, {f"{name}.{key}": shapes[key] for key in shapes})
            return {key.removeprefix(f"{name}."): value for key, value in checked.items()}

        self.monocular = MonocularDepth(
            spec.monocular, part("monocular", spec.monocular.weight_shapes())
        )
        self.policy = RecurrentNetwork(spec.policy, part("policy", spec.policy.weight_shapes()))


def load_network(path: str | None) -> DiffAeroRgbNetwork:
    """The networks from a file of weights; see `PolicyCheckpoint.load`."""
    checkpoint = PolicyCheckpoint.load(path, "diffaero_rgb", DIFFAERO_RGB_NETWORK)
    return checkpoint.build(DiffAeroRgbNetwork)


def decide(
    network: DiffAeroRgbNetwork,
    color: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
    speed: float,
    memory: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The acceleration a_WB (3,) [m/s^2] in W, gravity excluded, and the memory (H,) afterwards.

    Args:
        network: see `DiffAeroRgbNetwork`.
        color: (H, 160, 3) uint8, see `encode_view`.
        X_WB, v_WB: pose and velocity [m/s].
        p_WG: the goal [m].
        speed: wanted [m/s].
        memory: (H,), before.

    Raises:
        ValueError: for an image of another size.
    """
    grid, _ = network.monocular(encode_view(color, X_WB.rotation().matrix()))
    return decide_by_grid(network.policy, grid, X_WB, v_WB, p_WG, speed, memory)
