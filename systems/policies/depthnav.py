"""DepthNav: a recurrent depth policy that turns its nose by itself."""

from dataclasses import dataclass, field
from math import atan2, cos, sin
from typing import NamedTuple, cast

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.common.drake import input_port, output_port
from splatpilot.systems.policies.depth_policy_config import DepthPolicyConfig
from splatpilot.systems.policies.observations import limit_smoothly, pool_depth, target_velocity
from splatpilot.systems.policies.recurrent_network import (
    NetworkSpec,
    RecurrentNetwork,
    load_network,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state

# What DepthNav's policy sees, what network it has and what its output means.
#
# The start frame S has its origin anywhere, z up, and x above the body's x axis at the first
# update.


RATE = 25.0  # [Hz]
IMAGE_SIZE = 128, 72  # [px] width and height before pooling
FOV_X = 87.0  # [deg]
NEAREST, FARTHEST = 0.25, 20.0  # [m] range of depth
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


class Decision(NamedTuple):
    """What the vehicle should do."""

    a_WB: np.ndarray  # (3,) [m/s^2] in W, gravity excluded
    heading: float  # [rad]
    memory: np.ndarray  # (H,)


def heading_yaw(R_WB: np.ndarray) -> float:
    """The angle [rad] from world x to the body's x axis, seen from above."""
    return atan2(R_WB[1, 0], R_WB[0, 0])


def yaw_rotation(yaw: float) -> np.ndarray:
    """The rotation (3, 3) about z by `yaw` [rad]."""
    return np.array([[cos(yaw), -sin(yaw), 0.0], [sin(yaw), cos(yaw), 0.0], [0.0, 0.0, 1.0]])


def decide(
    network: RecurrentNetwork,
    depth: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
    speed: float,
    start_yaw: float,
    memory: np.ndarray,
) -> Decision:
    """The policy's answer to one observation.

    Args:
        network: of the architecture `DEPTHNAV_NETWORK`.
        depth: (H, W) [m] planar, whole multiples of 12 and 16 pixels.
        X_WB, v_WB: pose and velocity [m/s].
        p_WG: the goal [m].
        speed: wanted [m/s].
        start_yaw: of the start frame [rad].
        memory: (H,), before.

    Raises:
        ValueError: for a depth image of another size.
    """
    spec, R_WS = network.spec, yaw_rotation(start_yaw)
    nearest = pool_depth(depth, spec.image_height, spec.image_width)
    image = 1.0 / np.clip(nearest, NEAREST, FARTHEST)
    q_SB = _about_z(-start_yaw, X_WB.rotation().ToQuaternion().wxyz())
    v_target = target_velocity(X_WB.translation(), p_WG, speed)
    state = np.concatenate([v_WB @ R_WS, q_SB, v_target @ R_WS, [speed]])
    output, memory = network.step(image, state, memory)
    a_WB = R_WS @ limit_smoothly(output[:3], ACCELERATION_LIMITS)
    to_goal = atan2(v_target[1], v_target[0])
    heading = to_goal + np.pi * np.tanh(float(output[3]) / np.pi)
    return Decision(a_WB, heading, memory)


def _about_z(yaw: float, q: np.ndarray) -> np.ndarray:
    """The quaternion (4,) wxyz of q turned about z by `yaw` [rad], with w >= 0."""
    c, s = cos(yaw / 2), sin(yaw / 2)
    w, x, y, z = q
    turned = np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
    return np.copysign(1.0, turned[0]) * turned


@dataclass
class DepthNavConfig(DepthPolicyConfig):
    """The policy's weights, and what it is asked for; its camera's pixels are pooled to 16x12."""

    network = DEPTHNAV_NETWORK
    rate = RATE

    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(
            width=IMAGE_SIZE[0], height=IMAGE_SIZE[1], fov_x=FOV_X, max_depth=FARTHEST
        )
    )


class DepthNav(LeafSystem):
    """Flies to the goal by a 16x12 depth image and what it remembers, and says where to look.

    .. pydrake_system::

        name: DepthNav
        input_ports:
        - state
        - goal
        - depth_image_32f
        output_ports:
        - acceleration
        - heading

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``depth_image_32f``: planar depth [m] of the camera ``config.camera``.
    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded; zero before the first update.
    - ``heading`` (1): where body x should point, seen from above [rad] from world x; NaN before.

    Updates at 25 Hz from time 0 by
    :func:`~splatpilot.systems.policies.depthnav.decide`. The discrete state
    holds the acceleration, the heading, the yaw of the start frame (NaN before the first update)
    and the network's memory.

    Raises:
        ValueError, FileNotFoundError: from the constructor on a config out of range, and on weights
            that are missing, damaged, or of another policy, version or architecture.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    depth_image_32f_input_port = input_port("depth_image_32f")
    acceleration_output_port = output_port("acceleration")
    heading_output_port = output_port("heading")

    def __init__(self, config: DepthNavConfig | None = None) -> None:
        super().__init__()
        self._config = config = config or DepthNavConfig()
        config.validate()
        self._network = load_network(config.weights, "depthnav", DEPTHNAV_NETWORK)
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        self._depth_port = self.DeclareAbstractInputPort(
            "depth_image_32f", Value(ImageDepth32F(config.camera.width, config.camera.height))
        )
        self.DeclareStateOutputPort("acceleration", self.DeclareDiscreteState(3))
        self.DeclareStateOutputPort("heading", self.DeclareDiscreteState(np.full(1, np.nan)))
        self._start_yaw = self.DeclareDiscreteState(np.full(1, np.nan))
        self._memory = self.DeclareDiscreteState(self._network.initial_hidden())
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = np.asarray(self._state_port.Eval(context))
        image = cast(ImageDepth32F, self._depth_port.Eval(context))
        X_WB = pose_from_state(state)
        start_yaw = float(context.get_discrete_state(int(self._start_yaw)).value()[0])
        if np.isnan(start_yaw):
            start_yaw = heading_yaw(X_WB.rotation().matrix())
        decision = decide(
            self._network,
            np.asarray(image.data)[..., 0],
            X_WB,
            QuadrotorState.of(state).v_WB,
            np.asarray(self._goal_port.Eval(context)),
            self._config.speed,
            start_yaw,
            np.asarray(context.get_discrete_state(int(self._memory)).value()),
        )
        discrete_state.set_value(0, decision.a_WB)
        discrete_state.set_value(1, np.array([decision.heading]))
        discrete_state.set_value(int(self._start_yaw), np.array([start_yaw]))
        discrete_state.set_value(int(self._memory), decision.memory)
