from pathlib import Path

import cv2
import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.sensors import ImageRgba8U

from splatpilot.systems.policies.base import Observation
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.systems.policies.diffaero_rgb import (
    DIFFAERO_RGB_NETWORK,
    DiffAeroRgb,
    DiffAeroRgbConfig,
    MonocularDepth,
    MonocularSpec,
    decide,
    encode_view,
    load_network,
    rays_B,
)
from splatpilot.systems.policies.recurrent_network import load_network as load_recurrent
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state

P_WG = np.array([12.0, 3.0, 2.0])


def random_weights(policy: dict[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
    rng, spec = np.random.default_rng(0), DIFFAERO_RGB_NETWORK
    shapes = {f"monocular.{k}": v for k, v in spec.monocular.weight_shapes().items()}
    if policy is None:
        shapes |= {f"policy.{k}": v for k, v in spec.policy.weight_shapes().items()}
    weights = {
        name: rng.normal(scale=0.5 / np.sqrt(np.prod(shape[1:])), size=shape).astype(np.float32)
        for name, shape in shapes.items()
    }
    return weights | {f"policy.{k}": v for k, v in (policy or {}).items()}


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("weights") / "diffaero_rgb.npz"
    PolicyCheckpoint("diffaero_rgb", DIFFAERO_RGB_NETWORK, random_weights(), {}).save(path)
    return str(path)


def observation(state: np.ndarray, color: np.ndarray) -> Observation:
    return Observation(0.0, pose_from_state(state), QuadrotorState.of(state), P_WG, color)


def test_decides_at_its_rate(file):
    config = DiffAeroRgbConfig(weights=file, speed=3.0)
    system, rng = DiffAeroRgb(config), np.random.default_rng(1)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    state = hover_state([1.0, 2.0, 1.5], yaw=0.6)
    state[3:6] = [1.0, 0.3, 0.1]
    image = ImageRgba8U(160, 90)
    image.mutable_data[...] = rng.integers(0, 256, (90, 160, 4))
    system.GetInputPort("state").FixValue(context, state)
    system.GetInputPort("goal").FixValue(context, P_WG)
    system.GetInputPort("color_image").FixValue(context, Value(image))
    simulator.Initialize()
    simulator.AdvanceTo(1.5 / config.rate)
    network, memory = load_network(file), load_recurrent(None, "diffaero", DIFFAERO_NETWORK)
    memory, expected = memory.initial_hidden(), np.zeros(3)
    for _ in range(2):
        seen = observation(state, np.asarray(image.data)[..., :3])
        expected, memory = decide(network, seen, 3.0, memory)
    found = system.GetOutputPort("acceleration").Eval(context)
    assert np.linalg.norm(expected) > 1e-3
    np.testing.assert_array_equal(found, expected)


def test_weights_and_cameras_that_do_not_fit_are_refused(file, tmp_path):
    with pytest.raises(FileNotFoundError, match="train them with: splatpilot train diffaero_rgb"):
        DiffAeroRgb(DiffAeroRgbConfig(weights=str(tmp_path / "absent.npz")))
    other = Path(__file__).parents[3] / "systems" / "policies" / "weights" / "diffaero.npz"
    with pytest.raises(ValueError, match="got 'diffaero'"):
        DiffAeroRgb(DiffAeroRgbConfig(weights=str(other)))
    weights = random_weights()
    weights["monocular.head.bias"] = np.full(2, np.nan, np.float32)
    broken = tmp_path / "broken.npz"
    PolicyCheckpoint("diffaero_rgb", DIFFAERO_RGB_NETWORK, weights, {}).save(broken)
    with pytest.raises(
        ValueError, match=r"broken\.npz: the weights monocular\.head\.bias must be finite"
    ):
        DiffAeroRgb(DiffAeroRgbConfig(weights=str(broken)))
    with pytest.raises(ValueError, match="got 64x48"):
        DiffAeroRgb(DiffAeroRgbConfig(weights=file, camera=OnboardCamera(width=64, height=48)))
    with pytest.raises(ValueError, match=r"fov_x must be 90 deg, got 80\.0"):
        camera = OnboardCamera(width=160, height=90, fov_x=80.0)
        DiffAeroRgb(DiffAeroRgbConfig(weights=file, camera=camera))
    with pytest.raises(ValueError, match=r"DiffAeroRgbConfig\.speed .* got 0\.0"):
        DiffAeroRgb(DiffAeroRgbConfig(weights=file, speed=0.0))


def test_rays_are_those_of_the_camera():
    camera = OnboardCamera(width=160, height=90)
    rays = rays_B()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=2), 1.0, atol=1e-6)
    rng = np.random.default_rng(0)
    for row, column in zip(rng.integers(0, 90, 9), rng.integers(0, 160, 9), strict=True):
        x, y, z = rays[row, column]
        u = camera.width / 2 - camera.focal_x * y / x
        v = camera.height / 2 - camera.focal_x * z / x
        assert (u, v) == pytest.approx((column + 0.5, row + 0.5), abs=1e-4)


@pytest.mark.parametrize("height", [90, 120])
def test_view_is_the_middle_of_the_image_with_rays_that_know_the_horizon(height):
    rng = np.random.default_rng(1)
    color = rng.integers(0, 256, (height, 160, 3)).astype(np.uint8)
    roll, pitch = 0.2, -0.3
    views = []
    for yaw in (0.0, 2.0):
        R_WB = RollPitchYaw(roll, pitch, yaw).ToRotationMatrix().matrix()
        views.append(encode_view(color, R_WB))
        np.testing.assert_allclose(views[-1][5], rays_B() @ R_WB[2], atol=1e-5)
    np.testing.assert_allclose(views[0], views[1], atol=1e-5)
    first = (height - 90) // 2
    shown = np.rint((views[0][:3] + 1.0) * 127.5).astype(np.uint8).transpose(1, 2, 0)
    np.testing.assert_array_equal(shown, color[first : first + 90])


def test_threads_of_opencv_change_no_bit():
    spec, rng = MonocularSpec(4, (1, 2), 6, (1, 4)), np.random.default_rng(0)
    shapes = spec.weight_shapes().items()
    network = MonocularDepth(spec, {k: rng.normal(size=v).astype(np.float32) for k, v in shapes})
    view = rng.uniform(-1.0, 1.0, (6, 90, 160)).astype(np.float32)
    threads, outputs = cv2.getNumThreads(), []
    try:
        for count in (1, 2, 3):
            cv2.setNumThreads(count)
            outputs.append(np.stack(network(view)))
    finally:
        cv2.setNumThreads(threads)
    assert all(np.array_equal(outputs[0], other) for other in outputs[1:])
