"""What has come to a receiver, as it stands in the Context."""

import logging
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Self, cast

import numpy as np
from pydrake.systems.framework import BasicVector, Context, State

_log = logging.getLogger(__name__)

RESTART = 1.0
"""[s], after which a stream that fell silent may be another."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Received:
    """What a receiver keeps, in the abstract state 0 of its Context. Nothing in it changes:
    Contexts, which copy it at every update, may share it."""

    rejected: int = 0
    """Messages that were of no use."""

    def __deepcopy__(self, memo: dict) -> Self:
        return self

    def rejecting(self, count: int, source: str, why: str) -> Self:
        """With `count` more that were of no use; the first, second, fourth, eighth... is logged."""
        total = self.rejected + count
        if total.bit_length() != self.rejected.bit_length():
            _log.warning("%s: a message is refused, %d so far: %s", source, total, why)
        return replace(self, rejected=total)

    def taking[R: Received](
        self: R,
        messages: Iterable[bytes],
        strangers: int,
        source: str,
        after: Callable[[R, bytes], R],
    ) -> R:
        """After messages, and after others of `strangers`, which are rejected. `after` says what
        there is after one more; one for which it raises ValueError or struct.error is rejected."""
        received = self
        if strangers:
            received = received.rejecting(strangers, source, "its sender is not named")
        for message in messages:
            try:
                received = after(received, message)
            except (ValueError, struct.error) as error:
                received = received.rejecting(1, source, str(error))
        return received

    @classmethod
    def of(cls, context: Context) -> Self:
        """That in a receiver's Context."""
        return cast(Self, context.get_abstract_state(0).get_value())

    def keep(self, state: State) -> None:
        """Makes this what there is."""
        state.get_mutable_abstract_state(0).set_value(self)

    @classmethod
    def output(cls, value: Callable[[Self, float], Any]) -> Callable[[Context, BasicVector], None]:
        """The callback of a port that gives `value` of what there is and of the time [s]."""

        def calc(context: Context, output: BasicVector) -> None:
            numbers = value(cls.of(context), context.get_time())
            output.SetFromVector(np.atleast_1d(numbers).astype(float))

        return calc
