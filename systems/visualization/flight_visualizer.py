"""The flight, as Meshcat shows it."""

import numpy as np
from pydrake.geometry import Meshcat, Rgba
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem, OutputPort

from splatpilot.systems.policies.hypotheses import Hypotheses, hypotheses_size, num_hypotheses_in
from splatpilot.systems.ports import input_port
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_to_pose import pose_from_state

_TRAIL = 120
"""How many pictures the trail reaches back."""


class FlightVisualizer(LeafSystem):
    """
    Draws the vehicle, the trail it leaves and the fan of trajectory hypotheses in Meshcat.

    .. pydrake_system::

        name: FlightVisualizer
        input_ports:
        - state
        - hypotheses

    Publishes every `period` seconds, for who watches live: a Meshcat recording keeps the vehicle's
    pose alone, where `replay_page` has the rest. The vehicle's shape is expected at
    `<path>/vehicle` (see `draw_vehicle`). The trail is one line, and the fan one mesh: hypotheses
    run from green (cheapest) to red (dearest).
    """

    state_input_port = input_port("state")
    hypotheses_input_port = input_port("hypotheses")

    def __init__(
        self,
        meshcat: Meshcat,
        num_hypotheses: int,
        period: float = 1 / 15,
        path: str = "/splatpilot",
    ):
        """
        Args:
            meshcat: where to draw.
            num_hypotheses: how many trajectories the `hypotheses` port carries; without any there
                is no such port, and no fan.
            period: time between two pictures [s].
            path: Meshcat path under which everything is drawn.
        """
        super().__init__()
        self._meshcat = meshcat
        self._num_hypotheses = num_hypotheses
        self._period = period
        self._path = path
        self.DeclareVectorInputPort("state", 13)
        if num_hypotheses:
            self.DeclareVectorInputPort("hypotheses", hypotheses_size(num_hypotheses))
        # Positions of the last pictures, the latest last; NaN where there were fewer.
        self.DeclareDiscreteState(np.full(3 * _TRAIL, np.nan))
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._extend_trail)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        state_port: OutputPort,
        meshcat: Meshcat,
        hypotheses_port: OutputPort | None = None,
    ) -> "FlightVisualizer":
        """Adds a visualizer, named `flight_visualizer`, of a state and perhaps of hypotheses."""
        count = num_hypotheses_in(hypotheses_port.size()) if hypotheses_port is not None else 0
        visualizer = FlightVisualizer(meshcat, count)
        builder.AddNamedSystem("flight_visualizer", visualizer)
        builder.Connect(state_port, visualizer.state_input_port())
        if hypotheses_port is not None:
            builder.Connect(hypotheses_port, visualizer.hypotheses_input_port())
        return visualizer

    def _eval(self, port: str, context: Context) -> np.ndarray:
        return np.asarray(self.GetInputPort(port).Eval(context))

    def _trail(self, context: Context) -> np.ndarray:
        """(n, 3) [m] The positions of the last pictures and of this one."""
        before = context.get_discrete_state_vector().value().reshape(-1, 3)
        p_WB = QuadrotorState.of(self._eval("state", context)).p_WB
        return np.vstack([before[~np.isnan(before[:, 0])], p_WB])

    def _extend_trail(self, context: Context, discrete_state) -> EventStatus:
        trail = self._trail(context)[-_TRAIL:]
        missing = np.full((_TRAIL - len(trail), 3), np.nan)
        discrete_state.set_value(np.vstack([missing, trail]).ravel())
        return EventStatus.Succeeded()

    def _publish(self, context: Context) -> EventStatus:
        X_WB = pose_from_state(self._eval("state", context))
        self._meshcat.SetTransform(f"{self._path}/vehicle", X_WB, context.get_time())
        red = Rgba(0.9, 0.1, 0.1)
        self._meshcat.SetLine(f"{self._path}/trail", self._trail(context).T, 4.0, red)
        if self._num_hypotheses:
            vector = self._eval("hypotheses", context)
            plan = Hypotheses.from_vector(vector, self._num_hypotheses)
            if plan is not None:
                self._meshcat.SetTriangleColorMesh(f"{self._path}/hypotheses", *fan_mesh(plan))
        return EventStatus.Succeeded()


def fan_mesh(plan: Hypotheses, width: float = 0.02) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Level ribbons along K hypotheses, from green (cheapest) to red (dearest).

    Args:
        width: of a ribbon [m].

    Returns:
        Vertices (3, V) [m], triangles (3, F) int32 seen from both sides, colours (3, V) in 0 to 1.
    """
    K = len(plan.costs)
    start = np.broadcast_to(plan.X_WB.translation(), (K, 1, 3))
    path = np.concatenate([start, plan.waypoints_W], axis=1)  # (K, T + 1, 3)
    along = np.gradient(path, axis=1)
    across = np.stack([-along[..., 1], along[..., 0], np.zeros(along.shape[:2])], axis=-1)
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    sides = np.stack([path - 0.5 * width * across, path + 0.5 * width * across], axis=2)
    dearness = (plan.costs - plan.costs.min()) / max(np.ptp(plan.costs), 1e-9)
    color = np.column_stack(
        [np.minimum(1, 2 * dearness), np.minimum(1, 2 * (1 - dearness)), np.full(K, 0.1)]
    )
    T = path.shape[1]
    first = (2 * (np.arange(K)[:, None] * T + np.arange(T - 1))).ravel()
    a, b, c, d = first, first + 1, first + 2, first + 3
    faces = np.concatenate([[a, b, c], [c, b, d], [a, c, b], [c, d, b]], axis=1)
    return sides.reshape(-1, 3).T, faces.astype(np.int32), np.repeat(color, 2 * T, axis=0).T
