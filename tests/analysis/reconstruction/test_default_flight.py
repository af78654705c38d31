"""How much of its default flight looks into what nobody captured."""

from dataclasses import replace

import numpy as np
import pytest

from splatpilot.analysis.reconstruction.measure_scene import SceneMetrics, unseen_fraction
from splatpilot.diagrams.worlds.scene_folder import write_scene_folder
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.splats.scene import GaussianScene


def wall(x: float, lower_y: float, color: float) -> GaussianScene:
    """An opaque wall across x, from `lower_y` to the left of anything that a camera sees [m]."""
    y, z = np.meshgrid(np.arange(lower_y + 0.2, 20.0, 0.25), np.arange(-15.0, 18.0, 0.25))
    count = y.size
    return GaussianScene.from_colors(
        np.column_stack([np.full(count, x), y.ravel(), z.ravel()]),
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.tile([0.001, 0.2, 0.2], (count, 1)),
        np.full(count, 0.99),
        np.full((count, 3), color),
    )


@pytest.fixture
def write_scene(tmp_path):
    """Writes a scene of 6 x 3 x 2.5 m that is flown along x, looking at a captured wall."""
    known = np.zeros((60, 30, 25), bool)
    free = esdf_from_occupancy(known, known, np.zeros(3), 0.1)
    ends = np.array([1.0, 1.5, 1.2]), np.array([5.0, 1.5, 1.2])

    world = World("hall", wall(5.9, -20.0, 1.0), free, free, (1.0, 1.0, 1.0), *ends)

    def write(frontier: GaussianScene | None, metric: bool = True):
        write_scene_folder(tmp_path / "hall", world, frontier, provenance="test", metric=metric)
        return tmp_path / "hall"

    return write


@pytest.mark.parametrize(
    ("x", "lower_y", "expected"),
    [(5.8, -20.0, 1.0), (5.8, 1.5, 0.5), (6.0, -20.0, 0.0), (0.1, -20.0, 0.0)],
)
def test_the_share_is_that_of_the_pixels_that_show_the_frontier(write_scene, x, lower_y, expected):
    assert unseen_fraction(write_scene(wall(x, lower_y, 0.5))) == pytest.approx(expected, abs=0.04)


def test_a_scene_that_cannot_be_flown_in_has_no_share(write_scene):
    assert unseen_fraction(write_scene(None)) == 0.0
    assert unseen_fraction(write_scene(None, metric=False)) is None


def test_a_flight_that_looks_mostly_into_unseen_space_is_warned_of():
    measures = SceneMetrics(True, 8, 8, {}, {}, "", flight_unseen_fraction=0.2)
    assert "unseen in flight       20.0%" in str(measures)
    assert "warning" not in str(measures)
    assert "warning: a flight" in str(replace(measures, flight_unseen_fraction=0.6))
    assert measures.as_json()["flight_unseen_fraction"] == 0.2
