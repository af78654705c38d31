import gc
import weakref

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.common.drake import (
    connect,
    input_port,
    optional_input,
    output_port,
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


def test_connected_ports_have_one_type_and_size():
    builder = DiagramBuilder()
    first, second = (builder.AddNamedSystem(name, Doubler()) for name in ("first", "second"))
    message = r"input 'value' of Doubler \(a vector of 1\) must .* 'text' of Doubler \(not a vector"
    with pytest.raises(ValueError, match=message):
        connect(builder, first.text_output_port(), second.value_input_port())
    connect(builder, first.double_output_port(), second.value_input_port())
    assert len(builder.Build().GetSystems()) == 2


class Camera(LeafSystem):
    def __init__(self) -> None:
        super().__init__()
        self.DeclareAbstractOutputPort(
            "image", lambda: Value(ImageDepth32F(64, 36)), lambda *_: None
        )


class Viewer(LeafSystem):
    def __init__(self, image) -> None:
        super().__init__()
        self.DeclareAbstractInputPort("image", Value(image))


@pytest.mark.parametrize(
    ("image", "name"),
    [(ImageDepth32F(10, 10), "ImageDepth32F of 10x10"), (ImageRgba8U(64, 36), "ImageRgba8U of")],
)
def test_connected_images_have_one_type_and_size(image, name):
    builder = DiagramBuilder()
    camera, viewer = builder.AddSystem(Camera()), builder.AddSystem(Viewer(image))
    message = rf"input 'image' of Viewer \({name}.* \(ImageDepth32F of 64x36\)"
    with pytest.raises(ValueError, match=message):
        connect(builder, camera.get_output_port(), viewer.get_input_port())


def test_images_of_size_zero_stand_for_any_size():
    builder = DiagramBuilder()
    camera, viewer = builder.AddSystem(Camera()), builder.AddSystem(Viewer(ImageDepth32F()))
    connect(builder, camera.get_output_port(), viewer.get_input_port())


def test_weak_callbacks_do_not_keep_their_system_alive():
    system = Doubler()
    assert system.text_output_port().Eval(system.CreateDefaultContext()) == "text"
    alive = weakref.ref(system)
    del system
    gc.collect()
    assert alive() is None
