"""DiffAero in colours as a Drake system."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.sensors import ImageRgba8U

from splatpilot.systems.policies.base import Observation
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import (
    DIFFAERO_NETWORK,
    MAX_DEPTH,
    MIN_DEPTH,
)
from splatpilot.systems.policies.diffaero import decide as decide_by_grid
from splatpilot.systems.policies.diffaero_rgb import (
    DIFFAERO_RGB_NETWORK,
    DiffAeroRgb,
    DiffAeroRgbConfig,
    decide,
    encode_view,
    load_network,
)
from splatpilot.systems.policies.observations import inverse_depth
from splatpilot.systems.policies.recurrent_network import load_network as load_recurrent
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state

P_WG = np.array([12.0, 3.0, 2.0])


def random_weights(policy: dict[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
    """Of what sees, and of what decides unless that is given."""
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
    """Random weights."""
    path = tmp_path_factory.mktemp("weights") / "diffaero_rgb.npz"
    PolicyCheckpoint("diffaero_rgb", DIFFAERO_RGB_NETWORK, random_weights(), {}).save(path)
    return str(path)


def observation(state: np.ndarray, color: np.ndarray) -> Observation:
    return Observation(0.0, pose_from_state(state), QuadrotorState.of(state), P_WG, color)


def test_decides_at_its_rate(file):
    """The acceleration is that of the pure policy at the last multiple of the period, with the
    memory of the one before."""
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


def test_decides_as_diffaero_of_what_it_judges(tmp_path):
    """With DiffAero's weights it accelerates as DiffAero does at depths of what it judged."""
    policy = load_recurrent(None, "diffaero", DIFFAERO_NETWORK)
    shipped = PolicyCheckpoint.load(None, "diffaero", DIFFAERO_NETWORK).weights
    path = tmp_path / "weights.npz"
    weights = random_weights(dict(shipped))
    PolicyCheckpoint("diffaero_rgb", DIFFAERO_RGB_NETWORK, weights, {}).save(path)
    network = load_network(str(path))
    color = np.random.default_rng(3).integers(0, 256, (90, 160, 3)).astype(np.uint8)
    state = hover_state([1.0, 2.0, 1.5], yaw=0.3)
    seen, memory = observation(state, color), policy.initial_hidden()
    grid, log_error = network.monocular(encode_view(color, seen.X_WB.rotation().matrix()))
    found, _ = decide(network, seen, 2.0, memory)
    expected, _ = decide_by_grid(policy, grid, seen, 2.0, memory)
    assert grid.shape == log_error.shape == (9, 16)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert inverse_depth(np.array(MIN_DEPTH), MIN_DEPTH, MAX_DEPTH) == pytest.approx(9.4)


def test_weights_and_cameras_that_do_not_fit_are_refused(file, tmp_path):
    """Weights of another policy, of none or not finite, and a camera with another view are
    named."""
    with pytest.raises(FileNotFoundError, match="train them with: splatpilot train diffaero_rgb"):
        DiffAeroRgb(DiffAeroRgbConfig(weights=str(tmp_path / "absent.npz")))
    other = Path(__file__).parents[3] / "systems" / "policies" / "weights" / "diffaero.npz"
    with pytest.raises(ValueError, match="holds weights of the policy 'diffaero'"):
        DiffAeroRgb(DiffAeroRgbConfig(weights=str(other)))
    weights = random_weights()
    weights["monocular.head.bias"] = np.full(2, np.nan, np.float32)
    broken = tmp_path / "broken.npz"
    PolicyCheckpoint("diffaero_rgb", DIFFAERO_RGB_NETWORK, weights, {}).save(broken)
    with pytest.raises(ValueError, match=r"broken\.npz: the weights monocular\.head\.bias are not"):
        DiffAeroRgb(DiffAeroRgbConfig(weights=str(broken)))
    with pytest.raises(ValueError, match="got 64x48"):
        DiffAeroRgb(DiffAeroRgbConfig(weights=file, camera=OnboardCamera(width=64, height=48)))
    with pytest.raises(ValueError, match=r"fov_x must be 90 deg, got 80\.0"):
        camera = OnboardCamera(width=160, height=90, fov_x=80.0)
        DiffAeroRgb(DiffAeroRgbConfig(weights=file, camera=camera))
    with pytest.raises(ValueError, match=r"DiffAeroRgbConfig\.speed .* got 0\.0"):
        DiffAeroRgb(DiffAeroRgbConfig(weights=file, speed=0.0))
