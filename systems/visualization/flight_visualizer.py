"""The flight, as Meshcat shows it."""

import numpy as np
from pydrake.geometry import Meshcat, Rgba
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem, OutputPort

from splatpilot.systems.policies.hypotheses import Hypotheses, hypotheses_size, num_hypotheses_in
from splatpilot.systems.ports import input_port
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_to_pose import pose_from_state
from splatpilot.systems.visualization.flipbook import page_path, show_page


class FlightVisualizer(LeafSystem):
    """
    Draws the vehicle, the trail it leaves and the fan of trajectory hypotheses in Meshcat.

    .. pydrake_system::

        name: FlightVisualizer
        input_ports:
        - state
        - hypotheses

    Publishes every `period` seconds, live and into a Meshcat recording alike. The vehicle's shape
    is expected at `<path>/vehicle` (see `draw_vehicle`); hypotheses run from green (cheapest) to
    red (dearest).
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
        # The trail's next segment starts where the last picture showed the vehicle.
        self._last_position = self.DeclareDiscreteState(np.full(3, np.nan))
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember_position)

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

    def _remember_position(self, context: Context, discrete_state) -> EventStatus:
        state = self._eval("state", context)
        discrete_state.set_value(QuadrotorState.of(state).p_WB)
        return EventStatus.Succeeded()

    def _publish(self, context: Context) -> EventStatus:
        time = context.get_time()
        page = round(time / self._period)
        X_WB = pose_from_state(self._eval("state", context))
        self._meshcat.SetTransform(f"{self._path}/vehicle", X_WB, time)
        self._draw_trail(context, page, time, X_WB)
        if self._num_hypotheses:
            self._draw_fan(context, page, time)
        return EventStatus.Succeeded()

    def _draw_trail(self, context: Context, page: int, time: float, X_WB: RigidTransform) -> None:
        start = context.get_discrete_state_vector().value()
        if np.isnan(start[0]):
            start = X_WB.translation()
        path = f"{self._path}/trail"
        vertices = np.column_stack([start, X_WB.translation()])
        self._meshcat.SetLine(page_path(path, page), vertices, 4.0, Rgba(0.9, 0.1, 0.1))
        show_page(self._meshcat, path, page, time, keep=True)

    def _draw_fan(self, context: Context, page: int, time: float) -> None:
        hypotheses = Hypotheses.from_vector(self._eval("hypotheses", context), self._num_hypotheses)
        path = f"{self._path}/hypotheses"
        if hypotheses is not None:
            start = hypotheses.X_WB.translation()
            span = max(np.ptp(hypotheses.costs), 1e-9)
            for k, (waypoints_W, cost) in enumerate(
                zip(hypotheses.waypoints_W, hypotheses.costs, strict=True)
            ):
                dearness = float((cost - hypotheses.costs.min()) / span)
                color = Rgba(min(1.0, 2 * dearness), min(1.0, 2 * (1 - dearness)), 0.1)
                vertices = np.column_stack([start, waypoints_W.T])
                self._meshcat.SetLine(f"{page_path(path, page)}/{k}", vertices, 3.0, color)
        show_page(self._meshcat, path, page, time)
