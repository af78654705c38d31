"""A bad connection between vehicle and bridge."""

import heapq
import math
import struct
from typing import Any

import numpy as np
from lcm import LCM

from splatpilot.analysis.faults.fault import DELAY, Fault
from splatpilot.systems.messaging.codecs import Codec
from splatpilot.systems.weakly import weakly


class Relay:
    """
    Carries messages between two LCMs, as well as a fault lets it.

    Args:
        vehicle, bridge: where messages of either come from, and are to go.
        from_vehicle, from_bridge: what there is to carry.
        fault: what goes wrong.
        random: where chance comes from.
    """

    def __init__(
        self,
        vehicle: LCM,
        bridge: LCM,
        from_vehicle: list[Codec],
        from_bridge: list[Codec],
        fault: Fault,
        random: np.random.Generator,
    ) -> None:
        self._fault, self._random = fault, random
        self._ends, self._count, self._now = (vehicle, bridge), 0, 0.0
        self._waiting: list[tuple[float, int, LCM, str, bytes]] = []
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
        receiver = self._ends[1 if of_vehicle else 0]
        delays, data = self._treat(codec, data, of_vehicle)
        for delay in delays:
            self._count += 1
            due = self._now + delay
            heapq.heappush(self._waiting, (due, self._count, receiver, channel, data))

    def _treat(self, codec: Codec, data: bytes, of_vehicle: bool) -> tuple[list[float], bytes]:
        """The delays [s] with which a message arrives, once or more or never, and what it is."""
        fault, random = self._fault, self._random
        if fault.kind == "clock_jump" and of_vehicle and self._now >= fault.begin:
            return [0.0], self._changed(codec, data, utime=round(fault.size * 1e6))
        if fault.kind == "state_frozen" and codec.port == "state":
            if not fault.is_on(self._now):
                self._state = None
                return [0.0], data
            self._state = self._state or codec.message.decode(data)
            return [0.0], self._changed(codec, data, like=self._state)
        if not fault.is_on(self._now) or random.random() > fault.part:
            return [0.0], data
        match fault.kind:
            case "dropped":
                return [], data
            case "delayed":
                return [DELAY], data
            case "duplicated":
                return [0.0, float(random.uniform(0.0, DELAY))], data
            case "reordered":
                return [float(random.uniform(0.0, DELAY))], data
            case "corrupt":
                broken = bytearray(data[: random.integers(0, len(data) + 1)])
                for index in random.integers(0, max(len(broken), 1), 8) if broken else ():
                    broken[index] ^= 1 << int(random.integers(8))
                return [0.0], bytes(broken)
            case "not_finite":
                # A number anywhere in it becomes none.
                place = 8 * int(random.integers(1, max(len(data) // 8, 2)))
                return [0.0], data[: place - 4] + struct.pack(">d", math.nan) + data[place + 4 :]
        return [0.0], data

    def _changed(self, codec: Codec, data: bytes, utime: int = 0, like: Any = None) -> bytes:
        """The message with another time, or with the content of another."""
        message = codec.message.decode(data)
        message.header.utime += utime
        if like is not None:
            header = message.header
            message = codec.message.decode(like.encode())
            message.header = header
        return message.encode()
