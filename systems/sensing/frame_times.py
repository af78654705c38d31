"""When a camera takes its frames, and which of them has come."""

import math
from dataclasses import dataclass

import numpy as np

from splatpilot.systems.sensing.observation_noise import ObservationNoise

CYCLE = 64
"""Frames whose delays differ; those of the frames that follow are the same again."""

_SPARE = 8  # Frames that may be lost one after another; if more are, the last of them is seen.


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """Frame k is taken at (k + phase) / rate, and comes `delays[k % CYCLE]` later.

    Without a rate, one is taken whenever somebody looks, and comes `delays[0]` later.
    """

    delays: np.ndarray  # (CYCLE,) or (1,) [s], infinite of frames that never come
    rate: float | None = None  # [Hz]
    phase: float = 0.0  # [-]
    lookback: int = 0  # [-] Frames that are looked through.
    before: float = 0.0  # [s] By how much something else happened before a frame was taken.

    @classmethod
    def late(cls, latency: float) -> "FrameTimes":
        """Frames of whenever somebody looks, `latency` [s] late."""
        return cls(np.array([latency]))

    @classmethod
    def draw(cls, noise: ObservationNoise, seed: int) -> "FrameTimes":
        """Those of one flight."""
        if not noise.frame_rate:
            return cls.late(noise.latency)
        lower, upper = noise.frame_rate
        random = np.random.default_rng([seed, CYCLE])
        rate, phase = random.uniform(lower, upper), random.random()
        delays = frame_delays(noise, *random.random((2, CYCLE)))
        return cls(delays, rate, phase, lookback(noise))

    def age(self, time: float) -> float:
        """[s], at a time [s], of the last frame that has come, or of what happened `before`."""
        if self.rate is None:
            return float(self.delays[0]) + self.before
        newest = math.floor(time * self.rate - self.phase)
        age = 0.0
        for number in range(newest, newest - self.lookback, -1):
            age = time - (number + self.phase) / self.rate
            if self.delays[number % CYCLE] <= age:
                break
        return age + self.before

    @property
    def oldest(self) -> float:
        """[s], that no age exceeds."""
        oldest = float(self.delays[0]) if self.rate is None else self.lookback / self.rate
        return oldest + self.before


def frame_delays(noise: ObservationNoise, late: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """How late frames come [s], infinite if never: of numbers drawn from U(0, 1), of any shape."""
    return np.where(lost < noise.frame_dropout, np.inf, noise.latency + noise.jitter * late)


def lookback(noise: ObservationNoise) -> int:
    """How many frames there may be between the newest that was taken and the newest that came."""
    return math.ceil((noise.latency + noise.jitter) * max(noise.frame_rate)) + _SPARE
