"""Packets of a time-of-flight stream, written here byte by byte."""

import struct

import numpy as np
import pytest

from splatpilot.systems.sensing.time_of_flight import (
    Stream,
    TimeOfFlight,
    after_packet,
    time_of_flight_grid,
)

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
    """A grid is the 144 numbers of its packet, 592 bytes; numbers that were left out are gaps."""
    values = np.random.default_rng(0).uniform(size=(9, 16)).astype(np.float32)
    first, later = grid_packet(values, 7, 100), grid_packet(values[::-1], 10, 200)
    assert len(first) == 592
    np.testing.assert_array_equal(after(first).grid, values)
    stream = after(first, later)
    np.testing.assert_array_equal(stream.grid, values[::-1])
    assert (stream.gaps, stream.time_ns) == (2, 200)


@pytest.mark.parametrize("largest", [60000, 64000, 1000, 172800])
def test_raw_frames_become_the_grids_of_their_depth(largest):
    """From its chunks, in whatever order, a frame becomes the grid that the pure function makes;
    until the last of them has come there is none."""
    depth = np.random.default_rng(1).uniform(0.2, 7.0, (240, 180)).astype(np.float32)
    packets = frame_packets(depth, 4, 100, largest)
    np.random.default_rng(2).shuffle(packets)
    assert len(packets) == 1 or after(*packets[:-1]).grid is None
    grid = after(*packets).grid
    assert grid is not None
    np.testing.assert_array_equal(grid, time_of_flight_grid(depth.astype(float), SENSOR))


def test_a_frame_that_lost_a_chunk_gives_way_to_the_next():
    """Chunks of two frames are not mixed; a chunk that comes twice does no harm."""
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
        (b"", "has 0 bytes"),
        (b"TOF", "has 3 bytes"),
        (b"LC02" + GOOD[4:], "begins with 0x3230434c"),
        (GOOD[:-1], "has 591 bytes; it must have 592"),
        (GOOD + b"1", "has 593 bytes"),
        (GOOD, "no newer"),
        (grid_packet(np.full((9, 16), np.nan), 2, 200), "no proximities"),
        (grid_packet(np.full((9, 16), 1.1), 2, 200), "no proximities"),
        (CHUNK[:28], "has 28 bytes; it must have more than 28"),
        (CHUNK[:12] + b"\x05\x00" + CHUNK[14:], "chunk 5 of 1"),
        (CHUNK[:-4], "has 172796 bytes; it must have 172800"),
        (CHUNK + b"1234", "more than its 180x240 pixels"),
        (frame_packets(np.ones((80, 100)), 1, 200, 60000)[0], "100x80 pixels; it must have"),
        (frame_packets(np.ones((240, 180)), 1, 100, 172800)[0], "no newer"),
    ],
)
def test_what_is_no_packet_is_refused(packet, why):
    """Packets of another length, kind, size or time are refused with the reason."""
    with pytest.raises(ValueError, match=why):
        after_packet(after(GOOD), packet, SENSOR)


def test_no_bytes_do_worse_than_be_refused():
    """Of random bytes, with headers that are right and payloads that are not, each is used or
    refused, and no more is kept than a frame."""
    random = np.random.default_rng(3)
    stream = Stream()
    for header in (GOOD[:4], GOOD[:16], CHUNK[:4], CHUNK[:24], CHUNK[:32]):
        for length in random.integers(0, 700, 100):
            try:
                stream = after_packet(stream, header + random.bytes(length), SENSOR)
            except ValueError:
                continue
            assert sum(map(len, stream.chunks.values())) <= 4 * 240 * 180
