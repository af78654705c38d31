"""Times and delays of camera frames and of decisions, and the pose of the last frame that came."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from splatpilot.systems.common.drake import weak_callback
from splatpilot.systems.common.validation import require
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.state import array_namespace, pose_from_state

CYCLE = 64  # Number of frames after which their delays repeat.
_SPARE = 8  # Consecutive frames that may be lost; if more are, the last of them is seen.


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """Frame k is taken at (k + phase) / rate, and comes `delays[k % CYCLE]` later.

    Without a rate, one is taken at each evaluation, and comes `delays[0]` later.
    """

    delays: np.ndarray  # (CYCLE,) or (1,) [s], infinite of frames that never come
    rate: float | None = None  # [Hz]
    phase: float = 0.0  # [-]
    lookback: int = 0  # [-] Frames to search.
    before: float = 0.0  # [s] By which another event precedes each frame.

    @classmethod
    def late(cls, latency: float) -> "FrameTimes":
        """Returns frames that are taken at each evaluation, `latency` [s] late."""
        return cls(np.array([latency]))

    @classmethod
    def draw(cls, noise: ObservationNoise, seed: int) -> "FrameTimes":
        """Draws the frames of one flight."""
        if not noise.frame_rate:
            return cls.late(noise.latency)
        lower, upper = noise.frame_rate
        random = np.random.default_rng([seed, CYCLE])
        rate, phase = random.uniform(lower, upper), random.random()
        delays = frame_delays(noise, *random.random((2, CYCLE)))
        return cls(delays, rate, phase, lookback(noise))

    def age(self, time: float) -> float:
        """Returns the age [s], at a time [s], of the last frame that arrived, plus `before`."""
        if self.rate is None:
            return float(self.delays[0]) + self.before
        rate, phase, now = (np.array([x]) for x in (self.rate, self.phase, time))
        [age] = frame_ages(self.delays[None], rate, phase, self.lookback, now)
        return float(age) + self.before

    def number(self, time: float) -> int | None:
        """Returns the number (>= 0) of the last frame that came by a time [s], or None."""
        if self.rate is None:
            return None
        taken = time - self.age(time) + self.before
        return round(taken * self.rate - self.phase) + max(CYCLE, self.lookback + 1)

    @property
    def oldest(self) -> float:
        """Maximum age [s]."""
        oldest = float(self.delays[0]) if self.rate is None else self.lookback / self.rate
        return oldest + self.before


def frame_delays(noise: ObservationNoise, late: Any, lost: Any) -> Any:
    """Computes delays of frames [s], infinite if they never come, from arrays or tensors `late` and
    `lost` of one shape that are drawn from U(0, 1)."""
    delays = noise.latency + noise.jitter * late
    return array_namespace(lost).where(lost < noise.frame_dropout, math.inf, delays)


def frame_ages(delays: Any, rate: Any, phase: Any, lookback: int, time: Any) -> Any:
    """Computes the ages (N,) [s] at a `time` (N,) [s] of the last frames that have come, of N
    streams, see `FrameTimes`. If none of `lookback` frames has come, the last of them is seen.
    `delays` are (N, CYCLE), the others (N,)."""
    xp = array_namespace(time)
    streams = xp.arange(len(time), device=time.device)
    back = xp.arange(lookback, device=time.device)
    number = xp.floor(time * rate - phase)[:, None] - back  # newest first
    ages = time[:, None] - (number + phase[:, None]) / rate[:, None]
    came = delays[streams[:, None], xp.asarray(number % CYCLE, dtype=xp.int64)] <= ages
    came[:, -1] = True
    return ages[streams, xp.asarray(came, dtype=xp.int64).argmax(1)]


def lookback(noise: ObservationNoise) -> int:
    """Returns the max number of frames between the newest taken and the newest that came."""
    return math.ceil((noise.latency + noise.jitter) * max(noise.frame_rate)) + _SPARE


class DelayedPose(LeafSystem):
    """Computes the pose of a quadrotor when the last frame that arrived was taken.

    .. pydrake_system::

        name: DelayedPose
        input_ports: [state]
        output_ports: [pose]

    - ``state`` (13): that of `QuadrotorPlant`.
    - ``pose`` (RigidTransform): X_WB at ``now - age``, with the age of the last frame, or the
      earliest known; interpolated linearly between samples every ``period`` [s].
    """

    def __init__(self, frames: FrameTimes, period: float = 0.02) -> None:
        super().__init__()
        late = frames.delays.min()
        valid = late >= 0.0 and math.isfinite(frames.oldest)
        require(valid, "delays of frames", "in [0, inf) s", late)
        self._frames = frames
        samples = math.ceil(frames.oldest / period) + 1
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self.DeclareDiscreteState(np.full(samples * 14, np.nan))
        calc = weak_callback(self._calc_pose)
        self.DeclareAbstractOutputPort("pose", lambda: Value(RigidTransform()), calc)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._sample)

    def _samples(self, context: Context) -> np.ndarray:
        """Rows of time and state (n, 14) up to now, oldest first; NaN before the first."""
        held = context.get_discrete_state_vector().value()
        now = [context.get_time()], np.asarray(self._state_port.Eval(context))
        return np.concatenate([held, *now]).reshape(-1, 14)

    def _sample(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._samples(context)[1:].ravel())

    def _calc_pose(self, context, output) -> None:
        rows = self._samples(context)
        rows = rows[np.isfinite(rows[:, 0])]
        then = context.get_time() - self._frames.age(context.get_time())
        row = int(np.searchsorted(rows[1:-1, 0], then))
        before, after = rows[row], rows[min(row + 1, len(rows) - 1)]
        share = (then - before[0]) / max(after[0] - before[0], 1e-12)
        state = before[1:] + min(max(share, 0.0), 1.0) * (after[1:] - before[1:])
        output.set_value(pose_from_state(state))


def decision_delays(delay: Sequence[float], seed: int, step: float) -> np.ndarray:
    """Draws the delays (CYCLE,) [s] of decisions from U(`delay`), in turn, rounded up to the times
    of what follows decisions every `step` [s]; zeros if `delay` is empty."""
    low, high = delay or (0.0, 0.0)
    drawn = np.random.default_rng([seed, CYCLE, 1]).uniform(low, high, CYCLE)
    return step * np.ceil(drawn / step - 1e-9)


class DecisionDelay(LeafSystem):
    """Delays an output of a policy by the time of inference and of the link to the controller.

    Its input and its output have the output's name and size. The decision at time t comes at t + d,
    with d drawn for each by `decision_delays`; the newest that has come is held. A `command`, which
    the plant integrates, changes at multiples of `step` only.

    Args:
        period: time between decisions [s].
        delay: min and max [s]; the max is above 0.
        step: period [s] of the controller, which follows decisions.
        seed: equal delays follow from equal seeds.
        at_once: if the input at time t is already the decision of that time; a policy with a
            discrete update decides at the same instant, and the input is still the one before.
    """

    def __init__(
        self,
        output: str,
        size: int,
        period: float,
        delay: Sequence[float],
        step: float,
        seed: int,
        at_once: bool = False,
    ) -> None:
        super().__init__()
        self._delays, self._at_once = decision_delays(delay, seed, step), at_once
        self._period, self._count = period, math.ceil(self._delays.max() / period - 1e-9)
        self._kept = self._count + at_once
        self.DeclareVectorInputPort(output, size)
        self.DeclareDiscreteState(np.array([-period]))  # time of the newest decision [s]
        self.DeclareDiscreteState(self._kept * size)  # decisions that are kept, the newest first
        self._is_held = output == "command"
        self.DeclareVectorOutputPort(output, size, self._calc)
        self.DeclareInitializationDiscreteUpdateEvent(self._begin)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        if self._is_held:
            self.DeclareDiscreteState(size)  # the command
            # Sees what the update before it has written.
            self.DeclarePeriodicDiscreteUpdateEvent(step, 0.0, self._hold)

    def _decision(self, context: Context) -> np.ndarray:
        return np.asarray(self.get_input_port().Eval(context))

    def _begin(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(1, np.tile(self._decision(context), self._kept))
        if self._is_held:
            discrete_state.set_value(2, self._decision(context))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        decision, kept = self._decision(context), context.get_discrete_state(1).value()
        discrete_state.set_value(0, np.array([context.get_time()]))
        discrete_state.set_value(1, np.append(decision, kept)[: len(kept)])

    def _hold(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(2, self._newest(context, discrete_state))

    def _calc(self, context: Context, output: BasicVector) -> None:
        state = context.get_discrete_state()
        output.SetFromVector(state.value(2) if self._is_held else self._newest(context, state))

    def _newest(self, context: Context, state: DiscreteValues) -> np.ndarray:
        """Returns the newest decision that has come."""
        newest, rows = state.value(0)[0], state.value(1)
        if not self._at_once:
            rows = np.concatenate([self._decision(context), rows])
        rows = rows.reshape(-1, self.get_output_port().size())
        for back in range(self._count):
            time = newest - back * self._period
            delay = self._delays[round(time / self._period) % CYCLE]
            if time + delay <= context.get_time() + 1e-9:
                return rows[back]
        return rows[-1]
