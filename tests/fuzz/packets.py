"""Damaged packets: what comes by LCM and by UDP, where nothing may be raised but refusals."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
from drake import lcmt_header
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from fuzz.readers import Reader
from splatpilot.systems.messaging.codecs import (
    Codec,
    ColorImageCodec,
    CommandCodec,
    DepthGridCodec,
    DepthImageCodec,
    HypothesesCodec,
    MotionCaptureCodec,
    StateCodec,
    VehicleStatusCodec,
    VelocitySetpointCodec,
)
from splatpilot.systems.messaging.lcm_ports import decode_message
from splatpilot.systems.policies.hypotheses import hypotheses_size
from splatpilot.systems.sensing.time_of_flight import (
    FRAME_MAGIC,
    Stream,
    TimeOfFlight,
    after_packet,
)

_SENSOR = TimeOfFlight()
_STATE = np.array([1.0, 2, 3, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0])


def _codecs() -> list[tuple[Codec, np.ndarray]]:
    plan = np.zeros(hypotheses_size(2))
    plan[4] = 1.0  # w of the pose's quaternion
    return [
        (StateCodec(), _STATE),
        (CommandCodec(), np.array([9.0, 0, 0, 0])),
        (VelocitySetpointCodec(), np.array([1.0, 0, 0, np.nan])),
        (VehicleStatusCodec(), np.array([1.0, 0.0])),
        (MotionCaptureCodec("drone"), _STATE[[0, 1, 2, 6, 7, 8, 9]]),
        (DepthGridCodec(4, 3, 5.0, "tof"), np.full(12, 0.5)),
        (HypothesesCodec(2), plan),
        (DepthImageCodec(ImageDepth32F(8, 6), "camera"), np.ones((6, 8, 1), np.float32)),
        (ColorImageCodec(ImageRgba8U(8, 6), "camera"), np.ones((6, 8, 4), np.uint8)),
    ]


def _message(codec: Codec, value: np.ndarray) -> bytes:
    header = lcmt_header()
    header.seq, header.utime, header.frame_name = 1, 1_800_000_000_000_000, codec.frame
    message = codec.pack(value, header, 0.0)
    if codec.image is None:
        message.session = 1  # The same packets in every run.
    return message.encode()


def _write_messages(folder: Path) -> None:
    for number, (codec, value) in enumerate(_codecs()):
        (folder / f"{number}").write_bytes(_message(codec, value))


def _read_messages(folder: Path) -> Any:
    values = []
    for number, (codec, _) in enumerate(_codecs()):
        packet = _packet(folder / f"{number}")
        try:
            values.append((codec, codec.unpack(decode_message(codec, packet), 0.0)))
        except struct.error as error:  # It refuses as ValueError does, see `Receiver._take`.
            raise ValueError(str(error)) from None
    return values


def _packet(file: Path) -> bytes:
    """What a packet holds; whatever no packet can be, as what lies under another name, is none."""
    return file.read_bytes()[:65536] if file.is_file() and not file.is_symlink() else b""


def _use_messages(values: Any) -> None:
    for codec, value in values:
        if codec.image is not None:
            assert value.shape == np.asarray(codec.image.data).shape, "sizes differ"
        else:
            assert value.shape == (codec.size,), "sizes differ"
            free = [3] if isinstance(codec, VelocitySetpointCodec) else []
            assert np.isfinite(np.delete(value, free)).all(), "values are not finite"


def _write_packets(folder: Path) -> None:
    count = _SENSOR.rows * _SENSOR.columns
    grid = struct.pack("<IIQ", 0x544F4632, 1, 10**9) + np.full(count, 0.5, "<f4").tobytes()
    (folder / "0").write_bytes(grid)
    data = np.full((_SENSOR.height, _SENSOR.width), 1.5, "<f4").tobytes()
    chunks = [data[start : start + 32768] for start in range(0, len(data), 32768)]
    size = _SENSOR.width, _SENSOR.height
    for index, chunk in enumerate(chunks):
        head = struct.pack(
            "<IIIHHQHH", FRAME_MAGIC, 2 + index, 7, index, len(chunks), 2 * 10**9, *size
        )
        (folder / f"{index + 1}").write_bytes(head + chunk)


def _read_packets(folder: Path) -> Any:
    stream, refused = Stream(), 0
    for file in sorted(folder.iterdir(), key=lambda file: (len(file.name), file.name)):
        try:
            stream = after_packet(stream, _packet(file), _SENSOR)
        except (ValueError, struct.error):
            refused += 1
    return stream


def _use_packets(stream: Any) -> None:
    if stream.grid is not None:
        assert stream.grid.shape == (_SENSOR.rows, _SENSOR.columns), "sizes differ"
        assert (stream.grid >= 0).all() and (stream.grid <= 1).all(), "a proximity is none"
    assert sum(map(len, stream.chunks.values())) <= 4 * _SENSOR.width * _SENSOR.height


def _nameless(message: str, folder: Path) -> bool:
    """Of what comes in packets there is no file that a message could name."""
    return True


PACKETS = {
    "LCM messages": Reader(_write_messages, "*", _read_messages, _use_messages, _nameless),
    "time-of-flight packets": Reader(_write_packets, "*", _read_packets, _use_packets, _nameless),
}
"""By name."""
