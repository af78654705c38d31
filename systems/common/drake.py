"""Helpers for Drake systems: ports, connections, weak callbacks, sliders of Meshcat."""

import weakref
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems import sensors
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    InputPort,
    OutputPort,
    PortDataType,
    System,
)

from splatpilot.systems.common.validation import require


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


def optional_value(system: System, name: str, context: Context) -> Any:
    """Returns the value at an abstract input port, None if the port is not connected."""
    port = system.GetInputPort(name)
    return port.Eval(context) if port.HasValue(context) else None


def require_finite(port: InputPort, context: Context, numbers: np.ndarray) -> None:
    """Raises ValueError, naming the port, unless the numbers at an input port are finite."""
    if not np.isfinite(numbers).all():
        system = cast(System, port.get_system())
        what = f"input '{port.get_name()}' of '{system.get_name() or type(system).__name__}'"
        remedy = "check the system that is connected to it"
        require(False, f"{what} at t = {context.get_time()} s", "finite", numbers.tolist(), remedy)


def connect(builder: DiagramBuilder, source: OutputPort, target: InputPort) -> None:
    """Connects two ports; raises ValueError, naming both, if their types or sizes differ.

    An image of size 0 stands for any size.
    """
    given, taken = _content(source), _content(target)
    kinds = (source.get_data_type(), given[0]), (target.get_data_type(), taken[0])
    sizes_differ = given[1] != taken[1] and all(map(np.prod, (given[1], taken[1])))
    if kinds[0] != kinds[1] or sizes_differ:
        raise ValueError(
            f"{_describe(target)} must be of the type and size of its source, {_describe(source)}"
        )
    builder.Connect(source, target)


_IMAGES = "ImageDepth16U", "ImageDepth32F", "ImageLabel16I", "ImageRgb8U", "ImageRgba8U"


def _content(port: InputPort | OutputPort) -> tuple[str, tuple[int, ...]]:
    """Returns the type and size of a port's vector or image; of other values nothing."""
    if port.get_data_type() == PortDataType.kVectorValued:
        return "vector", (port.size(),)
    if isinstance(port, OutputPort):
        value = port.Allocate()
    else:
        value = cast(Any, port.get_system()).AllocateInputAbstract(port)
    image: Any = value.get_value() if hasattr(value, "get_value") else None
    names = [name for name in _IMAGES if type(image) is getattr(sensors, name)]
    return (names[0], (image.width(), image.height())) if names else ("", ())


def _describe(port: InputPort | OutputPort) -> str:
    kind = "input" if isinstance(port, InputPort) else "output"
    content, size = _content(port)
    what = f"{content} of {'x'.join(map(str, size))}" if content else "not a vector"
    what = f"a {what}" if content == "vector" else what
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
