"""DiffAero: a recurrent policy of depth, trained through the dynamics of flight.

`DiffAero` flies by a depth camera and commands accelerations; `DiffAeroTof` flies by the grid of a
time-of-flight sensor and commands velocities.
"""

from dataclasses import dataclass, field

import numpy as np

from splatpilot.systems.policies.base import (
    LearnedPolicyConfig,
    Observation,
    Policy,
    heading_frame,
    heading_observation,
    inverse_depth,
    limit_smoothly,
    pool_depth,
)
from splatpilot.systems.policies.networks import (
    NetworkSpec,
    RecurrentNetwork,
    load_network,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera

RATE = 15.0  # [Hz]
FOV_X = 90.0  # [deg]
TOF_FOV_X, TOF_FOV_Y = 86.0, 48.375  # [deg]
MIN_DEPTH, MAX_DEPTH = 0.3, 12.0  # [m]
ACCELERATION_LIMITS = np.array([10.0, 10.0, 6.0])  # [m/s^2], in the heading frame
VELOCITY_LIMITS = np.array([6.0, 6.0, 3.0])  # [m/s], in the heading frame

DIFFAERO_NETWORK = NetworkSpec(
    image_height=9,
    image_width=16,
    convolutions=((16, 3, 2, 1), (32, 3, 2, 1), (32, 3, 1, 0)),
    state_size=9,
    state_features=64,
    hidden_size=128,
    output_size=3,
)
IMAGE_SIZE = DIFFAERO_NETWORK.image_height, DIFFAERO_NETWORK.image_width


@dataclass
class DiffAeroConfig(LearnedPolicyConfig):
    """Weights, speed and camera, whose pixels are pooled to 16x9."""

    rate = RATE
    image_size = IMAGE_SIZE

    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(width=64, height=36, fov_x=FOV_X, max_depth=20.0)
    )


@dataclass
class DiffAeroTofConfig(LearnedPolicyConfig):
    """Weights, speed and the time-of-flight sensor as it is simulated."""

    rate = RATE
    image_size = IMAGE_SIZE

    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(
            width=64, height=36, fov_x=TOF_FOV_X, fov_y=TOF_FOV_Y, min_depth=0.0, max_depth=6.0
        )
    )  # The sensor's range is 5 m; the noise of depths beyond it stays below 6 m.


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """Encodes planar depth (H, W) [m]: the inverse of the minimum in each of the 9x16 cells."""
    return inverse_depth(pool_depth(depth, *IMAGE_SIZE), MIN_DEPTH, MAX_DEPTH)


def compute_command(
    network: RecurrentNetwork,
    grid: np.ndarray,
    observed: Observation,
    speed: float,
    memory: np.ndarray,
    limits: np.ndarray = ACCELERATION_LIMITS,
) -> tuple[np.ndarray, np.ndarray]:
    """Computes the command (3,) in the world and the next hidden state (H,), from `encode_depth` or
    proximities (9, 16), the nominal speed [m/s], the hidden state and the command's limits (3,)."""
    p_WB, v_WB, _, _ = observed.state
    R_WH, z_WB = heading_frame(observed.state.heading), observed.X_WB.rotation().matrix()[:, 2]
    state = heading_observation(p_WB, v_WB, z_WB, observed.p_WG, speed, R_WH)
    output, memory = network.step(grid, state, memory)
    return R_WH @ limit_smoothly(output, limits), memory


class DiffAero(Policy):
    """Flies to the goal by a 16x9 depth image and a hidden state.

    .. pydrake_system::

        name: DiffAero
        input_ports: [state, goal, depth_image_32f]
        output_ports: [acceleration]

    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded.
    """

    def __init__(self, config: DiffAeroConfig | None = None) -> None:
        super().__init__(config or DiffAeroConfig(), "depth_image_32f")
        self._network = load_network(self.config.weights, "diffaero", DIFFAERO_NETWORK)
        self.declare_state(np.zeros(3), "acceleration")
        self.declare_state(self._network.initial_hidden())

    def decide(self, observed: Observation, *state: np.ndarray) -> tuple[np.ndarray, ...]:
        grid = encode_depth(observed.image)
        return compute_command(self._network, grid, observed, self.config.speed, state[1])


class DiffAeroTof(Policy):
    """Flies to the goal by the grid of a time-of-flight sensor and a hidden state.

    .. pydrake_system::

        name: DiffAeroTof
        input_ports: [state, goal, depth_grid]
        output_ports: [velocity]

    - ``velocity`` (3): desired v_WB [m/s], W frame.
    """

    def __init__(self, config: DiffAeroTofConfig | None = None) -> None:
        super().__init__(config or DiffAeroTofConfig(), "depth_grid")
        self._network = load_network(self.config.weights, "diffaero_tof", DIFFAERO_NETWORK)
        self.declare_state(np.zeros(3), "velocity")
        self.declare_state(self._network.initial_hidden())

    def decide(self, observed: Observation, *state: np.ndarray) -> tuple[np.ndarray, ...]:
        speed = self.config.speed
        return compute_command(
            self._network, observed.image, observed, speed, state[1], VELOCITY_LIMITS
        )
