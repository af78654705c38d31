"""Baseline policy: flies straight to the goal without sensing."""

from dataclasses import dataclass

import numpy as np

from splatpilot.systems.common.validation import Config, bounded, require_type
from splatpilot.systems.policies.base import Observation, Policy, target_velocity
from splatpilot.systems.policies.velocity import SLOWING_TIME, tracking_acceleration


@dataclass
class StraightConfig(Config):
    """Speed and rate of the straight flight."""

    # [m/s] Nominal speed.
    speed: float = bounded(2.0, "(0, 20] m/s")
    # [Hz] Updates per second.
    rate: float = bounded(15.0, "(0, 1000] Hz")


class Straight(Policy):
    """Flies straight to the goal at a constant speed, by `target_velocity` and
    `tracking_acceleration`.

    .. pydrake_system::

        name: Straight
        input_ports: [state, goal]
        output_ports: [acceleration]

    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded.

    Supports the scalars float and AutoDiffXd, with exact derivatives.
    """

    differentiable = True

    def __init__(self, config: StraightConfig | None = None) -> None:
        config = StraightConfig() if config is None else config
        require_type(config, StraightConfig, "config")
        super().__init__(config)
        self.declare_state(np.zeros(3), "acceleration")

    def decide(self, observed: Observation, *state: np.ndarray) -> list[np.ndarray]:
        v_desired = target_velocity(
            observed.state.p_WB, observed.p_WG, self.config.speed, SLOWING_TIME
        )
        return [tracking_acceleration(observed.state.v_WB, v_desired)]
