"""What goes wrong in a trial, and when."""

from dataclasses import dataclass

import numpy as np

KINDS = (
    "dropped",
    "delayed",
    "duplicated",
    "reordered",
    "clock_jump",
    "state_frozen",
    "state_jumped",
    "body_lost",
    "body_dropped",
    "grid_dropped",
    "grid_corrupt",
    "policy_nonsense",
    "policy_raises",
    "policy_stalled",
    "policy_killed",
    "not_finite",
    "corrupt",
)
"""Messages are dropped, 300 ms late, come twice, or overtake each other; the vehicle's clock jumps;
it says the same state again and again, or one that is meters away; motion capture does not see the
vehicle, or its messages are dropped; packets of the time-of-flight sensor are dropped, or have bits
flipped; the policy decides nonsense or raises exceptions, the process that it is in stands still,
or ends; messages hold a value that is not finite, or have bits flipped.

Of two at once the earlier is applied first: messages are read before they are corrupted."""

DELAY = 0.3
"""[s] of messages that are delayed."""

_FOREVER = 1e6  # [s]


@dataclass(frozen=True)
class Fault:
    """One of a trial's."""

    kind: str
    begin: float
    """[s]"""
    duration: float
    """[s]"""
    fraction: float
    """[-] Of the messages that are hit."""
    size: float
    """[s] By which the clock jumps, and of whose sign the state does."""

    @classmethod
    def draw(cls, kind: str, random: np.random.Generator) -> "Fault":
        """One of a kind, the rest drawn."""
        return cls(
            kind=kind,
            begin=float(random.uniform(0.5, 3.0)),
            duration=_FOREVER if kind == "policy_killed" else float(random.uniform(0.3, 4.0)),
            fraction=float(random.uniform(0.3, 1.0)),
            size=float(random.choice([-1.0, 1.0]) * 10 ** random.uniform(-1.0, 1.0)),
        )

    def is_on(self, now: float) -> bool:
        """Whether it is on at a time [s]."""
        return self.begin <= now < self.begin + self.duration


@dataclass(frozen=True)
class Trial:
    """What is flown, and what goes wrong."""

    faults: tuple[Fault, ...]
    policy: str
    setpoints: str
    """What the vehicle is told, see `HardwareConfig.setpoints`."""

    @classmethod
    def draw(cls, number: int, random: np.random.Generator) -> "Trial":
        """That of a number: kinds, interfaces and policies take turns, every other has two faults
        at once, the rest is drawn.

        Faults of the sensor's packets need the policy that sees by them.
        """
        turn, kind = divmod(number, len(KINDS))
        kinds = [kind]
        if random.random() < 0.5:
            kinds.append(int(random.choice([k for k in range(len(KINDS)) if k != kind])))
        faults = tuple(Fault.draw(KINDS[k], random) for k in sorted(kinds))
        needs_grid = any(fault.kind.startswith("grid") for fault in faults)
        policy = "diffaero_tof" if needs_grid else ("straight", "reactive")[turn // 2 % 2]
        return cls(faults, policy, ("velocity", "body_rates")[turn % 2])
