"""The room of `room.py`, for tests."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from room import room_color, write_room_capture


@pytest.fixture
def write_room() -> Callable[..., Path]:
    """Writes the room as a capture, see `write_room_capture`."""
    return write_room_capture


@pytest.fixture
def color_of_room() -> Callable[[np.ndarray], np.ndarray]:
    """Color of points in north-east-down coordinates, see `room_color`."""
    return room_color


@pytest.fixture
def room_in_W() -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the room in our world: north, west, up."""
    return np.array([0.0, -1.5, 0.0]), np.array([6.0, 1.5, 2.5])
