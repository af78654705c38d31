"""Poses beside those that were flown through, from which the same labels are seen."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw


@dataclass
class PerturbationConfig:
    """How far, at most."""

    # [-] Perturbed poses that each labelled state is rendered from, beside its own.
    copies: int = 1
    # [m] Displacement, in worlds whose fidelity bound is no less.
    distance: float = 0.3
    # [rad] Turn about the vertical.
    yaw: float = 0.2
    # [rad] Turn about each of the other axes.
    tilt: float = 0.1

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        if not 0 <= self.copies <= 100:
            raise ValueError(f"perturbation.copies is {self.copies}; it must be 0 to 100")
        for name, limit in (("distance", 5.0), ("yaw", np.pi), ("tilt", 1.0)):
            if not 0.0 <= getattr(self, name) <= limit:
                raise ValueError(
                    f"perturbation.{name} is {getattr(self, name)}; it must be 0 to {limit:.4g}"
                )


def perturbed(
    X_WB: RigidTransform, config: PerturbationConfig, reach: float, rng: np.random.Generator
) -> RigidTransform:
    """A pose near X_WB, displaced by at most `config.distance` and at most `reach` [m].

    The displacement is uniform in that ball. With the clearance at X_WB within `reach`, the
    vehicle touches nothing there either: distances change by no more than one moves.
    """
    direction = rng.normal(size=3)
    radius = max(0.0, min(config.distance, reach)) * rng.uniform() ** (1 / 3)
    p_BP_W = radius * direction / np.linalg.norm(direction)
    roll, pitch, yaw = rng.uniform(-1, 1, 3) * (config.tilt, config.tilt, config.yaw)
    R_WP = RollPitchYaw(0, 0, yaw).ToRotationMatrix() @ X_WB.rotation()
    R_WP = R_WP @ RollPitchYaw(roll, pitch, 0).ToRotationMatrix()
    return RigidTransform(R_WP, X_WB.translation() + p_BP_W)
