import tracemalloc

import numpy as np

from splatpilot.diagrams.flight.fly import recorded_frames
from splatpilot.diagrams.flight.scenario import Scenario


class Recorder:
    """Yields 60 pairs of gray images, of 0.9 MB each."""

    def frames(self, max_depth):
        for shade in range(60):
            yield tuple(np.full((480, 640, 3), shade, np.uint8) for _ in range(2))


def test_images_of_a_flight_are_not_in_memory_at_once():
    tracemalloc.start()
    frames = recorded_frames(Recorder(), Scenario())  # pyright: ignore
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(frames.color) == len(frames.depth) == 60 and peak < 20e6
