"""Writes logs in the ULog format, as PX4's documentation specifies it; `pyulog` reads them."""

import struct

import numpy as np

FORMATS = {
    "vehicle_local_position": "uint64_t timestamp;float x;float y;float z;float vx;float vy;"
    "float vz;bool xy_valid;bool v_xy_valid;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "vehicle_angular_velocity": "uint64_t timestamp;float[3] xyz;",
    "vehicle_status": "uint64_t timestamp;uint8_t nav_state;uint8_t arming_state;",
}
PACKED = dict(zip(FORMATS, ("Q6f2?", "Q4f", "Q3f", "Q2B"), strict=True))
BOOT = 20.0  # [s] of the first message.


def write_log(path, velocity, attitude=(1.0, 0, 0, 0), nav_state=14, valid=lambda t: True) -> None:
    """Writes 3 s of flight from (1, -2, -2) m with 10 Hz of positions, 50 Hz of attitudes."""
    rows = [(BOOT + 0.5 * n, "vehicle_status", (nav_state, 2)) for n in range(7)]
    for number in range(151):
        time = 0.02 * number
        rows.append((BOOT + time, "vehicle_attitude", attitude))
        rows.append((BOOT + time, "vehicle_angular_velocity", (0.0, 0.0, 0.0)))
        if number % 5 == 0:
            p = np.array([1.0 + 0.5 * time, -2.0, -2.0 - 1e-4 * time])
            values = *p, *velocity, valid(time), True
            rows.append((BOOT + time, "vehicle_local_position", values))

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<Hc", len(body), kind) + body

    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", round(BOOT * 1e6)) + message(b"B", bytes(40))
    data += b"".join(message(b"F", f"{name}:{FORMATS[name]}".encode()) for name in FORMATS)
    for number, name in enumerate(FORMATS):
        data += message(b"A", struct.pack("<BH", 0, number) + name.encode())
    for time, name, values in sorted(rows, key=lambda row: row[0]):
        body = struct.pack(f"<{PACKED[name]}", round(time * 1e6), *values)
        data += message(b"D", struct.pack("<H", list(FORMATS).index(name)) + body)
    path.write_bytes(data)
