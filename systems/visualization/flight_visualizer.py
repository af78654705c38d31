"""FlightVisualizer: the vehicle, its trail, hypotheses and vectors in Meshcat."""

from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat, Rgba
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    OutputPort,
    System,
)

from splatpilot.systems.common.drake import connect, vector_input
from splatpilot.systems.common.validation import require
from splatpilot.systems.policies.hypotheses import Hypotheses, hypotheses_size, num_hypotheses_in
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state
from splatpilot.systems.visualization.meshcat_drawing import draw_vehicle, vehicle_path


class Drawing(NamedTuple):
    """An arrow from the vehicle."""

    inputs: dict[str, int]  # sizes of ports by their names
    color: Rgba
    arrow: Callable[..., np.ndarray]  # (3,) [m] in W, of the `QuadrotorState` and the inputs


DRAWINGS = {
    "velocity": Drawing({}, Rgba(0.1, 0.8, 0.3), lambda state: 0.5 * state.v_WB),
    "thrust": Drawing(
        {"command": 4},
        Rgba(1.0, 0.6, 0.1),
        lambda state, command: 0.1 * _rotate(state, [0.0, 0.0, command[0]]),
    ),
    "rates": Drawing(
        {"command": 4},
        Rgba(0.8, 0.2, 0.9),
        lambda state, command: 0.5 * _rotate(state, command[1:]),
    ),
    "waypoint": Drawing({"waypoint": 3}, Rgba(0.1, 0.9, 0.9), lambda state, p: p - state.p_WB),
    "nearest": Drawing(
        {"distance": 1, "gradient": 3}, Rgba(1.0, 0.2, 0.2), lambda _, d, gradient: -d * gradient
    ),
    "barrier": Drawing(
        {"barrier": 1, "gradient": 3}, Rgba(1.0, 1.0, 0.2), lambda _, b, gradient: b * gradient
    ),
}
"""Arrows on request: the velocity in 0.5 s, the commanded thrust (10 m/s^2 a meter) and body rates
(2 rad/s a meter), to the waypoint and the nearest surface, and the barrier away from it."""

_AXES = {"x": Rgba(1, 0, 0), "y": Rgba(0, 1, 0), "z": Rgba(0, 0, 1)}
_TRAIL = 120
"""[-] Number of images that the trail spans."""


def _rotate(state: QuadrotorState, v_B: ArrayLike) -> np.ndarray:
    return pose_from_state(state.to_vector()).rotation() @ np.asarray(v_B)


class FlightVisualizer(LeafSystem):
    """Draws the vehicle, its trail and the fan of trajectory hypotheses in Meshcat.

    .. pydrake_system::

        name: FlightVisualizer
        input_ports: [state, hypotheses]

    Publishes every `period` [s] and by ForcedPublish. Hypotheses are green (lowest cost) to red
    (highest). Further input ports are those of `DRAWINGS`.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        num_hypotheses: int = 0,
        period: float = 1 / 15,
        *,
        draw: Collection[str] = (),
        path: str = "/splatpilot",
        radius: float = VEHICLE_RADIUS,
    ):
        """Declares the ports.

        Args:
            num_hypotheses: 0 for no port `hypotheses`.
            draw: names of `DRAWINGS`, and "axes" for those of the body.
            path: Meshcat's folder of the drawings; the vehicle is `PATH/vehicle`.
            radius: of the vehicle [m].
        """
        super().__init__()
        self._meshcat, self._num_hypotheses, self._path = meshcat, num_hypotheses, path
        for name in draw:
            known = [*DRAWINGS, "axes"]
            require(name in known, "draw", f"names of {', '.join(known)}", name)
        self._drawings = [name for name in draw if name in DRAWINGS]
        draw_vehicle(meshcat, f"{path}/vehicle", radius)
        for k, (axis, color) in enumerate(_AXES.items() if "axes" in draw else ()):
            ends = np.column_stack([np.zeros(3), 1.5 * radius * np.eye(3)[k]])
            meshcat.SetLine(f"{path}/vehicle/axes/{axis}", ends, 3.0, color)
        self.DeclareVectorInputPort("state", 13)
        if num_hypotheses:
            self.DeclareVectorInputPort("hypotheses", hypotheses_size(num_hypotheses))
        sizes = {k: v for name in self._drawings for k, v in DRAWINGS[name].inputs.items()}
        for name, size in sizes.items():
            self.DeclareVectorInputPort(name, size)
        # Positions of the last images, the latest last; NaN before.
        self.DeclareDiscreteState(np.full(3 * _TRAIL, np.nan))
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._extend_trail)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        state_port: OutputPort,
        meshcat: Meshcat,
        hypotheses_port: OutputPort | None = None,
        *,
        draw: Collection[str] = (),
        sources: Mapping[str, OutputPort] = MappingProxyType({}),
        name: str = "",
        path: str = "",
        radius: float = VEHICLE_RADIUS,
    ) -> "FlightVisualizer":
        """Adds a visualizer.

        Args:
            draw: see the constructor; `sources` are the ports for its inputs, by name.
            name: `flight_visualizer` by default, `NAME_flight_visualizer` if the vehicle, the
                system of `state_port`, is named `NAME_plant`.
            path: `/splatpilot` by default, or `/splatpilot/NAME`.
            radius: of the vehicle [m].
        """
        folder = vehicle_path(cast(System, state_port.get_system()), "plant")
        name = name or "_".join([*folder.split("/")[2:], "flight_visualizer"])
        path = path or folder
        count = num_hypotheses_in(hypotheses_port.size()) if hypotheses_port is not None else 0
        visualizer = FlightVisualizer(meshcat, count, draw=draw, path=path, radius=radius)
        inputs = [visualizer.get_input_port(k) for k in range(visualizer.num_input_ports())]
        ports = {"state": state_port, "hypotheses": hypotheses_port, **sources}
        for port in inputs:
            given = port.get_name() in ports
            require(given, "sources", f"with {port.get_name()}", f"{[*sources]}")
        builder.AddNamedSystem(name, visualizer)
        for port in inputs:
            connect(builder, cast(OutputPort, ports[port.get_name()]), port)
        return visualizer

    def _trail(self, context: Context) -> np.ndarray:
        """Returns the positions (n, 3) [m] of the last images and of this one."""
        before = context.get_discrete_state_vector().value().reshape(-1, 3)
        p_WB = QuadrotorState.of(vector_input(self, "state", context)).p_WB
        return np.vstack([before[~np.isnan(before[:, 0])], p_WB])

    def _extend_trail(self, context: Context, discrete_state) -> EventStatus:
        trail = self._trail(context)[-_TRAIL:]
        missing = np.full((_TRAIL - len(trail), 3), np.nan)
        discrete_state.set_value(np.vstack([missing, trail]).ravel())
        return EventStatus.Succeeded()

    def _publish(self, context: Context) -> EventStatus:
        x = vector_input(self, "state", context)
        self._meshcat.SetTransform(f"{self._path}/vehicle", pose_from_state(x), context.get_time())
        red = Rgba(0.9, 0.1, 0.1)
        self._meshcat.SetLine(f"{self._path}/trail", self._trail(context).T, 4.0, red)
        if self._num_hypotheses:
            vector = vector_input(self, "hypotheses", context)
            plan = Hypotheses.from_vector(vector, self._num_hypotheses)
            if plan is not None:
                self._meshcat.SetTriangleColorMesh(f"{self._path}/hypotheses", *fan_mesh(plan))
        state = QuadrotorState.of(x)
        for name in self._drawings:
            inputs, color, arrow = DRAWINGS[name]
            values = (vector_input(self, port, context) for port in inputs)
            ends = state.p_WB + np.array([np.zeros(3), np.nan_to_num(arrow(state, *values))])
            self._meshcat.SetLine(f"{self._path}/{name}", ends.T, 5.0, color)
        return EventStatus.Succeeded()


_RIBBON_WIDTH = 0.02  # [m]


def hypothesis_colors(costs: np.ndarray) -> np.ndarray:
    """Returns colors (K, 3), 0 to 1, of costs (K,): green (lowest) to red (highest)."""
    known = np.isfinite(costs)  # others are the highest
    lowest, highest = (f(costs[known]) if known.any() else 0.0 for f in (np.min, np.max))
    cost = np.where(known, (np.where(known, costs, 0.0) - lowest) / max(highest - lowest, 1e-9), 1)
    return np.column_stack(
        [np.minimum(1, 2 * cost), np.minimum(1, 2 * (1 - cost)), np.full(len(cost), 0.1)]
    )


def fan_mesh(plan: Hypotheses) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Makes horizontal ribbons along K hypotheses, see `hypothesis_colors`: vertices (3, V) [m],
    triangles (3, F) int32 seen from both sides, colors (3, V)."""
    K = len(plan.costs)
    start = np.broadcast_to(plan.X_WB.translation(), (K, 1, 3))
    path = np.concatenate([start, plan.waypoints_W], axis=1)  # (K, T + 1, 3)
    along = np.gradient(path, axis=1)
    across = np.stack([-along[..., 1], along[..., 0], np.zeros(along.shape[:2])], axis=-1)
    across *= 0.5 * _RIBBON_WIDTH / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    sides = np.stack([path - across, path + across], axis=2)
    color = hypothesis_colors(plan.costs)
    T = path.shape[1]
    first = (2 * (np.arange(K)[:, None] * T + np.arange(T - 1))).ravel()
    a, b, c, d = first, first + 1, first + 2, first + 3
    faces = np.concatenate([[a, b, c], [c, b, d], [a, c, b], [c, d, b]], axis=1)
    return sides.reshape(-1, 3).T, faces.astype(np.int32), np.repeat(color, 2 * T, axis=0).T
