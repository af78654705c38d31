"""Converts raw frames of a time-of-flight sensor to the grid that policies observe.

The steps are those of the streamer on a Starling 2 Max.
"""

import math
import struct
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.common.validation import Config, bounded, require, require_field
from splatpilot.systems.sensing.onboard_camera import OnboardCamera, focal_length

UNMEASURED_DEPTH = 1e-3  # [m], up to which depth counts as unmeasured.


@dataclass
class TimeOfFlight(Config):
    """The sensor, and the part of its frame that the policy sees; by default the drone's."""

    # [px] Width of its frames; one that lies on its side is rotated upright.
    width: int = bounded(180, "[1, inf) px")
    # [px] Height of its frames.
    height: int = bounded(240, "[1, inf) px")
    # [deg] Horizontal field of view.
    fov_x: float = bounded(86.0, "[1, 180) deg")
    # [deg] Vertical field of view.
    fov_y: float = bounded(106.0, "[1, 180) deg")
    # [deg] Field of view after the crop, in both directions.
    fov: float = bounded(86.0, "[1, 180) deg")
    # Part of the height that the crop keeps.
    anchor: str = bounded("bottom", "{top, center, bottom}")
    # [px] By which that part then moves down; what leaves the frame is lost.
    shift: int = -100
    # [m] Range from which proximity is 0.
    max_range: float = bounded(5.0, "(0, inf) m")
    # [-] Cells across.
    columns: int = bounded(16, "[1, inf)")
    # [-] Cells down.
    rows: int = bounded(9, "[1, inf)")

    def check(self) -> None:
        crop = self.crop(self.height, self.width, self.fov_x, self.fov_y)
        for name, part in zip(("rows", "columns"), crop, strict=True):
            left = part.stop - part.start
            valid = getattr(self, name) <= left
            require_field(self, name, valid, f"at most {left}, the pixels after the crop")

    def crop(self, height: int, width: int, fov_x: float, fov_y: float) -> tuple[slice, slice]:
        """Returns the rows and columns kept of an upright frame with these fields of view."""
        slope = math.tan(math.radians(0.5 * self.fov))
        half_x, half_y = focal_length(width, fov_x) * slope, focal_length(height, fov_y) * slope
        left, right = math.floor(0.5 * width - half_x), math.ceil(0.5 * width + half_x)
        tall = min(math.ceil(2.0 * half_y), height)
        top, bottom = {
            "top": (0, tall),
            "center": (math.floor(0.5 * height - half_y), math.ceil(0.5 * height + half_y)),
            "bottom": (height - tall, height),
        }[self.anchor]
        top, bottom = max(0, top), min(height, bottom)
        top = max(0, min(height - 1, top + self.shift))
        bottom = max(top + 1, min(height, bottom + self.shift))
        return slice(top, bottom), slice(max(0, left), min(width, right))


def equivalent_sensor(camera: OnboardCamera) -> TimeOfFlight:
    """Returns the sensor that equals a policy's camera, without a crop.

    Its lens must not distort: frames of such sensors come rectified.
    """
    require_field(camera, "distortion", camera.distortion is None, "left out")
    fov_y = math.degrees(2.0 * math.atan(0.5 * camera.height / camera.focal_y))
    return TimeOfFlight(
        width=camera.width,
        height=camera.height,
        fov_x=camera.fov_x,
        fov_y=fov_y,
        fov=max(camera.fov_x, fov_y),
        anchor="center",
        shift=0,
    )


def time_of_flight_grid(depth: np.ndarray, sensor: TimeOfFlight) -> np.ndarray:
    """Computes the proximities (rows, columns) of a frame: 1 - range / max_range, at least 0; row 0
    is the lowest.

    Args:
        depth: (H, W) [m] along the optical axis; not finite, or at most 1 mm, if unmeasured. A
            frame that lies on its side is rotated by 90 degrees, counterclockwise.
    """
    H, W = sensor.height, sensor.width
    found = f"{depth.shape[1]}x{depth.shape[0]}"
    condition = f"{W}x{H} pixels, or on its side"
    require(depth.shape in ((H, W), (W, H)), "frame", condition, found)
    lying = depth.shape != (H, W)
    upright = np.rot90(depth) if lying else depth
    # The streamer does not swap the fields of view of a frame that lies on its side.
    fov_x, fov_y = (sensor.fov_y, sensor.fov_x) if lying else (sensor.fov_x, sensor.fov_y)
    rows, columns = sensor.crop(H, W, fov_x, fov_y)
    cropped = upright[rows, columns]
    measured = np.isfinite(cropped) & (cropped > UNMEASURED_DEPTH)
    cropped = np.where(measured, cropped, sensor.max_range)
    ranges = cropped * range_of_depth(H, W, fov_x, fov_y)[rows, columns]
    for axis, count in ((0, sensor.rows), (1, sensor.columns)):
        edges = np.linspace(0, ranges.shape[axis], count + 1).astype(int)
        ranges = np.minimum.reduceat(ranges, edges[:-1], axis=axis)
    return (1.0 - np.clip(ranges, 0.0, sensor.max_range) / sensor.max_range)[::-1]


def range_of_depth(height: int, width: int, fov_x: float, fov_y: float) -> np.ndarray:
    """Returns the range of pixels over their depth along the optical axis, (height, width)."""
    x = (np.arange(width) - 0.5 * width) / focal_length(width, fov_x)
    y = (np.arange(height) - 0.5 * height) / focal_length(height, fov_y)
    return np.sqrt(1.0 + x**2 + y[:, None] ** 2)


class TimeOfFlightGrid(LeafSystem):
    """Converts frames ``depth_image_32f`` to proximities ``depth_grid`` (rows * columns), row by
    row from the lowest, see `time_of_flight_grid`."""

    def __init__(self, sensor: TimeOfFlight | None = None):
        super().__init__()
        self._sensor = sensor = sensor or TimeOfFlight()
        sensor.validate()
        image = Value(ImageDepth32F(sensor.width, sensor.height))
        ticket = self.DeclareAbstractInputPort("depth_image_32f", image).ticket()
        size = sensor.rows * sensor.columns
        self.DeclareVectorOutputPort("depth_grid", size, self._calc, {ticket})

    def _calc(self, context: Context, output: BasicVector) -> None:
        image = cast(ImageDepth32F, self.get_input_port().Eval(context))
        grid = time_of_flight_grid(np.asarray(image.data)[..., 0], self._sensor)
        output.SetFromVector(grid.ravel())


# The packets of a Starling's time-of-flight streamer: a grid (TOF2) each, or chunks of a raw frame
# (TOF3) in any order.

GRID_MAGIC, FRAME_MAGIC = 0x544F4632, 0x544F4633
_GRID_HEADER = struct.Struct("<IIQ")  # magic, sequence, time [ns]
# Magic, sequence, number of the frame, of the chunk, of chunks, time [ns], width, height.
_FRAME_HEADER = struct.Struct("<IIIHHQHH")


@dataclass(frozen=True, eq=False)
class Stream:
    """State of a stream, immutable."""

    grid: np.ndarray | None = None  # (rows, columns), the newest.
    time_ns: int = -1  # of the grid, by the sensor's clock.
    seq: int = -1
    gaps: int = 0  # Number of packets that were missed.
    # Incomplete raw frame: number, chunks, time, width, height; and its received chunks.
    frame: tuple[int, ...] = ()
    chunks: dict[int, bytes] = field(default_factory=dict)


def after_packet(stream: Stream, packet: bytes, sensor: TimeOfFlight) -> Stream:
    """Returns the stream of a sensor after another packet; raises ValueError for one of another
    kind or length, with invalid values, or not newer than the last."""
    require(len(packet) >= 4, "packet", "at least 4 bytes", len(packet))
    (magic,) = struct.unpack_from("<I", packet)
    kinds = {GRID_MAGIC: _after_grid, FRAME_MAGIC: _after_chunk}
    condition = f"{GRID_MAGIC:#010x} or {FRAME_MAGIC:#010x}"
    require(magic in kinds, "magic number of the packet", condition, f"{magic:#010x}")
    return kinds[magic](stream, packet, sensor)


def _after_grid(stream: Stream, packet: bytes, sensor: TimeOfFlight) -> Stream:
    length = _GRID_HEADER.size + 4 * sensor.rows * sensor.columns
    require(len(packet) == length, "packet of a grid", f"{length} bytes", len(packet))
    _, seq, time_ns = _GRID_HEADER.unpack_from(packet)
    values = np.frombuffer(packet, "<f4", offset=_GRID_HEADER.size).astype(float)
    valid = (values >= 0.0) & (values <= 1.0)
    require(valid.all(), "proximities", "in [0, 1]", values[~valid][:1])
    return _after_image(stream, values.reshape(sensor.rows, sensor.columns), seq, time_ns)


def _after_chunk(stream: Stream, packet: bytes, sensor: TimeOfFlight) -> Stream:
    header = _FRAME_HEADER.size
    require(len(packet) > header, "packet of a chunk", f"over {header} bytes", len(packet))
    _, seq, number, index, count, time_ns, width, height = _FRAME_HEADER.unpack_from(packet)
    require(index < count, "chunk", f"below {count}", index)
    same = sorted((width, height)) == sorted((sensor.width, sensor.height))
    size = f"{sensor.width}x{sensor.height} pixels"
    require(same, "frame", size, f"{width}x{height}")
    require(time_ns > stream.time_ns, "time of the frame", f"after {stream.time_ns} ns", time_ns)
    frame = (number, count, time_ns, width, height)
    chunks = {index: packet[header:]} | (stream.chunks if frame == stream.frame else {})
    received, length = sum(map(len, chunks.values())), 4 * width * height
    require(received <= length, "chunks of a frame", f"at most {length} bytes", received)
    if len(chunks) < count:
        return replace(stream, frame=frame, chunks=chunks)
    require(received == length, "frame", f"{length} bytes", received)
    data = b"".join(chunks[i] for i in range(count))
    depth = np.frombuffer(data, "<f4").reshape(height, width).astype(float)
    grid = time_of_flight_grid(depth, sensor)
    return _after_image(replace(stream, frame=(), chunks={}), grid, seq, time_ns)


def _after_image(stream: Stream, grid: np.ndarray, seq: int, time_ns: int) -> Stream:
    require(time_ns > stream.time_ns, "time of the grid", f"after {stream.time_ns} ns", time_ns)
    missed = max(seq - stream.seq - 1, 0) if stream.seq >= 0 else 0
    return replace(stream, grid=grid, seq=seq, time_ns=time_ns, gaps=stream.gaps + missed)
