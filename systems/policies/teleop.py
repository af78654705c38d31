"""Teleop: a person flies, by keys, sliders or a gamepad of Meshcat."""

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Meshcat

from splatpilot.systems.common.drake import add_slider
from splatpilot.systems.common.validation import Config, bounded
from splatpilot.systems.policies.base import Observation, Policy

AXES = {
    "forward": ("forward (w, s)", "KeyS", "KeyW"),
    "left": ("left (a, d)", "KeyD", "KeyA"),
    "up": ("up (arrows)", "ArrowDown", "ArrowUp"),
    "turn": ("turn (arrows)", "ArrowRight", "ArrowLeft"),
}
"""Names of sliders [m/s, rad/s], and their keys to decrement and increment."""
STOP = "stop (x)"
_STEPS = 4  # [-] presses of a key from rest to the maximum
_DEAD_BAND = 0.1  # [-] of the gamepad's sticks


@dataclass
class TeleopConfig(Config):
    """Limits and rate of a person's commands."""

    # [m/s] Max speed along each axis.
    speed: float = bounded(2.0, "(0, 20] m/s")
    # [rad/s] Max turn rate.
    turn_rate: float = bounded(1.5, "(0, 10] rad/s")
    # [Hz] Updates per second.
    rate: float = bounded(20.0, "(0, 1000] Hz")


class Teleop(Policy):
    """Flies as a person commands in Meshcat; hovers before `add_controls`.

    .. pydrake_system::

        name: Teleop
        input_ports: [state, goal]
        output_ports: [velocity, heading]

    Sliders and the sticks of a gamepad add up: the left one is forward and left, the right one is
    up and turn. Velocities are in the frame of the heading.

    - ``velocity`` (3): v_WB [m/s], W frame.
    - ``heading`` (1): [rad].
    """

    def __init__(self, config: TeleopConfig | None = None) -> None:
        super().__init__(config or TeleopConfig())
        self.declare_state(np.zeros(3), "velocity")
        self.declare_state([np.nan], "heading")
        self._meshcat: Meshcat | None = None
        speed = self.config.speed
        self._limits = np.array([speed, speed, speed, self.config.turn_rate])

    def add_controls(self, meshcat: Meshcat) -> None:
        """Adds the sliders, and a button that sets them to zero."""
        self._meshcat, self._stops = meshcat, 0
        meshcat.AddButton(STOP, "KeyX")
        for (name, *keys), limit in zip(AXES.values(), self._limits, strict=True):
            add_slider(meshcat, name, (-limit, limit), limit / _STEPS, 0.0, *keys)

    def decide(self, observed: Observation, *state: np.ndarray) -> list[np.ndarray]:
        forward, left, up, turn = self._read_controls()
        heading = state[1][0] if np.isfinite(state[1][0]) else observed.state.heading
        heading += turn / self.config.rate
        cos, sin = np.cos(heading), np.sin(heading)
        velocity = np.array([forward * cos - left * sin, forward * sin + left * cos, up])
        return [velocity, np.array([heading])]

    def _read_controls(self) -> np.ndarray:
        """Returns the commanded forward, left and up velocities [m/s] and turn rate [rad/s]."""
        meshcat = self._meshcat
        if meshcat is None:
            return np.zeros(4)
        if meshcat.GetButtonClicks(STOP) > self._stops:
            self._stops = meshcat.GetButtonClicks(STOP)
            for name, *_ in AXES.values():
                meshcat.SetSliderValue(name, 0.0)
        sliders = np.array([meshcat.GetSliderValue(name) for name, *_ in AXES.values()])
        gamepad = meshcat.GetGamepad()
        sticks = np.zeros(4)
        if gamepad.index is not None and len(gamepad.axes) >= 4:
            # Sticks are positive to the right and down.
            sticks = -np.array(gamepad.axes)[[1, 0, 3, 2]]
            sticks[np.abs(sticks) < _DEAD_BAND] = 0.0
        return np.clip(sliders + sticks * self._limits, -self._limits, self._limits)
