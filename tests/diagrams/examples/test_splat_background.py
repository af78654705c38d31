"""The example of Drake's bodies in a forest of Gaussians."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from splatpilot.diagrams.examples.splat_background import (
    RADIUS,
    BuildSplatBackgroundDiagram,
    throw,
    widest_lane,
)
from splatpilot.diagrams.worlds.forest.config import ForestConfig
from splatpilot.diagrams.worlds.make_world import make_world


@pytest.mark.usefixtures("opengl")
def test_runs(tmp_path):
    """The command writes its pictures, in which red and blue come and go between trunks."""
    module = "splatpilot.diagrams.examples.splat_background"
    command = [sys.executable, "-m", module, "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.glob("depth_*.png"))) == 8
    colors = [np.array(cv2.imread(str(tmp_path / f"color_{k}.png")), dtype=int) for k in range(8)]
    red = [int(np.sum(c[..., 2] > 100 + c[..., :2].max(axis=-1))) for c in colors]
    blue = [int(np.sum(c[..., 0] > 60 + c[..., 1:].max(axis=-1))) for c in colors]
    assert red[0] == 0 and max(red) > 2000  # the ball starts behind the nearest trunk
    assert min(blue[1:]) < 0.4 * max(blue)  # the box is partly hidden on its way


@pytest.mark.usefixtures("opengl")
def test_bodies_bounce_and_keep_clear_of_trunks():
    """Ball and box stay above the ground, move across the view, and never touch what is seen."""
    world = make_world(ForestConfig(), seed=0)
    diagram = BuildSplatBackgroundDiagram(world, 32, 24)
    simulator = throw(diagram, world)
    plant = diagram.GetSubsystemByName("plant")
    context = plant.GetMyContextFromRoot(simulator.get_context())
    path = []
    for moment in np.arange(0, 2.1, 0.1):
        simulator.AdvanceTo(moment)
        path.append(
            [plant.GetBodyByName(n).EvalPoseInWorld(context).translation() for n in ("ball", "box")]
        )
    p_WB = np.array(path)  # (times, 2, 3)
    assert np.all(np.abs(p_WB[-1, :, 1] - p_WB[0, :, 1]) > 4)
    assert np.all(p_WB[..., 2] > 0.9 * RADIUS)
    high = p_WB + np.array([0, 0, 1.0])  # clear of the ground
    assert world.distance_field.distance(high).min() > RADIUS


def test_widest_lane_avoids_the_post(post_world):
    """The lane passes the one post of the world as far away as it may."""
    assert widest_lane(post_world, 0.0, 7.0, 2.0) == pytest.approx(1.0)
    assert widest_lane(post_world, 3.5, 7.0, 2.0) == pytest.approx(7.9)
