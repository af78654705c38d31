"""How vehicle and policy talk."""

import math
from dataclasses import dataclass, fields

from splatpilot.systems.messaging.open_lcm import DEFAULT_URL


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
    # [s] Nothing is commanded by a state or an image that is older.
    max_age: float = 0.3
    # [s] Without a message after which bridge and vehicle give up.
    patience: float = 10.0

    def validate(self) -> None:
        """Raises ValueError on a value that is not positive and finite, naming it."""
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "url" and not 0.0 < value < math.inf:
                raise ValueError(
                    f"{field.name} is {value}; it must be positive and finite, as {field.default}"
                )
