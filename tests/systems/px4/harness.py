"""A system whose inputs a test gives, and what PX4 and OptiTrack send to it."""

import struct

import numpy as np
from pydrake.systems.analysis import Simulator
from pymavlink.dialects.v20 import common as dialect


class Harness:
    """A system by itself; `inputs` are numbers or vectors."""

    def __init__(self, system, **inputs):
        self.system, self.simulator = system, Simulator(system)
        self.context = self.simulator.get_mutable_context()
        self.give(**inputs)
        self.simulator.Initialize()

    @property
    def now(self) -> float:
        return self.context.get_time()

    def give(self, **inputs) -> None:
        for name, value in inputs.items():
            self.system.GetInputPort(name).FixValue(self.context, np.atleast_1d(value))

    def out(self, name: str):
        """Returns a vector, or a number."""
        value = self.system.GetOutputPort(name).Eval(self.context).copy()
        return value if len(value) > 1 else value[0]


class Packets:
    """An inbox of packets that tests write and read."""

    port = 0

    def __init__(self):
        self.sent, self.waiting, self.strangers = b"", [], 0

    def send(self, packet: bytes, address: tuple[str, int]) -> None:
        self.sent += packet

    def receive(self) -> tuple[list[bytes], int]:
        received = self.waiting, self.strangers
        self.waiting, self.strangers = [], 0
        return received

    def take_sent(self) -> list:
        """Returns the MAVLink messages that were sent since the last call."""
        sent, self.sent = self.sent, b""
        return dialect.MAVLink(None).parse_buffer(sent) or []


def natnet_frame(number: int, body: int, position, q_xyzw, tracked: bool = True) -> bytes:
    """A frame of NatNet 4.0: no markers, one rigid body, nothing else; y is up."""
    data = struct.pack("<III", number, 0, 0)  # number, marker sets, other markers
    data += struct.pack("<Ii7ff", 1, body, *position, *q_xyzw, 0.001) + struct.pack("<H", tracked)
    data += struct.pack("<IIII", 0, 0, 0, 0)  # skeletons, markers, force plates, devices
    data += struct.pack("<IIdQQQH", 0, 0, 1.25, 0, 0, 0, 0)
    data += struct.pack("<I", 0)
    return struct.pack("<HH", 7, len(data)) + data
