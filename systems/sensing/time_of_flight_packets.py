"""The packets of a Starling's time-of-flight streamer: grids, and raw frames in chunks.

A grid (TOF2) is a packet of its own. A raw frame (TOF3) comes in chunks, in any order.
"""

import struct
from dataclasses import dataclass, field, replace

import numpy as np

from splatpilot.systems.sensing.time_of_flight import TimeOfFlight, time_of_flight_grid

GRID_MAGIC, FRAME_MAGIC = 0x544F4632, 0x544F4633
_GRID_HEADER = struct.Struct("<IIQ")  # magic, sequence, time [ns]
_FRAME_HEADER = struct.Struct("<IIIHHQHH")
"""Magic, sequence, number of the frame, of the chunk, of chunks, time [ns], width, height."""

_LARGEST_FRAME = 4096 * 4096


@dataclass(frozen=True, eq=False)
class Stream:
    """What has come of a stream. Nothing in it changes: Contexts may share it."""

    grid: np.ndarray | None = None
    """(rows, columns), the newest."""
    time_ns: int = -1
    """By the sensor's clock, of that."""
    seq: int = -1
    gaps: int = 0
    """Packets' numbers that were left out."""
    frame: tuple[int, ...] = ()
    """Of the raw frame that is coming: number, chunks, time, width, height."""
    chunks: dict[int, bytes] = field(default_factory=dict)
    """Those of it that have come."""

    def restarted(self) -> "Stream":
        """The same as if another stream began: its clock and numbers are not compared."""
        return replace(self, time_ns=-1, seq=-1)

    def __deepcopy__(self, memo: dict) -> "Stream":
        return self


def after_packet(stream: Stream, packet: bytes, sensor: TimeOfFlight) -> Stream:
    """
    The stream after another packet.

    Args:
        sensor: what raw frames are, and what grids are made of them.

    Raises:
        ValueError: for a packet that cannot be used, with the reason: of another kind or length,
            of what is no grid or chunk, no newer than what there is.
    """
    if len(packet) < 4:
        raise ValueError(f"the packet has {len(packet)} bytes; it must have 4 or more")
    (magic,) = struct.unpack_from("<I", packet)
    if magic == GRID_MAGIC:
        return _after_grid(stream, packet, sensor)
    if magic == FRAME_MAGIC:
        return _after_chunk(stream, packet, sensor)
    raise ValueError(
        f"the packet begins with {magic:#010x}; it must be {GRID_MAGIC:#010x} or "
        f"{FRAME_MAGIC:#010x}"
    )


def _after_grid(stream: Stream, packet: bytes, sensor: TimeOfFlight) -> Stream:
    count = sensor.rows * sensor.columns
    length = _GRID_HEADER.size + 4 * count
    if len(packet) != length:
        raise ValueError(f"the packet of a grid has {len(packet)} bytes; it must have {length}")
    _, seq, time_ns = _GRID_HEADER.unpack_from(packet)
    values = np.frombuffer(packet, "<f4", offset=_GRID_HEADER.size).astype(float)
    if not (np.isfinite(values).all() and values.min() >= 0.0 and values.max() <= 1.0):
        raise ValueError("the grid has values that are no proximities, 0 to 1")
    return _after_image(stream, values.reshape(sensor.rows, sensor.columns), seq, time_ns)


def _after_chunk(stream: Stream, packet: bytes, sensor: TimeOfFlight) -> Stream:
    if len(packet) <= _FRAME_HEADER.size:
        raise ValueError(
            f"the packet of a chunk has {len(packet)} bytes; it must have more than "
            f"{_FRAME_HEADER.size}"
        )
    _, seq, number, index, count, time_ns, width, height = _FRAME_HEADER.unpack_from(packet)
    payload = packet[_FRAME_HEADER.size :]
    if not (index < count and 0 < width * height <= _LARGEST_FRAME):
        raise ValueError(f"it is chunk {index} of {count} of a frame of {width}x{height} pixels")
    if sorted((width, height)) != sorted((sensor.width, sensor.height)):
        raise ValueError(
            f"the frame has {width}x{height} pixels; it must have {sensor.width}x{sensor.height}"
        )
    if time_ns <= stream.time_ns:
        raise ValueError("the frame is no newer than the one before")
    frame = (number, count, time_ns, width, height)
    chunks = {index: payload} | (stream.chunks if frame == stream.frame else {})
    if sum(map(len, chunks.values())) > 4 * width * height:
        raise ValueError(f"the chunks of frame {number} are more than its {width}x{height} pixels")
    if len(chunks) < count:
        return replace(stream, frame=frame, chunks=chunks)
    data = b"".join(chunks[i] for i in range(count))
    if len(data) != 4 * width * height:
        raise ValueError(
            f"the frame has {len(data)} bytes; it must have {4 * width * height} for "
            f"{width}x{height} pixels"
        )
    depth = np.frombuffer(data, "<f4").reshape(height, width).astype(float)
    grid = time_of_flight_grid(depth, sensor)
    return _after_image(replace(stream, frame=(), chunks={}), grid, seq, time_ns)


def _after_image(stream: Stream, grid: np.ndarray, seq: int, time_ns: int) -> Stream:
    if time_ns <= stream.time_ns:
        raise ValueError("the grid is no newer than the one before")
    missed = max(seq - stream.seq - 1, 0) if stream.seq >= 0 else 0
    return replace(stream, grid=grid, seq=seq, time_ns=time_ns, gaps=stream.gaps + missed)
