"""The systems between a camera and a policy."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import VectorLogSink
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.sensing.color_noise import ColorNoise
from splatpilot.systems.sensing.delayed_pose import DelayedPose
from splatpilot.systems.sensing.depth_noise import DepthNoise
from splatpilot.systems.sensing.observation_noise import (
    ObservationNoise,
    image_generator,
    noisy_color,
    noisy_depth,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor_dynamics import hover_state
from splatpilot.systems.vehicle.quadrotor_plant import QuadrotorPlant

CAMERA = OnboardCamera(width=8, height=6)


def test_depth_noise_is_that_of_the_image_number():
    """At time k / rate the output is `noisy_depth` with the generator of image k."""
    noise = ObservationNoise(depth_multiplicative=0.1, depth_dropout=0.1)
    system = DepthNoise(noise, CAMERA, rate=15.0, seed=7)
    context = system.CreateDefaultContext()
    image = ImageDepth32F(8, 6)
    image.mutable_data[...] = 5.0
    system.get_input_port().FixValue(context, Value(image))
    for number in (3, 0, 3):
        context.SetTime(number / 15.0)
        seen = system.get_output_port().Eval(context).data[..., 0].copy()
        depth = np.full((6, 8), 5.0, dtype=np.float32)
        expected = noisy_depth(depth, noise, image_generator(7, number), 0.1, 20.0)
        np.testing.assert_array_equal(seen, expected)


def test_color_noise_is_that_of_the_image_number():
    """At time k / rate the output is `noisy_color` with the generator of image k, alpha kept."""
    noise = ObservationNoise(color_noise=0.1, brightness_jitter=0.2)
    system = ColorNoise(noise, CAMERA, rate=15.0, seed=7)
    context = system.CreateDefaultContext()
    image = ImageRgba8U(8, 6)
    image.mutable_data[...] = 90
    system.get_input_port().FixValue(context, Value(image))
    context.SetTime(2 / 15.0)
    seen = system.get_output_port().Eval(context).data
    color = np.full((6, 8, 3), 90, dtype=np.uint8)
    np.testing.assert_array_equal(seen[..., :3], noisy_color(color, noise, image_generator(7, 2)))
    assert np.all(seen[..., 3] == 90)


@pytest.mark.parametrize("latency", [0.0, 0.02, 0.1, 0.133])
def test_delayed_pose_is_the_pose_then(latency):
    """Along a falling, turning flight the output is the pose `latency` ago, to a fifth of a
    millimetre, and before that the first.
    """
    builder = DiagramBuilder()
    plant = builder.AddSystem(QuadrotorPlant())
    delayed = builder.AddSystem(DelayedPose(latency))
    builder.Connect(plant.GetOutputPort("state"), delayed.GetInputPort("state"))
    log = builder.AddSystem(VectorLogSink(13, publish_period=0.005))
    builder.Connect(plant.GetOutputPort("state"), log.get_input_port())
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    context = plant.GetMyMutableContextFromRoot(root)
    context.SetContinuousState(hover_state([0.0, 0.0, 5.0]))
    plant.GetInputPort("command").FixValue(context, [8.0, 0.5, 0.0, 1.0])
    simulator.get_mutable_integrator().set_maximum_step_size(0.005)
    for now in (0.0, 0.05, 0.2, 0.513, 1.0 / 3.0 + 0.5):
        simulator.AdvanceTo(now)
        X_WB = delayed.GetOutputPort("pose").Eval(delayed.GetMyContextFromRoot(root))
        data = log.FindLog(root)
        times, states = data.sample_times().copy(), data.data().copy()
        then = max(now - latency, 0.0)
        if then > times[-1]:
            continue
        expected = [np.interp(then, times, row) for row in states]
        np.testing.assert_allclose(X_WB.translation(), expected[:3], atol=2e-4)
        q_WB = X_WB.rotation().ToQuaternion().wxyz()
        np.testing.assert_allclose(q_WB, expected[6:10], atol=1e-3)


def test_bad_latency_is_named():
    """A negative latency is refused."""
    with pytest.raises(ValueError, match=r"latency is -0.1"):
        DelayedPose(-0.1)
