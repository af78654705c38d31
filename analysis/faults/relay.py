"""A bad connection between vehicle and bridge."""

import heapq
import math
import socket
import struct
from typing import Any

import numpy as np
from lcm import LCM

from splatpilot.analysis.faults.fault import DELAY, Fault
from splatpilot.systems.messaging.codecs import Codec
from splatpilot.systems.sensing.time_of_flight_packets import GRID_MAGIC
from splatpilot.systems.weakly import weakly


class GridStream:
    """A sensor's stream by UDP to a port of this host, in the place of an LCM."""

    def __init__(self, port: int) -> None:
        self._port = port

    def publish(self, _: str, data: bytes) -> None:
        """Sends a packet."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.sendto(data, ("127.0.0.1", self._port))


class Relay:
    """
    Carries messages between two LCMs, as well as faults let it.

    Args:
        vehicle, bridge: where messages of either come from, and are to go.
        from_vehicle, from_bridge: what there is to carry.
        faults: what goes wrong.
        random: where chance comes from.
        grids: where grids of the vehicle go instead, as a sensor's packets.
    """

    def __init__(
        self,
        vehicle: LCM,
        bridge: LCM,
        from_vehicle: list[Codec],
        from_bridge: list[Codec],
        faults: tuple[Fault, ...],
        random: np.random.Generator,
        grids: GridStream | None = None,
    ) -> None:
        self._faults, self._random, self._grids = faults, random, grids
        self._ends, self._count, self._now = (vehicle, bridge), 0, 0.0
        self._waiting: list[tuple[float, int, LCM | GridStream, str, bytes]] = []
        self._state: Any = None
        for sender, codecs in ((vehicle, from_vehicle), (bridge, from_bridge)):
            for codec in codecs:
                sender.subscribe(codec.channel, self._taker(codec, sender is vehicle))

    def step(self, now: float) -> None:
        """Takes what was sent, and delivers what is due at a time [s]."""
        self._now = now
        for end in self._ends:
            while end.handle_timeout(0):
                pass
        while self._waiting and self._waiting[0][0] <= now:
            _, _, receiver, channel, data = heapq.heappop(self._waiting)
            receiver.publish(channel, data)

    def _taker(self, codec: Codec, of_vehicle: bool):
        # LCM owns what it calls, and is owned by the relay.
        take = weakly(self._take)
        return lambda channel, data: take(codec, of_vehicle, channel, data)

    def _take(self, codec: Codec, of_vehicle: bool, channel: str, data: bytes) -> None:
        receiver: LCM | GridStream = self._ends[1 if of_vehicle else 0]
        if codec.port == "depth_grid" and self._grids is not None:
            receiver, message = self._grids, codec.message.decode(data)
            head = GRID_MAGIC, message.header.seq, message.header.utime * 1000
            data = struct.pack(f"<IIQ{message.num_values}f", *head, *message.values)
        copies = [(0.0, data)]
        for fault in self._faults:
            copies = [
                (delay + later, changed)
                for delay, sent in copies
                for later, changed in self._treat(fault, codec, sent, of_vehicle)
            ]
        for delay, sent in copies:
            self._count += 1
            due = self._now + delay
            heapq.heappush(self._waiting, (due, self._count, receiver, channel, sent))

    def _treat(
        self, fault: Fault, codec: Codec, data: bytes, of_vehicle: bool
    ) -> list[tuple[float, bytes]]:
        """The copies of a message that arrive: the delay [s] of each, and what it is."""
        random, is_on, as_it_is = self._random, fault.is_on(self._now), [(0.0, data)]
        if fault.kind == "clock_jump" and of_vehicle and codec.port != "depth_grid":
            jump = round(fault.size * 1e6) if self._now >= fault.begin else 0
            return [(0.0, self._changed(codec, data, utime=jump))]
        if fault.kind == "state_frozen" and codec.port == "state":
            self._state = (self._state or codec.message.decode(data)) if is_on else None
            return [(0.0, self._changed(codec, data, like=self._state))]
        if not is_on:
            return as_it_is
        if fault.kind == "state_jumped" and codec.port == "state":
            moved = math.copysign(1.0 + 2.0 * fault.fraction, fault.size)  # [m]
            return [(0.0, self._changed(codec, data, moved=moved))]
        if random.random() > fault.fraction:
            return as_it_is
        hits_port = {
            "body_lost": "motion_capture_pose",
            "body_dropped": "motion_capture_pose",
            "grid_dropped": "depth_grid",
            "grid_corrupt": "depth_grid",
        }.get(fault.kind, codec.port)
        if codec.port != hits_port:
            return as_it_is
        match fault.kind:
            case "dropped" | "body_dropped" | "grid_dropped":
                return []
            case "delayed":
                return [(DELAY, data)]
            case "duplicated":
                return [(0.0, data), (float(random.uniform(0.0, DELAY)), data)]
            case "reordered":
                return [(float(random.uniform(0.0, DELAY)), data)]
            case "body_lost":
                return [(0.0, self._changed(codec, data, tracked=False))]
            case "corrupt" | "grid_corrupt":
                broken = bytearray(data[: random.integers(0, len(data) + 1)])
                for index in random.integers(0, max(len(broken), 1), 8) if broken else ():
                    broken[index] ^= 1 << int(random.integers(8))
                return [(0.0, bytes(broken))]
            case "not_finite":
                # A number anywhere in it becomes none.
                place = 8 * int(random.integers(1, max(len(data) // 8, 2)))
                spoilt = data[: place - 4] + struct.pack(">d", math.nan) + data[place + 4 :]
                return [(0.0, spoilt)]
        return as_it_is

    def _changed(
        self,
        codec: Codec,
        data: bytes,
        utime: int = 0,
        like: Any = None,
        moved: float = 0.0,
        tracked: bool = True,
    ) -> bytes:
        """The message with another time [us], the content of another, moved [m] or untracked."""
        message = codec.message.decode(data)
        message.header.utime += utime
        if like is not None:
            header = message.header
            message = codec.message.decode(like.encode())
            message.header = header
        if moved:
            message.p_WB = np.add(message.p_WB, [0.0, moved, 0.0])
        if not tracked:
            message.tracked = False
        return message.encode()
