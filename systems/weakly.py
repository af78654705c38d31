"""Callbacks that do not keep their system alive."""

import weakref
from collections.abc import Callable
from typing import Any


def weakly(method: Callable[..., Any]) -> Callable[..., Any]:
    """The bound method, for Drake to call without owning what it is bound to.

    Drake keeps the callbacks of abstract output ports and of cache entries for as long as their
    system lives, and a callback that refers to the system would keep it, and the whole Diagram
    around it, alive for ever.
    """
    reference = weakref.WeakMethod(method)

    def call(*arguments: Any) -> Any:
        bound = reference()
        assert bound is not None  # Drake calls for living systems only.
        return bound(*arguments)

    return call
