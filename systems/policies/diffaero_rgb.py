"""DiffAero in colours: it judges the depths that it flies by from a single image."""

from dataclasses import dataclass, field
from typing import ClassVar, cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageRgba8U

from splatpilot.systems.policies.depth_policy_config import require_speed
from splatpilot.systems.policies.diffaero_inference import RATE
from splatpilot.systems.policies.diffaero_rgb_inference import decide, load_network
from splatpilot.systems.policies.monocular_depth import FOV_X, HEIGHT, WIDTH, require_view
from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_to_pose import pose_from_state


@dataclass
class DiffAeroRgbConfig:
    """The policy's weights, and what it is asked for."""

    rate: ClassVar[float] = RATE

    # [m/s] Speed that it is asked to fly at; the model card of its weights says what they know.
    speed: float = 2.0
    # File of weights, as `splatpilot train` writes them; those that ship where left empty.
    weights: str = ""
    # What it sees through: 160 pixels of 90 degrees wide, level; the middle 90 rows are looked at.
    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(width=WIDTH, height=HEIGHT, fov_x=FOV_X)
    )

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        require_speed(self)
        self.camera.validate()
        require_view(self.camera.width, self.camera.height)
        if self.camera.fov_x != FOV_X:
            raise ValueError(
                f"camera.fov_x is {self.camera.fov_x} deg, but this policy judges depths through "
                f"{FOV_X:g}; set it to that"
            )


class DiffAeroRgb(LeafSystem):
    """Flies to the goal by a colour image and what it remembers.

    .. pydrake_system::

        name: DiffAeroRgb
        input_ports:
        - state
        - goal
        - color_image
        output_ports:
        - acceleration

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``color_image``: RGBA of the camera ``config.camera``.
    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded; zero before the first update.

    Updates at 15 Hz from time 0 by
    :func:`~splatpilot.systems.policies.diffaero_rgb_inference.decide`. The discrete state holds the
    acceleration and the network's memory.

    Raises:
        ValueError, FileNotFoundError: from the constructor on a config out of range, and on weights
            that are missing, damaged, or of another policy, version or architecture.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    color_image_input_port = input_port("color_image")
    acceleration_output_port = output_port("acceleration")

    def __init__(self, config: DiffAeroRgbConfig | None = None) -> None:
        super().__init__()
        self._config = config = config or DiffAeroRgbConfig()
        config.validate()
        self._network = load_network(config.weights)
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        self._color_port = self.DeclareAbstractInputPort(
            "color_image", Value(ImageRgba8U(config.camera.width, config.camera.height))
        )
        self.DeclareStateOutputPort("acceleration", self.DeclareDiscreteState(3))
        self._memory = self.DeclareDiscreteState(self._network.policy.initial_hidden())
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = np.asarray(self._state_port.Eval(context))
        image = cast(ImageRgba8U, self._color_port.Eval(context))
        a_WB, memory = decide(
            self._network,
            np.asarray(image.data)[..., :3],
            pose_from_state(state),
            QuadrotorState.of(state).v_WB,
            np.asarray(self._goal_port.Eval(context)),
            self._config.speed,
            np.asarray(context.get_discrete_state(int(self._memory)).value()),
        )
        discrete_state.set_value(0, a_WB)
        discrete_state.set_value(int(self._memory), memory)
