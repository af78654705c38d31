"""How PX4 is flown."""

import math
from dataclasses import dataclass, field

from splatpilot.systems.messaging.open_lcm import DEFAULT_URL
from splatpilot.systems.messaging.udp_inbox import UdpConfig
from splatpilot.systems.px4.motion_capture_receiver import MotionCaptureConfig
from splatpilot.systems.px4.px4_commander import Px4CommanderConfig


@dataclass
class Px4Config:
    """Where messages travel, and what PX4 is asked for."""

    # LCM's URL, where the bridge is.
    url: str = DEFAULT_URL
    # Where PX4's packets come to.
    udp: UdpConfig = field(default_factory=lambda: UdpConfig(port=14540))
    # Address of PX4.
    vehicle_host: str = "127.0.0.1"
    # Port at which PX4 listens.
    vehicle_port: int = 14580
    # MAVLink's number of the vehicle.
    system: int = 1
    # [s] Time between looks at what has come.
    tick: float = 0.005
    # The body in motion capture whose pose is sent on to PX4; none where empty.
    body: str = ""
    # OptiTrack's stream, which is sent on as that body; LCM's MOTION_CAPTURE_POSE where left out.
    motion_capture: MotionCaptureConfig | None = None
    commander: Px4CommanderConfig = field(default_factory=Px4CommanderConfig)

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        self.udp.validate("px4.udp")
        UdpConfig(self.vehicle_port, self.vehicle_host).validate("px4.vehicle")
        if not 1 <= self.system <= 255:
            raise ValueError(f"px4.system is {self.system}; it must be 1 to 255")
        if not 0.0 < self.tick < math.inf:
            raise ValueError(
                f"px4.tick must be finite and > 0 s, got {self.tick}; by default it is "
                f"{Px4Config.tick}"
            )
        self.commander.validate()
        if self.motion_capture is not None:
            self.motion_capture.validate()
            if not self.body:
                raise ValueError("px4.motion_capture has no px4.body; name the body for the bridge")
