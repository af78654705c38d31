import math
import struct

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.sensing.time_of_flight import (
    Stream,
    TimeOfFlight,
    TimeOfFlightGrid,
    after_packet,
    time_of_flight_grid,
)
from tests.systems.vehicle.responses import evaluate


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
    generator = np.random.default_rng(5)
    depth = generator.uniform(0.3, 8.0, (240, 180))
    depth[generator.uniform(size=depth.shape) < 0.1] = np.nan
    depth[generator.uniform(size=depth.shape) < 0.05] = 0.0
    grid = time_of_flight_grid(depth, TimeOfFlight())
    np.testing.assert_allclose(grid, pixel_by_pixel(depth, 0, 140), atol=1e-12)
    image = ImageDepth32F(180, 240)
    image.mutable_data[..., 0] = depth
    found = evaluate(TimeOfFlightGrid(), depth_image_32f=Value(image))
    np.testing.assert_allclose(found, grid.ravel(), atol=1e-6)


def test_unmeasured_depth_is_far_and_frames_on_their_side_are_rotated_upright():
    for value in (np.nan, np.inf, -np.inf, 0.0, 1e-3, 5.0, 100.0):
        assert (time_of_flight_grid(np.full((240, 180), value), TimeOfFlight()) == 0.0).all()
    depth = np.full((180, 240), 10.0)
    depth[5, 236] = 1.0
    whole = TimeOfFlight(fov=110.0, anchor="center", shift=0)  # Nothing is cropped.
    assert np.flatnonzero(time_of_flight_grid(depth, whole)).tolist() == [8 * 16]


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
    sensor = TimeOfFlight(anchor=anchor, shift=shift)
    height, width = sensor.crop(240, 180, 86.0, 106.0)
    assert (height.start, height.stop) == rows
    assert (width.start, width.stop) == (0, 180)


SENSOR = TimeOfFlight()


def grid_packet(values: np.ndarray, seq: int, time_ns: int) -> bytes:
    return struct.pack("<IIQ144f", 0x544F4632, seq, time_ns, *values.ravel())


def frame_packets(depth: np.ndarray, number: int, time_ns: int, largest: int) -> list[bytes]:
    data, (height, width) = depth.astype("<f4").tobytes(), depth.shape
    count = -(-len(data) // largest)
    return [
        struct.pack("<IIIHHQHH", 0x544F4633, number, number, i, count, time_ns, width, height)
        + data[i * largest : (i + 1) * largest]
        for i in range(count)
    ]


def after(*packets: bytes) -> Stream:
    stream = Stream()
    for packet in packets:
        stream = after_packet(stream, packet, SENSOR)
    return stream


def test_grids_come_as_they_were_sent():
    values = np.random.default_rng(0).uniform(size=(9, 16)).astype(np.float32)
    first, later = grid_packet(values, 7, 100), grid_packet(values[::-1], 10, 200)
    assert len(first) == 592
    np.testing.assert_array_equal(after(first).grid, values)
    stream = after(first, later)
    np.testing.assert_array_equal(stream.grid, values[::-1])
    assert (stream.gaps, stream.time_ns) == (2, 200)


@pytest.mark.parametrize("largest", [64000, 1000, 172800])
def test_raw_frames_become_the_grids_of_their_depth(largest):
    depth = np.random.default_rng(1).uniform(0.2, 7.0, (240, 180)).astype(np.float32)
    packets = frame_packets(depth, 4, 100, largest)
    np.random.default_rng(2).shuffle(packets)
    assert len(packets) == 1 or after(*packets[:-1]).grid is None
    grid = after(*packets).grid
    assert grid is not None
    np.testing.assert_array_equal(grid, time_of_flight_grid(depth.astype(float), SENSOR))


def test_a_frame_that_lost_a_chunk_gives_way_to_the_next():
    near, far = np.full((240, 180), 1.0), np.full((240, 180), 4.0)
    lost = frame_packets(near, 4, 100, 60000)[:2]
    whole = frame_packets(far, 5, 200, 60000)
    stream = after(*lost, whole[0], *whole)
    assert stream.grid is not None
    np.testing.assert_array_equal(stream.grid, time_of_flight_grid(far, SENSOR))


GOOD = grid_packet(np.full((9, 16), 0.5), 1, 100)
CHUNK = frame_packets(np.ones((240, 180)), 1, 200, 172800)[0]


@pytest.mark.parametrize(
    ("packet", "why"),
    [
        (b"", "got 0"),
        (b"TOF", "got 3"),
        (b"LC02" + GOOD[4:], "got 0x3230434c"),
        (GOOD[:-1], "592 bytes, got 591"),
        (GOOD + b"1", "got 593"),
        (GOOD, "after 100 ns, got 100"),
        (grid_packet(np.full((9, 16), np.nan), 2, 200), "proximities must be in"),
        (grid_packet(np.full((9, 16), 1.1), 2, 200), "proximities must be in"),
        (CHUNK[:28], "over 28 bytes, got 28"),
        (CHUNK[:12] + b"\x05\x00" + CHUNK[14:], "chunk must be below 1, got 5"),
        (CHUNK[:-4], "172800 bytes, got 172796"),
        (CHUNK + b"1234", "at most 172800 bytes, got 172804"),
        (frame_packets(np.ones((80, 100)), 1, 200, 60000)[0], "180x240 pixels, got 100x80"),
        (frame_packets(np.ones((240, 180)), 1, 100, 172800)[0], "after 100 ns, got 100"),
    ],
)
def test_invalid_packets_are_refused(packet, why):
    with pytest.raises(ValueError, match=why):
        after_packet(after(GOOD), packet, SENSOR)
