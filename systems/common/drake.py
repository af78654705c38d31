"""Helpers for Drake systems: ports, connections, scalar types, parameters of Contexts."""

import functools
import inspect
import sys
import weakref
from collections.abc import Callable, Sequence
from copy import copy, deepcopy
from dataclasses import fields, replace
from typing import Any, Protocol, TypeVar, cast

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.common.value import Value
from pydrake.geometry import Meshcat
from pydrake.symbolic import Expression
from pydrake.systems import sensors
from pydrake.systems.framework import (
    BasicVector_,  # pyright: ignore[reportAttributeAccessIssue]
    Context,
    DiagramBuilder,
    InputPort,
    LeafSystem_,  # pyright: ignore[reportAttributeAccessIssue]
    OutputPort,
    PortDataType,
    System,
    SystemScalarConverter,
    ValueProducer,
)
from pydrake.systems.scalar_conversion import TemplateSystem

from splatpilot.systems.common.validation import Config, require


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


def optional_input(system: System, name: str, context: Context) -> Any:
    """Returns the vector or value at an input port, None if the port is not connected."""
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
    (kind, given), (expected, size) = _content(source), _content(target)
    same_type = (kind, source.get_data_type()) == (expected, target.get_data_type())
    fits = same_type and (given == size or not all(map(np.prod, (given, size))))
    if not fits:
        require(False, _describe(target), "of the type and size of its source", _describe(source))
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
    article = "a " if content == "vector" else ""
    what = f"{article}{content} of {'x'.join(map(str, size))}" if content else "not a vector"
    return f"the {kind} {port.get_name()!r} of {type(port.get_system()).__name__} ({what})"


def weak_callback(method: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a callback for a bound method that does not keep its system, and the Diagram, alive:
    Drake keeps callbacks of abstract output ports and cache entries."""
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


_S = TypeVar("_S", covariant=True)


class _Template(Protocol[_S]):
    def __getitem__(self, scalar: Any) -> type[_S]: ...


class _SystemTemplate(TemplateSystem):
    """A TemplateSystem of classes with an ordinary `__init__`, see `system_template`."""

    def _on_add(self, param: Any, cls: Any, skip_rename: bool) -> Any:
        init, name = cls.__init__, cls.__qualname__.rpartition(".")[2]
        if "__init__" in vars(cls):
            signature = inspect.signature(init)
            valid, remedy = "converter" in signature.parameters, "pass converter on to its base"
            require(valid, f"{name}.__init__", "(self, ..., *, converter=None)", signature, remedy)
            del cls.__init__

        def construct(system: Any, *args: Any, converter: Any = None, **options: Any) -> None:
            if type(system) is not cls and converter is self._converter:
                converter = SystemScalarConverter()  # A subclass is not converted to its base.
            init(system, *args, converter=converter, **options)
            if type(system) is cls:
                given = {key: _kept(value) for key, value in options.items()}
                system._arguments = [*map(_kept, args)], given

        def construct_copy(system: Any, other: Any, converter: Any = None) -> None:
            args, options = other._arguments
            construct(system, *args, converter=converter, **options)

        cls._construct, cls._construct_copy = construct, construct_copy
        cls = super()._on_add(param, cls, skip_rename)
        # Drake's constructor takes any arguments.
        functools.update_wrapper(cls.__init__, init)
        signature = inspect.signature(init)
        arguments = [each for name, each in signature.parameters.items() if name != "converter"]
        cls.__init__.__signature__ = signature.replace(parameters=arguments)
        if param == (float,):
            cls.__name__ = cls.__qualname__ = self.name.removesuffix("_")
        return cls


def _kept(argument: Any) -> Any:
    """Returns an argument, or a copy if its owner may change it."""
    return deepcopy(argument) if isinstance(argument, Config | np.ndarray) else argument


def system_template(
    name: str, scalars: Sequence[Any] = (float, AutoDiffXd)
) -> Callable[[Callable[[Any], type[_S]]], _Template[_S]]:
    """Defines a system for several scalar types by a function from the type to the class.

    As Drake's `TemplateSystem.define`, but the class has an `__init__`, with the keyword
    `converter` for its base. A conversion calls it with the same arguments. A subclass supports
    conversion only if it is a template.
    """

    def define(instantiate: Callable[[Any], type[_S]]) -> _Template[_S]:
        scope = sys.modules[instantiate.__module__]
        decorator: Any = _SystemTemplate.define(name, T_list=list(scalars), scope=scope)
        return decorator(instantiate)

    return define


def is_autodiff(x: Any) -> bool:
    """Checks if x is an AutoDiffXd or an array of objects such as these."""
    return isinstance(x, AutoDiffXd) or getattr(getattr(x, "dtype", None), "kind", "") == "O"


_value = np.frompyfunc(lambda x: x.value() if isinstance(x, AutoDiffXd) else float(x), 1, 1)


def float_values(x: Any) -> Any:
    """Returns numbers (...) of AutoDiffXd as floats; other arrays and floats as they are."""
    return np.asarray(_value(x), dtype=float)[()] if is_autodiff(x) else x


def declare_input_ports_like(system: Any, other: Any) -> None:
    """Declares input ports with the names and types of those of another system."""
    for index in range(other.num_input_ports()):
        port = other.get_input_port(index)
        if port.get_data_type() == PortDataType.kVectorValued:
            system.DeclareVectorInputPort(port.get_name(), port.size())
        else:
            system.DeclareAbstractInputPort(port.get_name(), other.AllocateInputAbstract(port))


class ByValues(LeafSystem_[AutoDiffXd]):
    """Base class of the conversions of float systems that compute by the values of their inputs."""

    def __init__(self, system: Any) -> None:
        """Declares the input ports of a float system."""
        super().__init__()
        self.set_name(system.get_name())
        self._system = system
        declare_input_ports_like(self, system)
        # The float Context keeps cached results.
        self._inner = self.DeclareCacheEntry(
            "context of values",
            ValueProducer(cast(Any, Value[object]), weak_callback(self._make_context)),
            {self.nothing_ticket()},
        ).cache_index()

    @classmethod
    def converter(cls) -> Any:
        """Returns the `converter` of the float system."""
        converter: Any = SystemScalarConverter()
        converter._AddConstructor[AutoDiffXd, float](cls)
        return converter

    def _make_context(self, context: Any, value: Any) -> None:
        value.set_value(self._system.CreateDefaultContext())

    def context_of_values(self, context: Any) -> Any:
        """Returns a Context of the float system with time and inputs by their values."""
        inner: Any = self.get_cache_entry(self._inner).Eval(context)
        inner.SetTime(float_values(context.get_time()))
        for index in range(self.num_input_ports()):
            port = self.get_input_port(index)
            if port.HasValue(context):
                self._system.get_input_port(index).FixValue(inner, float_values(port.Eval(context)))
        return inner


class ConfigParameter:
    """Numbers of a configuration, and lists of numbers, as a numeric parameter of Contexts."""

    def __init__(self, system: Any, scalar: Any, config: Config, names: Sequence[str] = ()) -> None:
        """Declares the parameter; `names` are the fields it has, all by default."""
        self._config = config = deepcopy(config)  # Its owner may change it.
        self.names = names or [field.name for field in fields(config)]  # pyright: ignore
        defaults = np.hstack([getattr(config, name) for name in self.names]).tolist()
        self._defaults = defaults if scalar is float else None
        self._index = system.DeclareNumericParameter(BasicVector_[scalar](defaults))

    def config(self, context: Context) -> Any:
        """Returns the configuration with the numbers of a Context."""
        numbers = context.get_numeric_parameter(self._index).value().tolist()
        if numbers == self._defaults:
            return self._config  # A copy costs as much as a control step.
        config = copy(self._config)
        vars(config).update(self._by_name(numbers))
        return config

    def _by_name(self, numbers: list[Any]) -> dict[str, Any]:
        rest, values = iter(numbers), {}
        for name in self.names:
            value = getattr(self._config, name)
            values[name] = [next(rest) for _ in value] if isinstance(value, list) else next(rest)
        return values

    def set(self, context: Context, name: str, value: Any) -> None:
        """Sets a field, a number or a sequence of numbers; raises ValueError if the configuration
        is invalid with it. Symbolic values are not checked."""
        vector = context.get_mutable_numeric_parameter(self._index)
        is_list = isinstance(getattr(self._config, name), list)
        condition = "a list of numbers" if is_list else "a number"
        require(is_list == (np.ndim(value) == 1), name, condition, value)
        values, numbers = list(value) if is_list else [value], vector.CopyToVector()
        if not isinstance(numbers[0], Expression):
            known = self._by_name(float_values(numbers).tolist())
            changed = [*map(float_values, values)] if is_list else float_values(value)
            replace(self._config, **known | {name: changed}).validate()  # pyright: ignore
        sizes = {each: np.size(getattr(self._config, each)) for each in self.names}
        start = sum(sizes[each] for each in self.names[: self.names.index(name)])
        require(len(values) == sizes[name], name, f"{sizes[name]} numbers", len(values))
        for k, number in enumerate(values):
            vector.SetAtIndex(start + k, number)


def parameter_setter(name: str) -> Callable[[Any, Context, Any], None]:
    """Returns a method, for a system's class, that sets a number of one of its `_parameters`."""

    def set_parameter(self: Any, context: Context, value: Any) -> None:
        self.ValidateContext(context)
        next(each for each in self._parameters if name in each.names).set(context, name, value)

    set_parameter.__doc__ = f"Sets the parameter `{name}` of a Context."
    return set_parameter
