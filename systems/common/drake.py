"""Helpers for Drake systems: ports, connections, weak callbacks, sliders of Meshcat."""

import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    InputPort,
    OutputPort,
    PortDataType,
    System,
)


def input_port(name: str) -> Callable[[System], InputPort]:
    """Returns a method, for a system's class, that returns the input port of that name."""

    def port(self: System) -> InputPort:
        return self.GetInputPort(name)

    port.__doc__ = f"The input port `{name}`."
    return port


def output_port(name: str) -> Callable[[System], OutputPort]:
    """Returns a method, for a system's class, that returns the output port of that name."""

    def port(self: System) -> OutputPort:
        return self.GetOutputPort(name)

    port.__doc__ = f"The output port `{name}`."
    return port


def vector_input(system: System, name: str, context: Context) -> np.ndarray:
    """Returns the vector at an input port."""
    return np.asarray(system.GetInputPort(name).Eval(context))


def vector_output(system: System, name: str, context: Context) -> np.ndarray:
    """Returns the vector at an output port; a diagram takes its root context."""
    return np.asarray(system.GetOutputPort(name).Eval(context))


def optional_input(system: System, name: str, context: Context) -> np.ndarray | None:
    """Returns the vector at an input port, None if the port is not connected."""
    port = system.GetInputPort(name)
    return np.asarray(port.Eval(context)) if port.HasValue(context) else None


def connect(builder: DiagramBuilder, source: OutputPort, target: InputPort) -> None:
    """Connects two ports; raises ValueError, naming both, if their types or sizes differ."""
    if (source.get_data_type(), source.size()) != (target.get_data_type(), target.size()):
        raise ValueError(
            f"{_describe(target)} must be of the type and size of its source, {_describe(source)}"
        )
    builder.Connect(source, target)


def _describe(port: InputPort | OutputPort) -> str:
    vector = port.get_data_type() == PortDataType.kVectorValued
    kind = "input" if isinstance(port, InputPort) else "output"
    what = f"a vector of {port.size()}" if vector else "not a vector"
    system = type(port.get_system()).__name__
    return f"the {kind} {port.get_name()!r} of {system} ({what})"


def weak_callback(method: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a callback for a bound method that does not keep its system alive.

    Drake keeps callbacks of abstract output ports and cache entries as long as the system lives.
    A bound method would keep the system, and the Diagram around it, alive permanently.
    """
    reference = weakref.WeakMethod(method)

    def call(*arguments: Any) -> Any:
        bound = reference()
        assert bound is not None  # Drake calls for living systems only.
        return bound(*arguments)

    return call


def add_slider(
    meshcat: Meshcat, name: str, range: tuple[float, float], step: float, value: float, *keys: str
) -> None:
    """Adds a slider to Meshcat's controls, or resets it; `keys` decrement and increment it."""
    if name in meshcat.GetSliderNames():
        meshcat.DeleteSlider(name)
    meshcat.AddSlider(name, *range, step, value, *keys)
