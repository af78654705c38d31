"""Bodies that move in a scene: Gaussians for cameras, and spheres around them for collisions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem

from splatpilot.systems.collision.shapes import MovingSpheres, SpheresInTime
from splatpilot.systems.common.drake import output_port, weak_callback
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.baked_scene import PlacedGaussians, placed_together
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.state import pose_between

_PERIOD = 0.02  # [s] between remembered poses
_MEMORY = 100  # number of remembered poses: 2 s
_ROW = 8  # numbers of one: time, position and quaternion (wxyz)


class MovingObstacles:
    """Obstacles that move in time without rotating: spheres for collisions, and for cameras bodies
    of Gaussians, each about its own center."""

    def __init__(self, spheres: MovingSpheres, bodies: Sequence[GaussianScene]) -> None:
        self.spheres, self.bodies = spheres, list(bodies)
        self._about_centers = placed_together(bodies)
        self._body = np.repeat(np.arange(len(bodies)), [len(body) for body in bodies])

    def gaussians(self, time: float) -> PlacedGaussians:
        """Returns the Gaussians at a time [s]; those of absent bodies have no opacity."""
        centers, own = self.spheres.centers(time), self._about_centers
        present = np.isfinite(centers).all(axis=1)
        offsets = np.where(present[:, None], centers, 0.0).astype(np.float32)
        placed = own._replace(means=own.means + offsets[self._body])
        if present.all():
            return placed
        return placed._replace(opacities=own.opacities * present[self._body])

    def merged_with(self, other: "MovingObstacles") -> "MovingObstacles":
        """Returns the obstacles of both."""
        spheres = self.spheres.merged_with(other.spheres)
        return MovingObstacles(spheres, [*self.bodies, *other.bodies])


class Track(NamedTuple):
    """A body and the poses that it had, the last one now."""

    gaussians: GaussianScene  # in its own frame O
    radius: float  # [m] of the sphere about the origin of O
    rows: NDArray[np.float64]  # (n, 8), time [s], increasing, p_WO [m] and q_WO (wxyz)

    def pose(self, time: float) -> RigidTransform:
        """Returns X_WO at a time [s]: interpolated, and later at constant velocity."""
        times, last = self.rows[:, 0], len(self.rows) - 1
        if last == 0 or time <= times[0]:
            return _pose(self.rows[0])
        first = min(int(np.searchsorted(times, time)), last) - 1
        s = (time - times[first]) / (times[first + 1] - times[first])
        X_WO0, X_WO1 = _pose(self.rows[first]), _pose(self.rows[first + 1])
        p_WO = (1.0 - s) * X_WO0.translation() + s * X_WO1.translation()
        return RigidTransform(pose_between(X_WO0, X_WO1, min(s, 1.0)).rotation(), p_WO)


def _pose(row: NDArray[np.float64]) -> RigidTransform:
    return RigidTransform(Quaternion(row[4:]), row[1:4])


@dataclass(frozen=True, eq=False)
class Bodies(SpheresInTime):
    """Value of ports `moving`: the bodies now, and their poses before and after.

    Bodies with a pose input are predicted at constant velocity, and remembered for 2 s.
    """

    time: float  # [s], now
    obstacles: MovingObstacles | None = None
    tracks: tuple[Track, ...] = ()

    @property
    def radii(self) -> NDArray[np.float64]:
        """(M,) [m] of the obstacles, then the bodies with poses."""
        radii = [track.radius for track in self.tracks]
        return np.append(self.obstacles.spheres.radii if self.obstacles else [], radii)

    def centers(self, time: float) -> NDArray[np.float64]:
        """Returns the centers (M, 3) [m] at a time [s]; infinite for an absent body."""
        centers = [track.pose(time).translation()[None] for track in self.tracks]
        if self.obstacles:
            centers = [self.obstacles.spheres.centers(time), *centers]
        return np.concatenate([np.zeros((0, 3)), *centers])

    def gaussians(self, time: float) -> PlacedGaussians:
        """Returns the Gaussians at a time [s]."""
        placed = [track.gaussians.transformed_by(track.pose(time)) for track in self.tracks]
        if self.obstacles:
            placed = [self.obstacles.gaussians(time), *placed]
        return placed_together(placed)


class MovingBodies(LeafSystem):
    """Outputs the bodies that move in a scene, for cameras, distances and planners.

    .. pydrake_system::

        name: MovingBodies
        input_ports: [(name of a body)]
        output_ports: [moving]

    `DeclareBody` adds a body whose pose X_WO is an input port. `moving` is a value of `Bodies`;
    connect it to the ports `moving` of `SplatCamera`, `EsdfCollision` and `PrivilegedPlanner`.
    """

    moving_output_port = output_port("moving")

    def __init__(self, obstacles: MovingObstacles | None = None) -> None:
        """Declares the output; `obstacles` follow paths, as those of a world do."""
        super().__init__()
        self._obstacles = obstacles
        self._bodies: list[tuple[GaussianScene, float]] = []
        self.DeclareAbstractOutputPort(
            "moving",
            lambda: AbstractValue.Make(object()),
            weak_callback(self._calc),
            {self.time_ticket(), self.all_input_ports_ticket(), self.xd_ticket()},
        )

    def DeclareBody(self, name: str, gaussians: GaussianScene, radius: float) -> InputPort:
        """Declares a body, until the Diagram is built, and returns its port of poses X_WO.

        Args:
            gaussians: in the frame O of the body.
            radius: [m] of the sphere about the origin of O that vehicles collide with; 0 for none.
        """
        require(0.0 <= radius < np.inf, "radius", "in [0, inf) m", radius)
        require(not self.HasInputPort(name), "name", "new among the bodies", repr(name))
        if not self._bodies:
            self.DeclarePeriodicDiscreteUpdateEvent(_PERIOD, 0.0, self._remember)
        self._bodies.append((gaussians, radius))
        self.DeclareDiscreteState(np.full(_MEMORY * _ROW, np.nan))
        return self.DeclareAbstractInputPort(name, Value(RigidTransform()))

    def _rows(self, context: Context, body: int) -> np.ndarray:
        """Returns remembered poses of a body and that of now, (n, 8), oldest first."""
        X_WO = cast(RigidTransform, self.get_input_port(body).Eval(context))
        q_WO, time = X_WO.rotation().ToQuaternion().wxyz(), context.get_time()
        held = np.asarray(context.get_discrete_state(body).value()).reshape(-1, _ROW)
        before = held[held[:, 0] < time - 1e-6]  # not of this event, whose times are rounded
        return np.vstack([before, np.hstack([time, X_WO.translation(), q_WO])])

    def _remember(self, context: Context, discrete_state: DiscreteValues) -> None:
        for body in range(len(self._bodies)):
            rows = np.full((_MEMORY, _ROW), np.nan)
            kept = self._rows(context, body)[-_MEMORY:]
            rows[-len(kept) :] = kept
            discrete_state.set_value(body, rows.ravel())

    def _calc(self, context: Context, output) -> None:
        tracks = tuple(
            Track(*body, self._rows(context, index)) for index, body in enumerate(self._bodies)
        )
        output.set_value(Bodies(context.get_time(), self._obstacles, tracks))
