"""When a vehicle is taken from its policy, and what happens then."""

import math
from dataclasses import dataclass, field

from splatpilot.systems.vehicle.flight_limits import FlightLimits


@dataclass
class FailsafeConfig:
    """When a vehicle is taken from its policy, and what happens then."""

    # [s] Nothing is flown by a state, an observation or a sight by motion capture that is older.
    max_age: float = 0.3
    # [s] By which a process may be behind the wall clock.
    max_lag: float = 0.3
    # [s] That all must be well again until the policy flies on.
    recovery: float = 0.5
    # [s] Of hovering after which the vehicle lands.
    patience: float = 5.0
    # [m/s] Of landing.
    descent: float = 0.5
    limits: FlightLimits = field(default_factory=FlightLimits)

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("max_age", "max_lag", "recovery", "patience", "descent"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(
                    f"failsafe.{name} is {value}; it must be positive and finite, as "
                    f"{getattr(type(self), name)}"
                )
        self.limits.validate()
