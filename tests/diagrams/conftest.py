import numpy as np
import pytest

from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Cylinder
from splatpilot.systems.splats.scene import GaussianScene


@pytest.fixture(scope="session")
def post_world() -> World:
    """A hall of 10 x 6 x 4 m with one post between start and goal, drawn with 400 Gaussians."""
    post = Cylinder(p_WA=[5.0, 0.0, -2.0], p_WB=[5.0, 0.0, 6.0], radius=0.5)
    field = AnalyticDistanceField([post], np.array([0.0, -3, 0]), np.array([10.0, 3, 4]))
    angles, heights = np.meshgrid(np.linspace(0, 2 * np.pi, 20), np.linspace(0, 4, 20))
    means = np.column_stack(
        [5 + 0.5 * np.cos(angles.ravel()), 0.5 * np.sin(angles.ravel()), heights.ravel()]
    )
    gaussians = GaussianScene.from_colors(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (400, 1)),
        scales=np.full((400, 3), 0.1),
        opacities=np.full(400, 0.95),
        colors=np.tile([0.8, 0.3, 0.1], (400, 1)),
    )
    return World(
        name="post",
        gaussians=gaussians,
        distance_field=field,
        esdf=esdf_from_distance_field(field, 0.2),
        background=(0.5, 0.7, 1.0),
        p_WS=np.array([1.0, 0, 2]),
        p_WG=np.array([9.0, 0, 2]),
    )
