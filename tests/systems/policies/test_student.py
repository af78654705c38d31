from pathlib import Path

import numpy as np
import pytest

from splatpilot.systems.policies.base import Observation, observation
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.policies.lattice import reference_trajectory
from splatpilot.systems.policies.student import (
    Student,
    StudentConfig,
    StudentDepthConfig,
    StudentNetwork,
    StudentRgbConfig,
    StudentSpec,
    load_network,
    mobilenet_blocks,
    mobilenet_shapes,
    plan,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor import hover_state

P_WG = np.array([12.0, 3.0, 2.0])
CONFIGS = {"rgb": StudentRgbConfig, "depth": StudentDepthConfig}
DEPTH = np.full((48, 64), 5.0, np.float32)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, str]:
    folder, rng = tmp_path_factory.mktemp("weights"), np.random.default_rng(0)
    paths = {name: str(folder / f"student_{name}.npz") for name in CONFIGS}
    for name, path in paths.items():
        spec = StudentSpec(name, 64, 48)
        weights = {
            key: rng.normal(scale=0.1, size=shape).astype(np.float32)
            for key, shape in spec.weight_shapes().items()
        }
        PolicyCheckpoint(f"student_{name}", spec, weights, {}).save(Path(path))
    return paths


def config_of(name: str, files: dict[str, str], **camera) -> StudentConfig:
    camera = OnboardCamera(**{"width": 64, "height": 48} | camera)
    return CONFIGS[name](weights=files[name], camera=camera)


def moving(p_WB, v_WB, yaw: float = 0.0) -> np.ndarray:
    state = hover_state(p_WB, yaw)
    state[3:6] = v_WB
    return state


def observe(state: np.ndarray, image: np.ndarray, p_WG=P_WG) -> Observation:
    return observation(0.0, state, np.array(p_WG), image)


def test_other_weights_and_cameras_are_refused(files):
    with pytest.raises(ValueError, match="in format 1, got 'student_rgb'"):
        Student(StudentDepthConfig(weights=files["rgb"]))
    with pytest.raises(ValueError, match=r"camera\.width of the student must be 64, got 160"):
        Student(StudentDepthConfig(weights=files["depth"]))
    with pytest.raises(ValueError, match=r"camera\.fov_x of the student must be 90.0, got 80"):
        Student(config_of("depth", files, fov_x=80.0))


@pytest.mark.parametrize("name", CONFIGS)
def test_plans_scale_with_the_speed(name, files):
    image = np.zeros((48, 64, 3), np.uint8) if name == "rgb" else DEPTH

    def hypotheses(speed: float) -> Hypotheses:
        v_WB = speed / StudentSpec.nominal_speed * np.array([1.2, -0.4, 0.0])
        state = moving([1.0, 2.0, 1.5], v_WB)
        return plan(load_network(files[name], name, speed), observe(state, image))

    expected, found = hypotheses(2.0), hypotheses(1.0)
    np.testing.assert_allclose(2.0 * found.waypoints_B, expected.waypoints_B, atol=1e-5)
    np.testing.assert_array_equal(found.costs, expected.costs)


def constant_network(output: float) -> StudentNetwork:
    spec = StudentSpec("depth", 64, 48, nominal_speed=2.6)
    weights = {name: np.zeros(shape, np.float32) for name, shape in spec.weight_shapes().items()}
    weights["head.bias"][:] = output
    return StudentNetwork(spec, weights)


@pytest.mark.parametrize(("distance", "scale"), [(0.0, 0.0), (0.5, 0.5), (1.0, 2.0), (5.0, 2.0)])
def test_deviations_fade_at_the_goal(distance, scale):
    goal_B, v_WB = np.array([0.6, 0.8, 0.0]) * distance, np.array([0.5, 0.0, 0.0])
    seen = observe(moving([1.0, 2.0, 1.5], v_WB), DEPTH, np.add(goal_B, [1.0, 2.0, 1.5]))
    found = plan(constant_network(0.1), seen).waypoints_B
    reference = reference_trajectory(v_WB, goal_B, np.array([0.0, 0.0, 1.0]), 2.6)
    np.testing.assert_allclose(found - reference, np.full((3, 10, 3), 0.1 * scale), atol=1e-5)


def corridor(low: int, high: int, distance: float) -> np.ndarray:
    """Renders depth (120, 160) [m] of a floor and a wall across the columns `low` to `high`."""
    below = np.arange(120) + 0.5 - 60.0
    floor = np.where(below > 0.0, 1.5 * 80.0 / np.maximum(below, 1e-3), np.inf)
    depth = np.repeat(floor[:, None], 160, axis=1)
    depth[:100, low:high] = np.minimum(depth[:100, low:high], distance)
    return np.where(depth > 20.0, np.inf, depth).astype(np.float32)


def test_shipped_depth_weights_avoid_walls():
    network = load_network("", "depth", 2.6)

    def end(depth: np.ndarray) -> np.ndarray:
        state = moving([0.0, 0.0, 1.5], [2.0, 0.0, 0.0])
        hypotheses = plan(network, observe(state, depth, [12.0, 0.0, 1.5]))
        return hypotheses.waypoints_B[hypotheses.best, -1]

    free, wall = end(corridor(0, 0, 2.0)), end(corridor(0, 160, 1.2))
    assert free[0] > 1.5 and abs(free[1]) < 0.4
    assert wall[0] < free[0] - 0.5
    assert end(corridor(0, 95, 2.0))[1] < -0.4 and end(corridor(65, 160, 2.0))[1] > 0.4


def test_shipped_rgb_weights_see_goals_and_trunks():
    network = load_network("", "rgb", 2.6)
    meadow = np.full((120, 160, 3), [150, 180, 220], np.uint8)
    meadow[60:] = 90, 110, 70
    trunk = meadow.copy()
    trunk[:, 60:100] = 60, 45, 30

    def waypoints_B(image: np.ndarray, p_WG: list[float]) -> np.ndarray:
        hypotheses = plan(network, observe(moving([0, 0, 1.5], [1.5, 0, 0]), image, p_WG))
        return hypotheses.waypoints_B[hypotheses.best]

    left, right = (waypoints_B(meadow, [2.0, y, 1.5]) for y in (2.0, -2.0))
    assert left[-1, 1] > 0.2 and right[-1, 1] < -0.2
    ahead = [4.0, 0.0, 1.5]
    assert np.abs(waypoints_B(trunk, ahead) - waypoints_B(meadow, ahead)).max() > 0.05


def test_encoder_has_the_published_shape():
    blocks = mobilenet_blocks()
    assert len(blocks) == 19 and sum(block[-1].skip > 0 for block in blocks) == 10
    # The encoder's part of the published 3.5 million, less one scale of batch norm per channel.
    assert sum(int(np.prod(shape)) for shape in mobilenet_shapes().values()) == 2_223_872 - 17_056
    assert np.prod([layer.stride for block in blocks for layer in block]) == 32
