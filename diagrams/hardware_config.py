"""How vehicle and policy talk."""

import math
from dataclasses import dataclass, field

from splatpilot.systems.messaging.failsafe_config import FailsafeConfig
from splatpilot.systems.messaging.open_lcm import DEFAULT_URL
from splatpilot.systems.messaging.time_of_flight_receiver import TimeOfFlightStream


@dataclass
class HardwareConfig:
    """Where messages travel, how often, and how old they may be."""

    # LCM's URL.
    url: str = DEFAULT_URL
    # [s] Time between looks at what messages have come: of ticks of the wall clock.
    tick: float = 0.002
    # [Hz] Of states.
    state_rate: float = 50.0
    # [Hz] Of the bridge's status.
    status_rate: float = 5.0
    # [s] Without a message after which bridge and vehicle give up.
    patience: float = 10.0
    # What a simulated vehicle is told: "body_rates" or "velocity"; see `px4.setpoints` for PX4.
    setpoints: str = "body_rates"
    # The body that motion capture must see; none if empty.
    body: str = ""
    # The stream of the sensor of a policy that sees by time of flight; LCM's DEPTH_GRID where left
    # out.
    time_of_flight: TimeOfFlightStream | None = None
    # When the vehicle is taken from its policy, and what nobody may exceed.
    failsafe: FailsafeConfig = field(default_factory=FailsafeConfig)

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("tick", "state_rate", "status_rate", "patience"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(
                    f"{name} is {value}; it must be positive and finite, as "
                    f"{getattr(type(self), name)}"
                )
        if self.setpoints not in ("velocity", "body_rates"):
            raise ValueError(f"setpoints must be velocity or body_rates, got {self.setpoints!r}")
        self.failsafe.validate()
        if self.time_of_flight is not None:
            self.time_of_flight.validate()
