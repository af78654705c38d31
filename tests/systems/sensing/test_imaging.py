import math

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.sensors import ImageRgba8U

from splatpilot.systems.sensing.imaging import (
    AutoExposure,
    Compression,
    Imaging,
    Stereo,
    TimeOfFlightErrors,
)
from splatpilot.systems.sensing.noise import color_of_light, light_of_color
from splatpilot.systems.sensing.onboard_camera import OnboardCamera, focal_length

CAMERA = OnboardCamera(width=32, height=18)
PERIOD = 0.02  # [s]


def picture(color: float | np.ndarray) -> ImageRgba8U:
    image = ImageRgba8U(CAMERA.width, CAMERA.height)
    image.mutable_data[..., :3], image.mutable_data[..., 3] = np.round(color), 255
    return image


class Scene(LeafSystem):
    """Outputs an image whose light is halved twice at 1 s."""

    def __init__(self, light: float) -> None:
        super().__init__()
        self._light = light
        self.DeclareAbstractOutputPort("color_image", lambda: Value(picture(0)), self._calc)

    def _calc(self, context, output) -> None:
        light = self._light * (0.25 if context.get_time() >= 1.0 else 1.0)
        output.set_value(picture(color_of_light(np.array(light))))


def gains(imaging: Imaging, light: float, *times: float) -> list[float]:
    builder = DiagramBuilder()
    scene = builder.AddSystem(Scene(light))
    exposure = builder.AddSystem(AutoExposure(imaging, CAMERA, PERIOD))
    builder.Connect(scene.get_output_port(), exposure.get_input_port())
    simulator = Simulator(builder.Build())
    context, found = simulator.get_mutable_context(), []
    simulator.Initialize()
    for time in times:
        simulator.AdvanceTo(time)
        state = exposure.GetMyContextFromRoot(context).get_discrete_state_vector()
        found.append(state.GetAtIndex(0))
    return found


@pytest.mark.parametrize("response", [0.1, 0.4])
def test_exposure_follows_light_with_its_time_constant(response):
    times = 0.5, 1.0 - 1e-6 + response, 1.0 - 1e-6 + 3 * response
    before, *after = gains(Imaging(exposure_response=response), 0.36, *times)
    assert before == pytest.approx(-1.0, abs=0.03)
    left = [(before + 2.0 - gain) / 2.0 for gain in after]
    assert left == pytest.approx([math.exp(-1.0), math.exp(-3.0)], abs=0.02)


def changed(system, color: float | np.ndarray) -> np.ndarray:
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, Value(picture(color)))
    return np.array(system.get_output_port().Eval(context).data)


def test_vignetting_follows_the_cosine_of_the_angle():
    seen = changed(AutoExposure(Imaging(vignetting=4.0), CAMERA, PERIOD), 200.0)[..., 0]
    x, y = CAMERA.ray_slopes()[..., 0], CAMERA.ray_slopes()[..., 1]
    expected = light_of_color(200.0) / (1.0 + x**2 + y**2) ** 2
    np.testing.assert_allclose(light_of_color(seen.astype(float)), expected, atol=4e-3)


def test_compression_costs_detail_by_its_quality():
    noise = np.random.default_rng(0).uniform(0, 255, (18, 32, 1)) * np.ones(3)
    errors = [
        np.abs(
            changed(Compression(Imaging(jpeg_quality=q), CAMERA, 15.0, 0), noise)[..., :3] - noise
        )
        for q in (95, 20)
    ]
    assert errors[0].mean() < 3.0 < errors[1].mean()


@pytest.mark.parametrize(("scale", "fov_x"), [(1.0, 90.0), (1.5, 67.38), (0.75, 106.26)])
def test_the_focal_length_changes_the_field_of_view(scale, fov_x):
    camera = Imaging(focal_scale=scale).camera(OnboardCamera(fov_x=90.0, fov_y=60.0))
    assert camera.fov_x == pytest.approx(fov_x, abs=0.01)
    assert camera.focal_x == pytest.approx(scale * focal_length(camera.width, 90.0))
    assert camera.focal_y == pytest.approx(scale * focal_length(camera.height, 60.0))


def test_depth_grids_come_from_time_of_flight_and_images_from_stereo():
    both = Imaging(stereo=Stereo(), time_of_flight=TimeOfFlightErrors())
    assert both.depth_sensor(is_grid=True) is both.time_of_flight
    assert both.depth_sensor(is_grid=False) is both.stereo
    assert Imaging(stereo=Stereo()).depth_sensor(is_grid=True) is None
