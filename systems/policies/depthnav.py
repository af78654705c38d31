"""DepthNav: a recurrent policy of depth that commands accelerations and its heading.

The start frame S has its z axis up and its x axis above the body's x axis at the first update.
"""

from dataclasses import dataclass, field
from math import atan2

import numpy as np
from pydrake.math import RotationMatrix

from splatpilot.systems.policies.base import (
    LearnedPolicyConfig,
    Observation,
    Policy,
    heading_frame,
    limit_smoothly,
    pool_depth,
    target_velocity,
)
from splatpilot.systems.policies.networks import (
    NetworkSpec,
    RecurrentNetwork,
    load_network,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera

RATE = 25.0  # [Hz]
CAMERA_SIZE = 128, 72  # [px] width and height before pooling
FOV_X = 87.0  # [deg]
MIN_DEPTH, MAX_DEPTH = 0.25, 20.0  # [m]
ACCELERATION_LIMITS = np.array([10.0, 10.0, 6.0])  # [m/s^2], in the start frame

DEPTHNAV_NETWORK = NetworkSpec(
    image_height=12,
    image_width=16,
    convolutions=((32, 3, 2, 1), (64, 3, 2, 1), (128, 3, 1, 0)),
    state_size=11,
    state_features=64,
    hidden_size=192,
    output_size=4,
)
IMAGE_SIZE = DEPTHNAV_NETWORK.image_height, DEPTHNAV_NETWORK.image_width


@dataclass
class DepthNavConfig(LearnedPolicyConfig):
    """Weights, speed and camera, whose pixels are pooled to 16x12."""

    rate = RATE
    image_size = IMAGE_SIZE

    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(
            width=CAMERA_SIZE[0], height=CAMERA_SIZE[1], fov_x=FOV_X, max_depth=MAX_DEPTH
        )
    )


def compute_command(
    network: RecurrentNetwork,
    observed: Observation,
    speed: float,
    start_yaw: float,
    memory: np.ndarray,
) -> tuple[np.ndarray, float, np.ndarray]:
    """Computes a_WB (3,) [m/s^2] without gravity, the heading [rad] and the next hidden state (H,).

    From depth (H, W), nominal speed [m/s], yaw of the start frame [rad] and hidden state (H,).
    """
    R_WS = heading_frame(np.array(start_yaw))
    image = 1.0 / np.clip(pool_depth(observed.image, *IMAGE_SIZE), MIN_DEPTH, MAX_DEPTH)
    R_SB = RotationMatrix.MakeZRotation(-start_yaw) @ observed.X_WB.rotation()
    q_SB = R_SB.ToQuaternion().wxyz()
    q_SB *= np.copysign(1.0, q_SB[0])
    v_target = target_velocity(observed.X_WB.translation(), observed.p_WG, speed)
    state = np.concatenate([observed.state.v_WB @ R_WS, q_SB, v_target @ R_WS, [speed]])
    output, memory = network.step(image, state, memory)
    a_WB = R_WS @ limit_smoothly(output[:3], ACCELERATION_LIMITS)
    to_goal = atan2(v_target[1], v_target[0])
    return a_WB, to_goal + np.pi * np.tanh(float(output[3]) / np.pi), memory


class DepthNav(Policy):
    """Flies to the goal by a 16x12 depth image and a hidden state, and commands its heading.

    .. pydrake_system::

        name: DepthNav
        input_ports: [state, goal, depth_image_32f]
        output_ports: [acceleration, heading]

    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded.
    - ``heading`` (1): of body x, from world x seen from above [rad]; NaN before the first update.
    """

    def __init__(self, config: DepthNavConfig | None = None) -> None:
        super().__init__(config or DepthNavConfig(), "depth_image_32f")
        self._network = load_network(self.config.weights, "depthnav", DEPTHNAV_NETWORK)
        self.declare_state(np.zeros(3), "acceleration")
        self.declare_state([np.nan], "heading")
        self.declare_state(self._network.initial_hidden())
        self.declare_state([np.nan])  # yaw of the start frame

    def decide(self, observed: Observation, *state: np.ndarray) -> list[np.ndarray]:
        memory, start_yaw = state[2:]
        if np.isnan(start_yaw[0]):
            start_yaw = np.array([float(observed.state.heading)])
        speed = self.config.speed
        a_WB, heading, memory = compute_command(
            self._network, observed, speed, float(start_yaw[0]), memory
        )
        return [a_WB, np.array([heading]), memory, start_yaw]
