"""DiffAero through a time-of-flight sensor, with velocities as commands."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from splatpilot.systems.policies.depth_policy_config import DepthPolicyConfig
from splatpilot.systems.policies.diffaero_tof_inference import (
    DIFFAERO_NETWORK,
    FOV_X,
    FOV_Y,
    RATE,
    decide,
)
from splatpilot.systems.policies.recurrent_network import load_network
from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_to_pose import pose_from_state


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
      :class:`~splatpilot.systems.sensing.time_of_flight_grid.TimeOfFlightGrid`.
    - ``velocity`` (3): wanted v_WB [m/s], W frame; zero before the first update.

    Updates at 15 Hz from time 0 by
    :func:`~splatpilot.systems.policies.diffaero_tof_inference.decide`. The discrete state holds the
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
        velocity, memory = decide(
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
