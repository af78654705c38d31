"""The systems between a camera and a policy."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.policies.observations import pool_depth
from splatpilot.systems.sensing.latency import DelayedPose, FrameTimes
from splatpilot.systems.sensing.noise import ColorNoise, DepthNoise, ObservationNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor import hover_state

CAMERA = OnboardCamera(width=80, height=60, min_depth=1.0, max_depth=9.0)
RATE = 15.0  # [Hz]


def seen_at(system, image, *times: float) -> list[np.ndarray]:
    """What a system makes of an image at those times, one after the other."""
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, Value(image))
    images = []
    for time in times:
        context.SetTime(time)
        images.append(np.array(system.get_output_port().Eval(context).data))
    return images


def test_depth_noise_is_of_its_size_and_within_the_range():
    """Errors have the deviation asked for; what they take out of the camera's range reads 0 below
    it and infinity above."""
    image = ImageDepth32F(80, 60)
    image.mutable_data[:, :40] = 5.0
    image.mutable_data[:, 40:60] = 1.0
    image.mutable_data[:, 60:] = 9.0
    noise = ObservationNoise(depth_multiplicative=0.03, depth_additive=0.2)
    (seen,) = seen_at(DepthNoise(noise, CAMERA, RATE, seed=7), image, 0.2)
    middle, near, far = seen[:, :40, 0] - 5, seen[:, 40:60, 0], seen[:, 60:, 0]
    assert middle.std() == pytest.approx(0.25, rel=0.06)  # four errors of the estimate
    assert abs(middle.mean()) < 4 * 0.25 / 2400**0.5
    assert np.mean(near == 0) == pytest.approx(0.5, abs=0.06) and near[near > 0].min() >= 1.0
    assert np.mean(far == np.inf) == pytest.approx(0.5, abs=0.06)
    assert far[np.isfinite(far)].max() <= 9.0


def test_depth_dropout_is_of_its_rate():
    """A tenth of the pixels read infinity, the others what they read without noise; in the image
    that a policy pools they are no obstacle."""
    image = ImageDepth32F(80, 60)
    image.mutable_data[...] = 5.0
    (seen,) = seen_at(
        DepthNoise(ObservationNoise(depth_dropout=0.1), CAMERA, RATE, seed=7), image, 0.2
    )
    assert set(np.unique(seen)) == {5.0, np.inf}
    assert np.mean(seen == np.inf) == pytest.approx(0.1, abs=0.018)  # four errors of the estimate
    np.testing.assert_array_equal(pool_depth(seen[..., 0], 15, 20), 5.0)


def test_color_noise_is_of_its_size():
    """Pixels vary by the deviation asked for, and alpha not at all; brightness changes from image
    to image, for all pixels alike and within its limit."""
    image = ImageRgba8U(80, 60)
    image.mutable_data[..., :3] = 90
    image.mutable_data[..., 3] = np.arange(80)
    grain = ColorNoise(ObservationNoise(color_noise=0.1), CAMERA, RATE, seed=7)
    (seen,) = seen_at(grain, image, 0.2)
    assert seen[..., :3].std() == pytest.approx(25.5, rel=0.05)
    np.testing.assert_array_equal(seen[..., 3], image.data[..., 3])
    jitter = ColorNoise(ObservationNoise(brightness_jitter=0.2), CAMERA, RATE, seed=7)
    shades = [np.unique(a[..., :3]) for a in seen_at(jitter, image, *np.arange(50) / RATE)]
    assert all(len(shade) == 1 for shade in shades)
    assert 72 <= min(shades) < 78 and 102 < max(shades) <= 108


@pytest.mark.parametrize("system", [DepthNoise, ColorNoise])
def test_noise_is_that_of_seed_and_image_number(system):
    """Whoever looks again at the same image, also later, sees the same; another image or another
    seed has other noise. The number is the nearest whole one, whichever way the time rounds."""
    noise = ObservationNoise(depth_additive=0.1, color_noise=0.1)
    image = ImageDepth32F(80, 60) if system is DepthNoise else ImageRgba8U(80, 60)
    image.mutable_data[...] = 5 if system is DepthNoise else 90
    times = (3 / RATE, 0.0, 3 / RATE, np.nextafter(3 / RATE, 0), 3.3 / RATE, 4 / RATE)
    first, start, again, before, near, following = seen_at(
        system(noise, CAMERA, RATE, seed=7), image, *times
    )
    for same in (again, before, near):
        np.testing.assert_array_equal(first, same)
    (other,) = seen_at(system(noise, CAMERA, RATE, seed=8), image, 3 / RATE)
    for different in (start, following, other):
        assert np.mean(first[..., 0] != different[..., 0]) > 0.9


class Falling(LeafSystem):
    """The state of a vehicle that falls with 2 m/s^2 while it turns about z at 1 rad/s."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("state", 13, self._calc)

    def _calc(self, context, output) -> None:
        output.set_value(self.state(context.get_time()))

    @staticmethod
    def state(time: float) -> np.ndarray:
        state = hover_state([3 * time, 0.0, 5.0 - time**2], yaw=time)
        state[3:6] = [3.0, 0.0, -2 * time]
        return state


@pytest.mark.parametrize("latency", [0.0, 0.02, 0.1, 0.133])
def test_delayed_pose_is_the_pose_then(latency):
    """Along a falling, turning flight the output is the pose `latency` ago, and before that the
    first; samples 0.02 s apart leave an error of a tenth of a millimetre."""
    builder = DiagramBuilder()
    source = builder.AddSystem(Falling())
    delayed = builder.AddSystem(DelayedPose(FrameTimes.late(latency), period=0.02))
    builder.Connect(source.get_output_port(), delayed.GetInputPort("state"))
    simulator = Simulator(builder.Build())
    context = delayed.GetMyContextFromRoot(simulator.get_mutable_context())
    for now in (0.0, 0.01, 0.05, 0.2, 0.513, 1.0 / 3.0 + 0.5):
        simulator.AdvanceTo(now)
        X_WB = delayed.GetOutputPort("pose").Eval(context)
        expected = Falling.state(max(now - latency, 0.0))
        np.testing.assert_allclose(X_WB.translation(), expected[:3], atol=1.01e-4)
        q_WB = X_WB.rotation().ToQuaternion().wxyz()
        np.testing.assert_allclose(q_WB, expected[6:10], atol=2e-5)


def test_bad_latency_is_named():
    """A negative latency is refused."""
    with pytest.raises(ValueError, match=r"come -0.1 s late"):
        DelayedPose(FrameTimes.late(-0.1))
