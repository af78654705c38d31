"""What goes wrong in a trial, and when."""

from dataclasses import dataclass

import numpy as np

KINDS = (
    "dropped",
    "delayed",
    "duplicated",
    "reordered",
    "corrupt",
    "not_finite",
    "clock_jump",
    "state_frozen",
    "policy_nonsense",
    "policy_stalled",
    "policy_killed",
)
"""Messages are dropped, 300 ms late, come twice, overtake each other, have bits flipped, hold what
is no number; the vehicle's clock jumps; it says the same state again and again; the policy decides
nonsense, the process that it is in stands still, or ends."""

DELAY = 0.3
"""[s] of messages that are delayed."""

_FOREVER = 1e6  # [s]


@dataclass(frozen=True)
class Fault:
    """One trial's."""

    kind: str
    begin: float
    """[s]"""
    duration: float
    """[s]"""
    part: float
    """[-] Of the messages that are hit."""
    size: float
    """[s] By which the clock jumps."""

    @classmethod
    def draw(cls, number: int, random: np.random.Generator) -> "Fault":
        """That of trial `number`: the kinds take turns, the rest is drawn."""
        kind = KINDS[number % len(KINDS)]
        return cls(
            kind=kind,
            begin=float(random.uniform(0.5, 3.0)),
            duration=_FOREVER if kind == "policy_killed" else float(random.uniform(0.3, 4.0)),
            part=float(random.uniform(0.3, 1.0)),
            size=float(random.choice([-1.0, 1.0]) * 10 ** random.uniform(-1.0, 1.0)),
        )

    def is_on(self, now: float) -> bool:
        """Whether it is on at a time [s]."""
        return self.begin <= now < self.begin + self.duration
