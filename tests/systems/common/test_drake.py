import contextlib
import gc
import inspect
import weakref

import numpy as np
import pytest
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, InitializeAutoDiff
from pydrake.common.value import Value
from pydrake.systems.framework import (
    DiagramBuilder,
    LeafSystem,
    LeafSystem_,  # pyright: ignore[reportAttributeAccessIssue]
)
from pydrake.systems.primitives import ConstantValueSource
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

import splatpilot as sp
from splatpilot.systems.common.drake import (
    connect,
    float_values,
    input_port,
    is_autodiff,
    optional_input,
    output_port,
    system_template,
    weak_callback,
)


class Doubler(LeafSystem):
    value_input_port = input_port("value")
    double_output_port = output_port("double")
    text_output_port = output_port("text")

    def __init__(self) -> None:
        LeafSystem.__init__(self)
        self.DeclareVectorInputPort("value", 1)
        self.DeclareVectorOutputPort("double", 1, self._calc_double)
        self.DeclareAbstractOutputPort("text", lambda: Value(""), weak_callback(self._calc_text))

    def _calc_double(self, context, output):
        value = optional_input(self, "value", context)
        output.SetFromVector(2 * (np.ones(1) if value is None else value))

    def _calc_text(self, context, output):
        output.set_value("text")


def test_ports_by_methods_and_optional_inputs():
    system = Doubler()
    context = system.CreateDefaultContext()
    assert system.double_output_port().Eval(context) == [2.0]
    system.value_input_port().FixValue(context, [3.0])
    assert system.double_output_port().Eval(context) == [6.0]


class Viewer(LeafSystem):
    def __init__(self, value) -> None:
        super().__init__()
        self.DeclareAbstractInputPort("image", Value(value))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (Viewer(ImageDepth32F(10, 10)), r"ImageDepth32F of 10x10\) .*ImageDepth32F of 64x36"),
        (Viewer(ImageRgba8U(64, 36)), r"input 'image' of Viewer \(ImageRgba8U of"),
        (Doubler(), r"input 'value' of Doubler \(a vector of 1\) must .* 'y0' of ConstantValueS"),
        (Viewer(""), r"Viewer \(not a vector"),
        (Viewer(ImageDepth32F()), ""),
        (Viewer(ImageDepth32F(64, 36)), ""),
    ],
)
def test_connected_ports_have_one_type_and_size(given, message):
    builder = DiagramBuilder()
    camera = builder.AddSystem(ConstantValueSource(Value(ImageDepth32F(64, 36))))
    target = builder.AddSystem(given)
    expected = pytest.raises(ValueError, match=message) if message else contextlib.nullcontext()
    with expected:
        connect(builder, camera.get_output_port(), target.get_input_port())
        builder.Build()


def test_weak_callbacks_do_not_keep_their_system_alive():
    system = Doubler()
    assert system.text_output_port().Eval(system.CreateDefaultContext()) == "text"
    alive = weakref.ref(system)
    del system
    gc.collect()
    assert alive() is None


@system_template("Power_")
def Power_(T):
    class Power(LeafSystem_[T]):
        """Raises its input to a power."""

        def __init__(self, exponent: float, *, converter=None):
            super().__init__(converter=converter)
            x = self.DeclareVectorInputPort("x", 1)
            power = lambda context, y: y.SetFromVector(x.Eval(context) ** exponent)  # noqa: E731
            self.DeclareVectorOutputPort("y", 1, power)

    return Power


@system_template("Cube_")
def Cube_(T):
    class Cube(Power_[T]):
        def __init__(self, *, shift: float = 0.0, converter=None):
            super().__init__(3.0, converter=converter)
            self.shift = shift

    return Cube


Plain_ = system_template("Plain_")(lambda T: type("Plain", (Power_[T],), {}))


def output(system, x):
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, x)
    return system.get_output_port().Eval(context)


@pytest.mark.parametrize(
    "make", [lambda: Power_[float](3.0), Cube_[float], lambda: Plain_[float](exponent=3.0)]
)
def test_a_template_converts_with_its_arguments_and_its_name(make):
    system = make()
    system.set_name("cube")
    converted = system.ToAutoDiffXd()
    assert converted.get_name() == "cube"
    y = output(converted, InitializeAutoDiff([2.0]).ravel())
    assert y[0].value() == output(system, [2.0])[0] == 8.0
    np.testing.assert_allclose(ExtractGradient(y), [[12.0]])
    assert type(converted) is type(make().ToAutoDiffXd())


def test_conversion_keeps_arguments_of_the_subclass_and_later_changes_out():
    assert Cube_[float](shift=0.5).ToAutoDiffXd().shift == 0.5
    config = sp.QuadrotorParams(drag=0.5)
    plant = sp.QuadrotorPlant(config)
    config.drag = 0.1
    converted = plant.ToAutoDiffXd()
    assert converted.CreateDefaultContext().get_numeric_parameter(0)[0].value() == 0.5


def test_a_class_whose_init_takes_no_converter_is_refused():
    parts = {"__init__": lambda self: None}
    bad = system_template("Bad_")(lambda T: type("Bad", (Power_[T],), parts))
    with pytest.raises(ValueError, match=r"Bad.__init__ must be \(self, .*one\), got \(self\)"):
        bad[float]


def test_a_class_has_the_name_and_the_signature_of_its_definition():
    assert Power_[None].__name__ == "Power"
    assert str(inspect.signature(Power_[None])) == "(exponent: float)"
    with pytest.raises(TypeError, match="exponents"):
        Power_[None](exponents=2.0)  # pyright: ignore[reportCallIssue]
    with pytest.raises(RuntimeError, match=r"Other.* does not support scalar conversion"):
        type("Other", (Power_[None],), {})(2.0).ToAutoDiffXd()


@pytest.mark.parametrize(
    "name",
    ["EsdfCollision", "FlatnessController", "HypothesisSelector", "QuadrotorPlant", "StateToPose"],
)
def test_public_systems_are_templates_and_show_their_arguments(name):
    system, template = getattr(sp, name), getattr(sp, f"{name}_")
    assert template[None] is template[float] is system
    assert template[AutoDiffXd] is not system
    assert "args" not in inspect.signature(system).parameters


RNG = np.random.default_rng(2)
X = np.array([1.0, 2, 3, 0.5, -0.5, 0.2, *np.array([0.9, 0.1, -0.2, 0.3]) / 0.95**0.5, 0, 0, 0])
PLAN = [4.0, 1.0, 2.0, 3.0, *X[6:10], *RNG.normal(size=60), 2.0, 1.0]


@pytest.mark.parametrize(
    ("system", "inputs"),
    [
        (sp.VelocityTracker(), {"state": X, "velocity": [1.0, 0.0, 0.5]}),
        (sp.VelocityTracker(), {"state": X, "velocity": [9.0, -4.0, 1.0]}),
        (sp.HypothesisSelector(2), {"hypotheses": PLAN, "state": X}),
        (sp.HypothesisSelector(2), {"hypotheses": np.full(70, np.nan), "state": X}),
        (sp.StateToPose(), {"state": X}),
    ],
)
def test_derivatives_of_outputs_equal_differences(system, inputs):
    x, ends = np.concatenate([*inputs.values()]), np.cumsum([*map(len, inputs.values())])

    def evaluate(system, x):
        context = system.CreateDefaultContext()
        context.SetTime(4.03)
        for name, value in zip(inputs, np.split(x, ends[:-1]), strict=True):
            system.GetInputPort(name).FixValue(context, value)
        value = system.get_output_port().Eval(context)
        return value if isinstance(value, np.ndarray) else value @ np.array([1.0, -2.0, 0.5])

    dual = evaluate(system.ToAutoDiffXd(), InitializeAutoDiff(x).ravel())
    steps = 1e-6 * np.eye(len(x))
    differences = [evaluate(system, x + h) - evaluate(system, x - h) for h in steps]
    np.testing.assert_allclose(float_values(dual).ravel(), evaluate(system, x))
    np.testing.assert_allclose(ExtractGradient(dual), np.transpose(differences) / 2e-6, atol=1e-7)


def test_values_of_autodiff_numbers_keep_their_shape():
    x = np.arange(6.0).reshape(2, 3)
    dual = InitializeAutoDiff(x.ravel()).reshape(2, 3)
    assert is_autodiff(dual) and is_autodiff(dual[0, 0]) and not is_autodiff(x)
    np.testing.assert_array_equal(float_values(dual), x)
    assert float_values(dual[1, 2]) == 5.0 and float_values(x) is x


GAINS = ["Lookahead", "MinThrust", "MaxThrust", "MaxTilt", "TiltGain", "MaxTiltRate", "YawGain"]


@pytest.mark.parametrize(
    ("system", "names"),
    [
        (sp.QuadrotorPlant(), ["Drag", "RateTimeConstant", "Gravity"]),
        (sp.FlatnessController(), [*GAINS, "MaxYawRate", "YawSpeed", "Drag", "Gravity"]),
    ],
)
def test_setters_change_one_number_of_a_context(system, names):
    for name in names:
        context, default = system.CreateDefaultContext(), system.CreateDefaultContext()
        value = {"Lookahead": 0.75, "MaxThrust": 15.0, "TiltGain": 12.0}.get(name, 1.25)
        getattr(system, f"Set{name}")(context, value)
        changed = [
            (context.get_numeric_parameter(i).value() != default.get_numeric_parameter(i).value())
            for i in range(context.num_numeric_parameter_groups())
        ]
        assert np.concatenate(changed).sum() == 1
        with pytest.raises(ValueError, match=r"must be in .* got -1\.0"):
            getattr(system, f"Set{name}")(context, -1.0)
    if isinstance(system, sp.FlatnessController):
        context = system.CreateDefaultContext()
        with pytest.raises(ValueError, match=r"lookahead must be at least 2 / tilt_gain"):
            system.SetTiltGain(context, 1.0)
