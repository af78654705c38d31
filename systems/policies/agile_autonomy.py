"""AgileAutonomy: three trajectories from one depth image, learned from an expert that samples."""

from dataclasses import dataclass, field
from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.common.drake import input_port, output_port
from splatpilot.systems.policies.agile_autonomy_inference import (
    AGILE_NETWORK,
    FARTHEST,
    FOV_X,
    IMAGE_SIZE,
    MODES,
    RATE,
    load_network,
    plan,
)
from splatpilot.systems.policies.depth_policy_config import DepthPolicyConfig
from splatpilot.systems.policies.hypotheses import Hypotheses, no_plan
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.state import pose_from_state


@dataclass
class AgileAutonomyConfig(DepthPolicyConfig):
    """The policy's weights, and what it is asked for; its camera's pixels are pooled to 32x24."""

    network = AGILE_NETWORK
    rate = RATE

    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(
            width=IMAGE_SIZE[0], height=IMAGE_SIZE[1], fov_x=FOV_X, max_depth=FARTHEST
        )
    )


class AgileAutonomy(LeafSystem):
    """Plans three trajectories with costs from a 32x24 depth image.

    .. pydrake_system::

        name: AgileAutonomy
        input_ports:
        - state
        - goal
        - depth_image_32f
        output_ports:
        - hypotheses

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``depth_image_32f``: planar depth [m] of the camera ``config.camera``.
    - ``hypotheses`` (8 + 31 * 3): as `Hypotheses.to_vector`, in the body frame B at the time of
      planning; a discrete state, NaN before the first update.

    Updates at 15 Hz from time 0 by
    :func:`~splatpilot.systems.policies.agile_autonomy_inference.plan`.

    Raises:
        ValueError, FileNotFoundError: from the constructor on a config out of range, and on weights
            that are missing, damaged, or of another policy, version or architecture.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    depth_image_32f_input_port = input_port("depth_image_32f")
    hypotheses_output_port = output_port("hypotheses")

    def __init__(self, config: AgileAutonomyConfig | None = None) -> None:
        super().__init__()
        self._config = config = config or AgileAutonomyConfig()
        config.validate()
        self._network = load_network(config.weights)
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        self._depth_port = self.DeclareAbstractInputPort(
            "depth_image_32f", Value(ImageDepth32F(config.camera.width, config.camera.height))
        )
        self.DeclareStateOutputPort("hypotheses", self.DeclareDiscreteState(no_plan(MODES)))
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = np.asarray(self._state_port.Eval(context))
        image = cast(ImageDepth32F, self._depth_port.Eval(context))
        last = np.asarray(context.get_discrete_state(0).value())
        hypotheses = plan(
            self._network,
            context.get_time(),
            np.asarray(image.data)[..., 0],
            pose_from_state(state),
            state,
            np.asarray(self._goal_port.Eval(context)),
            self._config.speed,
            Hypotheses.from_vector(last, MODES),
        )
        discrete_state.set_value(hypotheses.to_vector())
