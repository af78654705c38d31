"""From raw frames of a time-of-flight sensor to grids."""

import math

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.sensing.time_of_flight import (
    TimeOfFlight,
    TimeOfFlightGrid,
    time_of_flight_grid,
)

WHOLE = TimeOfFlight(fov=110.0, anchor="center", shift=0)
"""A sensor of whose frame nothing is cropped."""


def frame(depth: float = 10.0) -> np.ndarray:
    return np.full((240, 180), depth)


def pixel_by_pixel(depth: np.ndarray, top: int, bottom: int) -> np.ndarray:
    """The grid of an upright frame of the drone's sensor, all of its width, one pixel at a time."""
    grid = np.zeros((9, 16))
    fx, fy = 90 / math.tan(math.radians(43)), 120 / math.tan(math.radians(53))
    row_edges = [int(k * (bottom - top) / 9) for k in range(10)]
    column_edges = [int(k * 180 / 16) for k in range(17)]
    for v in range(top, bottom):
        for u in range(180):
            z = depth[v, u] if math.isfinite(depth[v, u]) and depth[v, u] > 1e-3 else 5.0
            distance = z * math.hypot(1.0, (u - 90) / fx, (v - 120) / fy)
            i = max(k for k in range(9) if row_edges[k] <= v - top)
            j = max(k for k in range(16) if column_edges[k] <= u)
            grid[8 - i, j] = max(grid[8 - i, j], 1.0 - min(distance, 5.0) / 5.0)
    return grid


def test_grid_is_that_of_a_loop_over_pixels():
    """Crop, range, nearest of each cell, encoding and flip agree with the same done one pixel at a
    time; the drone's crop leaves the upper 140 rows."""
    generator = np.random.default_rng(5)
    depth = generator.uniform(0.3, 8.0, (240, 180))
    depth[generator.uniform(size=depth.shape) < 0.1] = np.nan
    depth[generator.uniform(size=depth.shape) < 0.05] = 0.0
    grid = time_of_flight_grid(depth, TimeOfFlight())
    np.testing.assert_allclose(grid, pixel_by_pixel(depth, 0, 140), atol=1e-12)
    assert grid.shape == (9, 16)


def test_wall_ahead_is_farther_at_the_edges():
    """Of a wall square ahead the encoded range is the distance along each ray, not along the
    axis."""
    grid = time_of_flight_grid(frame(2.0), WHOLE)
    assert grid[4, 8] == pytest.approx(1 - 2.0 / 5.0, abs=1e-3)
    # The pixel of the lower left cell that is nearest to the axis: row 213, column 10.
    x, y = 80 / 90 * math.tan(math.radians(43)), 93 / 120 * math.tan(math.radians(53))
    assert grid[0, 0] == pytest.approx(1 - 2.0 * math.hypot(1.0, x, y) / 5.0, abs=1e-9)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, 1e-3, 5.0, 100.0])
def test_nothing_measured_is_nothing_near(value):
    """Pixels that were not measured, and those beyond the range, are 0."""
    assert (time_of_flight_grid(frame(value), TimeOfFlight()) == 0.0).all()


def test_one_near_pixel_fills_its_cell():
    """What is thinner than a cell is seen, in that cell alone; the frame's upper left is the grid's
    lower left."""
    depth = frame()
    depth[3, 5] = 1.0
    grid = time_of_flight_grid(depth, WHOLE)
    assert grid[8, 0] > 0.4
    assert np.count_nonzero(grid) == 1


def test_frames_on_their_side_are_stood_upright():
    """A frame that is wider than high is turned counterclockwise: its upper right corner becomes
    the upper left one."""
    depth = np.full((180, 240), 10.0)
    depth[5, 236] = 1.0
    grid = time_of_flight_grid(depth, WHOLE)
    assert np.flatnonzero(grid).tolist() == [8 * 16]


@pytest.mark.parametrize(
    ("anchor", "shift", "rows"),
    [
        ("center", 0, (35, 205)),
        ("top", 0, (0, 169)),
        ("bottom", 0, (71, 240)),
        ("bottom", -100, (0, 140)),
        ("top", 50, (50, 219)),
    ],
)
def test_crop_keeps_86_degrees(anchor, shift, rows):
    """Of 106 degrees in 240 rows, 86 are 2 * 120 tan(43) / tan(53) = 168.7 rows, placed by anchor
    and shift and cut at the frame's edge."""
    sensor = TimeOfFlight(anchor=anchor, shift=shift)
    height, width = sensor.crop(240, 180, 86.0, 106.0)
    assert (height.start, height.stop) == rows
    assert (width.start, width.stop) == (0, 180)


def test_system_gives_the_same_grid():
    """The system's output is the function's grid, row by row."""
    system = TimeOfFlightGrid()
    context = system.CreateDefaultContext()
    image = ImageDepth32F(180, 240)
    image.mutable_data[..., 0] = np.random.default_rng(1).uniform(0.3, 8.0, (240, 180))
    system.depth_image_32f_input_port().FixValue(context, Value(image))
    grid = time_of_flight_grid(image.data[..., 0], TimeOfFlight())
    np.testing.assert_array_equal(system.depth_grid_output_port().Eval(context), grid.ravel())


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("fov", 180.0),
        ("fov_x", np.nan),
        ("anchor", "left"),
        ("max_range", 0.0),
        ("rows", 0),
        ("rows", 200),
        ("columns", 181),
    ],
)
def test_bad_config_is_named(field, value):
    """A value out of range names the field."""
    with pytest.raises(ValueError, match=rf"TimeOfFlight.{field} must"):
        TimeOfFlightGrid(TimeOfFlight(**{field: value}))


def test_frames_of_another_size_are_refused():
    """A frame of another size says which it must have."""
    with pytest.raises(ValueError, match="100x80 pixels; it must have 180x240"):
        time_of_flight_grid(np.ones((80, 100)), TimeOfFlight())
