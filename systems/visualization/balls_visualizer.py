"""Balls that move, as Meshcat shows them."""

import numpy as np
from pydrake.geometry import Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem

from splatpilot.systems.collision.moving_balls import MovingBalls

_FAR_BELOW = np.array([0.0, 0.0, -1000.0])  # [m], where balls are shown that are nowhere


class BallsVisualizer(LeafSystem):
    """
    Draws balls in Meshcat where they are at the Context's time; it has no ports.

    Publishes every `period` seconds, live and into a Meshcat recording alike, ball k at
    `<path>/k`.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        balls: MovingBalls,
        period: float = 1 / 15,
        path: str = "/splatpilot/balls",
    ):
        """
        Args:
            meshcat: where to draw.
            balls: what is drawn.
            period: time between two pictures [s].
            path: Meshcat path under which everything is drawn.
        """
        super().__init__()
        self._meshcat, self._balls, self._path = meshcat, balls, path
        for k, radius in enumerate(balls.radii):
            meshcat.SetObject(f"{path}/{k}", Sphere(radius), Rgba(0.9, 0.75, 0.1))
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder, balls: MovingBalls, meshcat: Meshcat
    ) -> "BallsVisualizer":
        """Adds a visualizer of balls, named `balls_visualizer`."""
        visualizer = BallsVisualizer(meshcat, balls)
        builder.AddNamedSystem("balls_visualizer", visualizer)
        return visualizer

    def _publish(self, context: Context) -> EventStatus:
        time = context.get_time()
        for k, center in enumerate(self._balls.centers(time)):
            p_WO = center if np.isfinite(center).all() else _FAR_BELOW
            self._meshcat.SetTransform(f"{self._path}/{k}", RigidTransform(p_WO), time)
        return EventStatus.Succeeded()
