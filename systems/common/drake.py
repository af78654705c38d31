"""Ports by methods, as Drake's own systems have them: `camera.color_image_output_port()`."""

import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    InputPort,
    OutputPort,
    PortDataType,
    System,
)


def input_port(name: str) -> Callable[[System], InputPort]:
    """A method, for the body of a system's class, that returns its input port of that name."""

    def port(self: System) -> InputPort:
        return self.GetInputPort(name)

    port.__doc__ = f"The input port `{name}`."
    return port


def output_port(name: str) -> Callable[[System], OutputPort]:
    """A method, for the body of a system's class, that returns its output port of that name."""

    def port(self: System) -> OutputPort:
        return self.GetOutputPort(name)

    port.__doc__ = f"The output port `{name}`."
    return port


def vector_input(system: System, name: str, context: Context) -> np.ndarray:
    """The vector at the input port of that name."""
    return np.asarray(system.GetInputPort(name).Eval(context))


def optional_input(system: System, name: str, context: Context) -> np.ndarray | None:
    """The vector at the input port of that name; None where nothing is connected."""
    port = system.GetInputPort(name)
    return np.asarray(port.Eval(context)) if port.HasValue(context) else None


def connect(builder: DiagramBuilder, source: OutputPort, target: InputPort) -> None:
    """Connects two ports.

    Raises:
        ValueError: if one has another size than the other, or holds no vector where that does; the
            message names both.
    """
    if (source.get_data_type(), source.size()) != (target.get_data_type(), target.size()):
        raise ValueError(
            f"{_described(source)} and {_described(target)} that it leads to; they must be alike"
        )
    builder.Connect(source, target)


def _described(port: InputPort | OutputPort) -> str:
    vector = port.get_data_type() == PortDataType.kVectorValued
    way = "input" if isinstance(port, InputPort) else "output"
    what = f"a vector of {port.size()}" if vector else "no vector"
    system = port.get_system()
    return f"the {way} {port.get_name()!r} of {type(system).__name__} is {what}"


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
