"""OptiTrack's frames, written byte by byte."""

import struct


def natnet_frame(number: int, body: int, position, q_xyzw, tracked: bool = True) -> bytes:
    """A frame of NatNet 4.0: no markers, one rigid body, nothing else; y is up."""
    data = struct.pack("<III", number, 0, 0)  # number, marker sets, other markers
    data += struct.pack("<Ii7ff", 1, body, *position, *q_xyzw, 0.001) + struct.pack("<H", tracked)
    data += struct.pack("<IIII", 0, 0, 0, 0)  # skeletons, markers, force plates, devices
    data += struct.pack("<IIdQQQH", 0, 0, 1.25, 0, 0, 0, 0)
    data += struct.pack("<I", 0)
    return struct.pack("<HH", 7, len(data)) + data
