"""DiffAero: a recurrent depth policy that was trained through the dynamics."""

from dataclasses import dataclass, field
from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.policies.depth_policy_config import DepthPolicyConfig
from splatpilot.systems.policies.diffaero_inference import DIFFAERO_NETWORK, FOV_X, RATE, decide
from splatpilot.systems.policies.recurrent_network import load_network
from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_to_pose import pose_from_state


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
    :func:`~splatpilot.systems.policies.diffaero_inference.decide`. The discrete state
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
        a_WB, memory = decide(
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
