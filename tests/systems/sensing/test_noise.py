import math

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.policies.observations import pool_depth
from splatpilot.systems.sensing.latency import DelayedPose, FrameTimes
from splatpilot.systems.sensing.noise import (
    ColorNoise,
    DepthNoise,
    ObservationNoise,
    expose,
    image_generator,
    noisy_color,
    noisy_depth,
    turned_hue,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor import hover_state

DEPTH = np.full((200, 200), 4.0, dtype=np.float32)


def test_depth_errors_have_the_sizes_asked_for():
    noise = ObservationNoise(depth_multiplicative=0.03, depth_additive=0.05)
    errors = noisy_depth(DEPTH, noise, image_generator(0, 0), 0.1, 20.0) - 4.0
    sigma = np.hypot(0.03 * 4.0, 0.05)
    assert errors.std() == pytest.approx(sigma, rel=0.02)  # The estimate's own error is 0.35 %.
    assert abs(errors.mean()) < 4 * sigma / 200


def test_dropout_and_range():
    dropped = noisy_depth(DEPTH, ObservationNoise(depth_dropout=0.2), image_generator(1, 0), 0, 20)
    assert np.mean(dropped == np.inf) == pytest.approx(0.2, abs=0.01)
    assert set(np.unique(dropped)) == {4.0, np.inf}
    wide = noisy_depth(DEPTH, ObservationNoise(depth_additive=3.0), image_generator(2, 0), 1.0, 9.0)
    read = wide[np.isfinite(wide) & (wide > 0)]
    assert read.min() >= 1.0
    assert read.max() <= 9.0
    assert np.isinf(wide).any()
    assert (wide == 0).any()
    ends = np.array([[0.0, np.inf]], dtype=np.float32)
    noise = ObservationNoise(depth_multiplicative=0.5, depth_additive=0.5)
    np.testing.assert_array_equal(noisy_depth(ends, noise, image_generator(3, 0), 0.1, 20), ends)


def test_color_noise_and_brightness():
    color = np.full((100, 100, 3), 100, dtype=np.uint8)
    grain = noisy_color(color, ObservationNoise(color_noise=0.04), image_generator(0, 0))
    assert grain.std() == pytest.approx(0.04 * 255, rel=0.05)
    jitter = ObservationNoise(brightness_jitter=0.3)
    levels = [noisy_color(color, jitter, image_generator(0, k)) for k in range(50)]
    assert all(len(np.unique(level)) == 1 for level in levels)
    shades = np.array([level[0, 0, 0] for level in levels])
    assert 69 <= shades.min() < 80
    assert 120 < shades.max() <= 130
    bright = np.full((4, 4, 3), 250, dtype=np.uint8)
    assert (
        noisy_color(bright, ObservationNoise(color_noise=1.0), image_generator(0, 0)).max() == 255
    )


def test_hue_and_blur():
    red = np.full((4, 4, 3), [120, 60, 60], dtype=np.uint8)
    third = turned_hue(red.astype(float), math.cos(2 * math.pi / 3), math.sin(2 * math.pi / 3))
    np.testing.assert_allclose(third, np.broadcast_to([60, 120, 60], red.shape), atol=1e-9)
    noise, turns = ObservationNoise(hue_jitter=30.0), []
    for number in range(100):
        seen = noisy_color(red, noise, image_generator(0, number)).astype(float)
        assert (seen == seen[0, 0]).all() and abs(seen[0, 0].mean() - 80.0) < 1.0
        r, g, b = seen[0, 0]
        turns.append(math.degrees(math.atan2(math.sqrt(3.0) * (g - b), 2.0 * r - g - b)))
    assert -31.0 < min(turns) < -27.0 and 27.0 < max(turns) < 31.0
    gray = np.full((4, 4, 3), 100, dtype=np.uint8)
    np.testing.assert_array_equal(noisy_color(gray, noise, image_generator(0, 1)), gray)
    point = np.zeros((41, 41, 3), dtype=np.uint8)
    point[20, 20] = 255
    spread = noisy_color(point, ObservationNoise(blur=1.5), image_generator(0, 0))[..., 0]
    at = np.arange(41) - 20.0
    expected = 255 / (2 * math.pi * 1.5**2) * np.exp(-np.add.outer(at**2, at**2) / (2 * 1.5**2))
    np.testing.assert_allclose(spread, expected, atol=0.7)


def test_exposure():
    noise = ObservationNoise(exposure_error=1.0)
    gray, error = np.full((4, 4, 3), 100.0), 0.5
    light = (expose(gray, noise, error, np.zeros(gray.shape)) / 255) ** 2.2
    np.testing.assert_allclose(light, 2**0.5 * (100 / 255) ** 2.2, rtol=1e-9)
    assert (expose(np.full(3, 250.0), noise, 1.0, np.zeros(3)) == 255.0).all()
    factors = []
    for number in range(200):
        seen = noisy_color(gray.astype(np.uint8), noise, image_generator(1, number))
        assert len(np.unique(seen)) == 1
        factors.append((seen[0, 0, 0] / 100) ** 2.2)
    assert 0.5 <= min(factors) < 0.55 and 1.85 < max(factors) < 2.03


def test_photons_and_reading():
    noise = ObservationNoise(full_well=400.0, read_noise=6.0)
    photons = np.random.default_rng(0).standard_normal((400, 400, 3))
    for electrons in (100.0, 225.0, 300.0):
        color = np.full(photons.shape, 255 * (electrons / 400) ** (1 / 2.2))
        counted = 400 * (expose(color, noise, 0.0, photons) / 255) ** 2.2
        assert counted.mean() == pytest.approx(electrons, rel=2e-3)
        assert counted.std() == pytest.approx(np.sqrt(electrons + 36.0), rel=0.01)
    dark = 400 * (expose(np.zeros(photons.shape), noise, 0.0, photons) / 255) ** 2.2
    assert dark[dark > 0].std() == pytest.approx(6.0 * np.sqrt(1 - 2 / np.pi), rel=0.01)


def test_noise_is_a_function_of_seed_and_number():
    noise = ObservationNoise(depth_additive=0.1)
    images = [
        noisy_depth(DEPTH, noise, image_generator(*key), 0.1, 20.0)
        for key in ((3, 5), (3, 5), (3, 6), (4, 5))
    ]
    np.testing.assert_array_equal(images[0], images[1])
    assert np.any(images[0] != images[2])
    assert np.any(images[0] != images[3])


def test_no_noise_changes_nothing():
    none = ObservationNoise()
    assert not none.changes_depth
    assert not none.changes_color
    np.testing.assert_array_equal(noisy_depth(DEPTH, none, image_generator(0, 0), 0.1, 20), DEPTH)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("depth_dropout", 1.1),
        ("depth_additive", np.inf),
        ("latency", 1.5),
        ("color_noise", -0.1),
        ("exposure_error", 6.5),
        ("read_noise", 3.0),  # of how many electrons?
    ],
)
def test_bad_noise_is_named(field, value):
    with pytest.raises(ValueError, match=rf"ObservationNoise.{field} must be .*, got {value}"):
        ObservationNoise(**{field: value}).validate()


@pytest.mark.parametrize("rates", [[10.0], [30.0, 10.0], [0.0, 10.0]])
def test_rates_of_frames_are_a_range(rates):
    with pytest.raises(ValueError, match=r"frame_rate must be .* got \["):
        ObservationNoise(frame_rate=rates).validate()
    with pytest.raises(ValueError, match=r"jitter must be 0 without frame_rate, got 0\.1"):
        ObservationNoise(jitter=0.1).validate()
    ObservationNoise(frame_rate=[10.0, 10.0], jitter=0.1, frame_dropout=0.5).validate()


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
    image = ImageDepth32F(80, 60)
    image.mutable_data[...] = 5.0
    (seen,) = seen_at(
        DepthNoise(ObservationNoise(depth_dropout=0.1), CAMERA, RATE, seed=7), image, 0.2
    )
    assert set(np.unique(seen)) == {5.0, np.inf}
    assert np.mean(seen == np.inf) == pytest.approx(0.1, abs=0.018)  # four errors of the estimate
    np.testing.assert_array_equal(pool_depth(seen[..., 0], 15, 20), 5.0)


def test_color_noise_is_of_its_size():
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
    with pytest.raises(ValueError, match=r"delays of frames must be .* got -0.1"):
        DelayedPose(FrameTimes.late(-0.1))
