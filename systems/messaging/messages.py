"""LCM messages: classes of the types in `lcmtypes/`, compatible with those of lcm-gen."""

import math
import re
import struct
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from drake import lcmt_header

from splatpilot.systems.common.validation import require

_FORMATS = {"int8_t": "b", "int32_t": "i", "int64_t": "q", "float": "f", "double": "d"}
_FORMATS["boolean"] = "?"
_MEMBER = re.compile(r"^\s*(const )?([\w.]+) (\w+)((?:\[\w+\])*)(?: = (\d+))?;", re.MULTILINE)


class _Field(NamedTuple):
    kind: str  # type of LCM
    name: str
    sizes: tuple[str, ...]  # of an array: numbers, or names of fields that hold them


class _Message:
    """Base of the messages. Fields are 0, empty or lists of 0 before they are set."""

    _fields: ClassVar[list[_Field]]
    _fingerprint: ClassVar[bytes]

    def __init__(self) -> None:
        for kind, name, sizes in self._fields:
            value: Any = 0.0 if kind in ("float", "double") else False if kind == "boolean" else 0
            if sizes:
                value = np.zeros([int(n) if n.isdigit() else 0 for n in sizes]).tolist()
            elif kind not in _FORMATS:
                value = "" if kind == "string" else lcmt_header()
            setattr(self, name, value)

    def _shape(self, sizes: tuple[str, ...]) -> list[int]:
        shape = [int(n) if n.isdigit() else getattr(self, n) for n in sizes]
        require(min(shape) >= 0, "the sizes of arrays", "at least 0", shape)
        return shape

    def encode(self) -> bytes:
        """Returns the packet."""
        packet = BytesIO()
        packet.write(self._fingerprint)
        for kind, name, sizes in self._fields:
            value = getattr(self, name)
            if sizes:
                array = np.asarray(value, f">{_FORMATS[kind]}").reshape(self._shape(sizes))
                packet.write(array.tobytes())
            elif kind in _FORMATS:
                packet.write(struct.pack(f">{_FORMATS[kind]}", value))
            elif kind == "string":
                text = value.encode() + b"\0"
                packet.write(struct.pack(">I", len(text)) + text)
            else:
                value._encode_one(packet)
        return packet.getvalue()

    @classmethod
    def decode(cls, packet: BytesIO | bytes) -> Any:
        """Reads a message; raises ValueError or struct.error for bytes of no such message."""
        packet = BytesIO(packet) if isinstance(packet, bytes) else packet
        require(packet.read(8) == cls._fingerprint, "the packet", f"a {cls.__name__}", "another")
        message = cls()
        for kind, name, sizes in cls._fields:
            if sizes:
                shape, dtype = message._shape(sizes), np.dtype(f">{_FORMATS[kind]}")
                size = min(dtype.itemsize * math.prod(shape), packet.getbuffer().nbytes)
                value = tuple(np.frombuffer(packet.read(size), dtype).reshape(shape).tolist())
            elif kind in _FORMATS:
                form = struct.Struct(f">{_FORMATS[kind]}")
                [value] = form.unpack(packet.read(form.size))
            elif kind == "string":
                [size] = struct.unpack(">I", packet.read(4))
                value = packet.read(size)[:-1].decode("utf-8", "replace")
            else:
                value = lcmt_header._decode_one(packet)
            setattr(message, name, value)
        return message


def _hash(fields: list[_Field]) -> int:
    """Computes the fingerprint of a type, see `lcm_struct_hash` in lcmgen.c."""
    value = 0x12345678

    def update(*codes: int) -> None:
        nonlocal value
        for code in codes:
            value = ((value << 8) ^ (value >> 55)) + code & 0xFFFFFFFFFFFFFFFF
            value -= (value >> 63) << 64  # signed

    for kind, name, sizes in fields:
        update(len(name), *name.encode())
        if "." not in kind:
            update(len(kind), *kind.encode())
        update(len(sizes))
        for size in sizes:
            update(not size.isdigit(), len(size), *size.encode())
    value += sum(lcmt_header._get_hash_recursive([]) for kind, *_ in fields if "." in kind)
    value &= 0xFFFFFFFFFFFFFFFF
    return (value << 1 | value >> 63) & 0xFFFFFFFFFFFFFFFF


def _message(name: str) -> Any:
    """Makes the class of the messages that a file describes, with its constants."""
    text = (Path(__file__).parent / "lcmtypes" / f"{name}.lcm").read_text()
    members = _MEMBER.findall(text.partition("struct")[2])
    constants = {each: int(value) for const, _, each, _, value in members if const}
    fields = [
        _Field(kind, each, tuple(re.findall(r"\w+", sizes)))
        for const, kind, each, sizes, _ in members
        if not const
    ]
    fingerprint = struct.pack(">Q", _hash(fields))
    return type(name, (_Message,), constants | {"_fields": fields, "_fingerprint": fingerprint})


lcmt_body_rate_command = _message("lcmt_body_rate_command")
lcmt_bridge_status = _message("lcmt_bridge_status")
lcmt_depth_grid = _message("lcmt_depth_grid")
lcmt_motion_capture_pose = _message("lcmt_motion_capture_pose")
lcmt_quadrotor_state = _message("lcmt_quadrotor_state")
lcmt_trajectory_hypotheses = _message("lcmt_trajectory_hypotheses")
lcmt_vehicle_status = _message("lcmt_vehicle_status")
lcmt_velocity_setpoint = _message("lcmt_velocity_setpoint")
