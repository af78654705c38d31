"""A policy: flies ahead if the route is clear, up if it is not."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from hedgehop.rangefinder import RangefinderConfig
from splatpilot import Config, QuadrotorState, bounded, register_policy


def _rangefinders() -> dict[str, RangefinderConfig]:
    # The first is tilted, to see edges that the vehicle itself would not clear.
    directions = {"ahead": [1.0, 0.0, -0.3], "below": [0.0, 0.0, -1.0]}
    return {name: RangefinderConfig(direction) for name, direction in directions.items()}


@dataclass
class ClimberConfig(Config):
    """The flight of the climber."""

    speed: float = bounded(2.0, "(0, 100] m/s")
    rate: float = bounded(15.0, "(0, 100] Hz")  # of updates
    margin: float = bounded(3.0, "(0, 100] m")  # distance ahead at which it begins to climb
    height: float = bounded(1.0, "(0, 100] m")  # minimum, above obstacles and ground
    sensors: dict[str, RangefinderConfig] = field(default_factory=_rangefinders)


def desired_velocity(
    p_WB: np.ndarray, p_WG: np.ndarray, ahead: float, below: float, config: ClimberConfig
) -> np.ndarray:
    """Computes v_WB (3,) [m/s] to the goal: the nearer an obstacle ahead, the slower and the faster
    up."""
    offset = p_WG - p_WB
    plan = np.hypot(offset[0], offset[1])
    clear = np.clip((ahead - 1.0) / config.margin, 0.0, 1.0) if ahead < plan else 1.0
    level = config.speed * clear * min(1.0, plan) * offset[:2] / max(plan, 1e-6)
    climb = np.clip(offset[2], -0.5, 0.5)
    if clear < 1.0:
        climb = config.speed * (1.0 - clear)
    elif below < config.height:
        climb = max(climb, 2.0 * (config.height - below))
    return np.append(level, climb)


class Climber(LeafSystem):
    """Flies by two rangefinders.

    .. pydrake_system::

        name: Climber
        input_ports: [state, goal, ahead_distance, below_distance]
        output_ports: [acceleration]

    Updates at `rate` from time 0 with the acceleration to `desired_velocity`.
    """

    def __init__(self, config: ClimberConfig):
        super().__init__()
        self._config, self.sensors = config, config.sensors
        ports = {"state": 13, "goal": 3, "ahead_distance": 1, "below_distance": 1}
        for name, size in ports.items():
            self.DeclareVectorInputPort(name, size)
        self.DeclareStateOutputPort("acceleration", self.DeclareDiscreteState(3))
        self.DeclarePeriodicDiscreteUpdateEvent(1 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state, p_WG, ahead, below = (
            self.get_input_port(index).Eval(context) for index in range(self.num_input_ports())
        )
        p_WB, v_WB, _, _ = QuadrotorState.of(state)
        v_desired = desired_velocity(p_WB, p_WG, float(ahead[0]), float(below[0]), self._config)
        discrete_state.set_value(2.0 * (v_desired - v_WB))


register_policy(ClimberConfig, lambda config, world, scenario: Climber(config))
