"""From the raw frame of a time-of-flight sensor to the grid that policies see.

The order of the steps is that of the streamer which feeds such a policy on a Starling 2 Max: turn
the frame upright, crop it to the policy's field of view, take what was not measured for far, turn
depth into range, take the nearest of each cell, encode it, and turn the grid upside down.
"""

import math
import struct
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.common.drake import input_port, output_port
from splatpilot.systems.common.validation import require_field
from splatpilot.systems.sensing.onboard_camera import OnboardCamera, focal_length

LEAST_DEPTH = 1e-3
"""[m], up to which the sensor has measured nothing."""


@dataclass
class TimeOfFlight:
    """The sensor, and what part of its frame the policy sees; defaults are those of the drone."""

    # [px] Width of its frames; one that lies on its side is stood up.
    width: int = 180
    # [px] Height of its frames.
    height: int = 240
    # [deg] Horizontal field of view.
    fov_x: float = 86.0
    # [deg] Vertical field of view.
    fov_y: float = 106.0
    # [deg] Field of view, both ways, that is left by the crop.
    fov: float = 86.0
    # Which part of the height is left: "top", "center" or "bottom".
    anchor: str = "bottom"
    # [px] By how much that part then moves down; what leaves the frame is lost.
    shift: int = -100
    # [m] From which on nothing is near.
    max_range: float = 5.0
    # [-] Cells across.
    columns: int = 16
    # [-] Cells down.
    rows: int = 9

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("fov_x", "fov_y", "fov"):
            value = getattr(self, name)
            require_field(self, name, 1.0 <= value < 180.0, "at least 1 and below 180 deg")
        require_field(self, "anchor", self.anchor in _ANCHORS, f"one of {', '.join(_ANCHORS)}")
        require_field(self, "max_range", 0.0 < self.max_range < math.inf, "positive and finite")
        for name in ("width", "height", "columns", "rows"):
            value = getattr(self, name)
            require_field(self, name, value >= 1, "at least 1")
        crop = self.crop(self.height, self.width, self.fov_x, self.fov_y)
        for count, part, name in zip(
            (self.rows, self.columns), crop, ("rows", "columns"), strict=True
        ):
            left = part.stop - part.start
            require_field(
                self, name, count <= left, f"at most {left}, the pixels that the crop leaves"
            )

    def crop(self, height: int, width: int, fov_x: float, fov_y: float) -> tuple[slice, slice]:
        """The rows and columns that are left of an upright frame with these fields of view."""
        half_x, half_y = (
            focal_length(size, fov) * math.tan(math.radians(0.5 * self.fov))
            for size, fov in ((width, fov_x), (height, fov_y))
        )
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


def sensor_of(camera: OnboardCamera) -> TimeOfFlight:
    """The sensor that a policy's camera is: all of its image is left.

    Raises:
        ValueError: for a camera whose lens distorts; frames of such sensors come rectified.
    """
    if camera.distortion is not None:
        raise ValueError(
            f"OnboardCamera.distortion is {camera.distortion}; a time-of-flight sensor has none: "
            "leave it out"
        )
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


_ANCHORS = ("top", "center", "bottom")


def time_of_flight_grid(depth: np.ndarray, sensor: TimeOfFlight) -> np.ndarray:
    """
    The proximities (rows, columns) in a frame: 1 - range / max_range, 1 touched, 0 nothing near.

    Row 0 is the lowest: the grid is upside down.

    Args:
        depth: (H, W) [m] along the optical axis; what is not finite, or at most 1 mm, was not
            measured. A frame that lies on its side is turned by 90 degrees, counterclockwise.
        sensor: a valid configuration.

    Raises:
        ValueError: for a frame of another size.
    """
    H, W = sensor.height, sensor.width
    if depth.shape not in ((H, W), (W, H)):
        raise ValueError(
            f"the frame has {depth.shape[1]}x{depth.shape[0]} pixels; it must have {W}x{H}, or lie "
            "on its side"
        )
    lying = depth.shape != (H, W)
    upright = np.rot90(depth) if lying else depth
    # The streamer takes the fields of view of a frame that lay with it as they were.
    fov_x, fov_y = (sensor.fov_y, sensor.fov_x) if lying else (sensor.fov_x, sensor.fov_y)
    rows, columns = sensor.crop(H, W, fov_x, fov_y)
    cropped = upright[rows, columns]
    measured = np.isfinite(cropped) & (cropped > LEAST_DEPTH)
    cropped = np.where(measured, cropped, sensor.max_range)
    ranges = cropped * range_of_depth(H, W, fov_x, fov_y)[rows, columns]
    for axis, count in ((0, sensor.rows), (1, sensor.columns)):
        edges = np.linspace(0, ranges.shape[axis], count + 1).astype(int)
        ranges = np.minimum.reduceat(ranges, edges[:-1], axis=axis)
    return (1.0 - np.clip(ranges, 0.0, sensor.max_range) / sensor.max_range)[::-1]


def range_of_depth(height: int, width: int, fov_x: float, fov_y: float) -> np.ndarray:
    """(height, width) [-] How far what pixels see is, by its depth along the optical axis."""
    x = (np.arange(width) - 0.5 * width) / focal_length(width, fov_x)
    y = (np.arange(height) - 0.5 * height) / focal_length(height, fov_y)
    return np.sqrt(1.0 + x**2 + y[:, None] ** 2)


class TimeOfFlightGrid(LeafSystem):
    """Turns raw frames into grids of proximities, see `time_of_flight_grid`.

    .. pydrake_system::

        name: TimeOfFlightGrid
        input_ports:
        - depth_image_32f
        output_ports:
        - depth_grid

    - ``depth_image_32f``: planar depth [m], of the sensor's size.
    - ``depth_grid`` (rows * columns): 1 - range / max_range, row by row from the lowest.

    Stateless.

    Raises:
        ValueError: from the constructor on a configuration out of range.
    """

    depth_image_32f_input_port = input_port("depth_image_32f")
    depth_grid_output_port = output_port("depth_grid")

    def __init__(self, sensor: TimeOfFlight | None = None):
        super().__init__()
        self._sensor = sensor = sensor or TimeOfFlight()
        sensor.validate()
        image = self.DeclareAbstractInputPort(
            "depth_image_32f", Value(ImageDepth32F(sensor.width, sensor.height))
        )
        size = sensor.rows * sensor.columns
        self.DeclareVectorOutputPort("depth_grid", size, self._calc, {image.ticket()})

    def _calc(self, context: Context, output: BasicVector) -> None:
        image = cast(ImageDepth32F, self.get_input_port().Eval(context))
        grid = time_of_flight_grid(np.asarray(image.data)[..., 0], self._sensor)
        output.SetFromVector(grid.ravel())


# The packets of a Starling's time-of-flight streamer: grids, and raw frames in chunks.
#
# A grid (TOF2) is a packet of its own. A raw frame (TOF3) comes in chunks, in any order.


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
