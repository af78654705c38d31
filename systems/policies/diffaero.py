"""DiffAero: a recurrent depth policy that was trained through the dynamics."""

from dataclasses import dataclass, field
from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.common.drake import input_port, output_port
from splatpilot.systems.policies.depth_policy_config import DepthPolicyConfig
from splatpilot.systems.policies.observations import (
    heading_frame,
    heading_observation,
    inverse_depth,
    limit_smoothly,
    pool_depth,
)
from splatpilot.systems.policies.recurrent_network import (
    NetworkSpec,
    RecurrentNetwork,
    load_network,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state

RATE = 15.0  # [Hz]
FOV_X = 90.0  # [deg]
NEAREST, FARTHEST = 0.3, 12.0  # [m] range of depth
ACCELERATION_LIMITS = np.array([10.0, 10.0, 6.0])  # [m/s^2], in the heading frame

DIFFAERO_NETWORK = NetworkSpec(
    image_height=9,
    image_width=16,
    convolutions=((16, 3, 2, 1), (32, 3, 2, 1), (32, 3, 1, 0)),
    state_size=9,
    state_features=64,
    hidden_size=128,
    output_size=3,
)


def decide_acceleration(
    network: RecurrentNetwork,
    depth: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
    speed: float,
    memory: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The acceleration a_WB (3,) [m/s^2] in W, gravity excluded, and the memory (H,) afterwards.

    Args:
        network: of the architecture `DIFFAERO_NETWORK`.
        depth: (H, W) [m] planar, whole multiples of 9 and 16 pixels.
        X_WB, v_WB: pose and velocity [m/s].
        p_WG: the goal [m].
        speed: wanted [m/s].
        memory: (H,), before.

    Raises:
        ValueError: for a depth image of another size.
    """
    nearest = pool_depth(depth, network.spec.image_height, network.spec.image_width)
    grid = inverse_depth(nearest, NEAREST, FARTHEST)
    return decide_by_grid(network, grid, X_WB, v_WB, p_WG, speed, memory)


def decide_by_grid(
    network: RecurrentNetwork,
    grid: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
    speed: float,
    memory: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """As `decide_acceleration`, of the inverse depths `grid` (9, 16), see `inverse_depth`, that
    are nearest in
    each cell."""
    R_WB = X_WB.rotation().matrix()
    state = heading_observation(R_WB, X_WB.translation(), v_WB, p_WG, speed)
    output, memory = network.step(grid, state, memory)
    return heading_frame(R_WB) @ limit_smoothly(output, ACCELERATION_LIMITS), memory


@dataclass
class DiffAeroConfig(DepthPolicyConfig):
    """The policy's weights, and what it is asked for; its camera's pixels are pooled to 16x9."""

    network = DIFFAERO_NETWORK
    rate = RATE

    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(width=64, height=36, fov_x=FOV_X, max_depth=20.0)
    )


class DiffAero(LeafSystem):
    """Flies to the goal by a 16x9 depth image and what it remembers.

    .. pydrake_system::

        name: DiffAero
        input_ports:
        - state
        - goal
        - depth_image_32f
        output_ports:
        - acceleration

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``depth_image_32f``: planar depth [m] of the camera ``config.camera``.
    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded; zero before the first update.

    Updates at 15 Hz from time 0 by
    :func:`~splatpilot.systems.policies.diffaero.decide_acceleration`. The discrete state
    holds the acceleration and the network's memory.

    Raises:
        ValueError, FileNotFoundError: from the constructor on a config out of range, and on weights
            that are missing, damaged, or of another policy, version or architecture.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    depth_image_32f_input_port = input_port("depth_image_32f")
    acceleration_output_port = output_port("acceleration")

    def __init__(self, config: DiffAeroConfig | None = None) -> None:
        super().__init__()
        self._config = config = config or DiffAeroConfig()
        config.validate()
        self._network = load_network(config.weights, "diffaero", DIFFAERO_NETWORK)
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        self._depth_port = self.DeclareAbstractInputPort(
            "depth_image_32f", Value(ImageDepth32F(config.camera.width, config.camera.height))
        )
        self.DeclareStateOutputPort("acceleration", self.DeclareDiscreteState(3))
        self._memory = self.DeclareDiscreteState(self._network.initial_hidden())
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = np.asarray(self._state_port.Eval(context))
        image = cast(ImageDepth32F, self._depth_port.Eval(context))
        a_WB, memory = decide_acceleration(
            self._network,
            np.asarray(image.data)[..., 0],
            pose_from_state(state),
            QuadrotorState.of(state).v_WB,
            np.asarray(self._goal_port.Eval(context)),
            self._config.speed,
            np.asarray(context.get_discrete_state(int(self._memory)).value()),
        )
        discrete_state.set_value(0, a_WB)
        discrete_state.set_value(int(self._memory), memory)


__all__ = ["DIFFAERO_NETWORK", "FOV_Y", "RATE", "TOF_FOV_X", "VELOCITY_LIMITS", "decide_velocity"]

TOF_FOV_X, FOV_Y = 86.0, 48.375  # [deg]
VELOCITY_LIMITS = np.array([6.0, 6.0, 3.0])  # [m/s], in the heading frame


def decide_velocity(
    network: RecurrentNetwork,
    grid: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
    speed: float,
    memory: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The velocity (3,) [m/s] in W that the vehicle should take up, and the memory (H,) afterwards.

    Args:
        network: of the architecture `DIFFAERO_NETWORK`.
        grid: (9, 16) proximities, see `time_of_flight_grid`.
        X_WB, v_WB: pose and velocity [m/s].
        p_WG: the goal [m].
        speed: wanted [m/s].
        memory: (H,), before.
    """
    R_WB = X_WB.rotation().matrix()
    state = heading_observation(R_WB, X_WB.translation(), v_WB, p_WG, speed)
    output, memory = network.step(grid, state, memory)
    return heading_frame(R_WB) @ limit_smoothly(output, VELOCITY_LIMITS), memory


@dataclass
class DiffAeroTofConfig(DepthPolicyConfig):
    """The policy's weights, what it is asked for, and the sensor as it is simulated."""

    network = DIFFAERO_NETWORK
    rate = RATE

    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(
            width=64, height=36, fov_x=FOV_X, fov_y=FOV_Y, min_depth=0.0, max_depth=6.0
        )
    )  # The sensor sees 5 m; what noise brings into that is nearer than 6 m.


class DiffAeroTof(LeafSystem):
    """Flies to the goal by what a time-of-flight sensor sees and what it remembers.

    .. pydrake_system::

        name: DiffAeroTof
        input_ports:
        - state
        - goal
        - depth_grid
        output_ports:
        - velocity

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``depth_grid`` (144): proximities in 16x9 cells, see
      :class:`~splatpilot.systems.sensing.time_of_flight.TimeOfFlightGrid`.
    - ``velocity`` (3): wanted v_WB [m/s], W frame; zero before the first update.

    Updates at 15 Hz from time 0 by
    :func:`~splatpilot.systems.policies.diffaero.decide_velocity`. The discrete state holds the
    velocity and the network's memory.

    Raises:
        ValueError, FileNotFoundError: from the constructor on a config out of range, and on weights
            that are missing, damaged, or of another policy, version or architecture.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    depth_grid_input_port = input_port("depth_grid")
    velocity_output_port = output_port("velocity")

    def __init__(self, config: DiffAeroTofConfig | None = None) -> None:
        super().__init__()
        self._config = config = config or DiffAeroTofConfig()
        config.validate()
        self._network = load_network(config.weights, "diffaero_tof", DIFFAERO_NETWORK)
        self._shape = DIFFAERO_NETWORK.image_height, DIFFAERO_NETWORK.image_width
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        self._grid_port = self.DeclareVectorInputPort("depth_grid", int(np.prod(self._shape)))
        self.DeclareStateOutputPort("velocity", self.DeclareDiscreteState(3))
        self._memory = self.DeclareDiscreteState(self._network.initial_hidden())
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = np.asarray(self._state_port.Eval(context))
        velocity, memory = decide_velocity(
            self._network,
            np.asarray(self._grid_port.Eval(context)).reshape(self._shape),
            pose_from_state(state),
            QuadrotorState.of(state).v_WB,
            np.asarray(self._goal_port.Eval(context)),
            self._config.speed,
            np.asarray(context.get_discrete_state(int(self._memory)).value()),
        )
        discrete_state.set_value(0, velocity)
        discrete_state.set_value(int(self._memory), memory)
