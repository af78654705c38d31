"""What lies between a policy and the world."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.flight.sensors import make_onboard_camera
from splatpilot.diagrams.flight.simulation import fly
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.sensing.imaging import Stereo
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.sensing.time_of_flight import equivalent_sensor, time_of_flight_grid
from splatpilot.systems.vehicle.state import pose_from_state


def states(world, **noise) -> np.ndarray:
    scenario = Scenario(
        timeout=1.5, policy=policy_named("reactive"), observation=ObservationNoise(**noise)
    )
    return fly(BuildFlightDiagram(scenario, world, camera=False)).states


def test_noise_and_latency_reach_the_policy_and_repeat(post_world):
    clean = states(post_world)
    for noise in ({"depth_multiplicative": 0.2}, {"latency": 0.2}):
        first, second = states(post_world, **noise), states(post_world, **noise)
        np.testing.assert_array_equal(first, second)
        assert np.any(first != clean)
    np.testing.assert_array_equal(states(post_world, color_noise=0.2), clean)


class Watcher(LeafSystem):
    """A policy that hovers and keeps what it saw last."""

    camera = OnboardCamera(width=64, height=36, fov_x=86.0, fov_y=48.375, min_depth=0.0)

    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorInputPort("depth_grid", 144)
        self.DeclareVectorOutputPort(
            "velocity", 3, lambda context, output: output.SetFromVector(np.zeros(3))
        )
        self.DeclareDiscreteState(144 + 13)
        self.DeclarePeriodicDiscreteUpdateEvent(0.5, 0.0, self._update)

    def _update(self, context, discrete_state) -> None:
        ports = (self.GetInputPort(name).Eval(context) for name in ("depth_grid", "state"))
        discrete_state.set_value(np.concatenate(list(ports)))


def test_grid_of_a_policy_is_that_of_its_cameras_images(post_world):
    scenario, policy = Scenario(timeout=1.0, start_radius=0.0), Watcher()
    diagram = BuildFlightDiagram(scenario, post_world, camera=False, policy=policy)
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    plant = diagram.GetSubsystemByName("plant")
    start = sample_initial_state(scenario, post_world)
    plant.GetMyMutableContextFromRoot(root).SetContinuousState(start)
    simulator.AdvanceTo(0.75)
    seen = policy.GetMyContextFromRoot(root).get_discrete_state_vector().value()
    grid, state = seen[:144].reshape(9, 16), seen[144:]
    np.testing.assert_allclose(state[:3], start[:3], atol=1e-3)
    camera = make_onboard_camera(Watcher.camera, post_world)
    context = camera.CreateDefaultContext()
    camera.GetInputPort("body_pose").FixValue(context, Value(pose_from_state(state)))
    image = camera.GetOutputPort("depth_image_32f").Eval(context)
    expected = time_of_flight_grid(
        np.asarray(image.data)[..., 0], equivalent_sensor(Watcher.camera)
    )
    np.testing.assert_allclose(grid, expected, atol=1e-12)
    assert 0.0 < grid.max() < 1.0


def test_frames_with_a_rate_reach_the_policy_and_repeat(post_world):
    stream = {"latency": 0.03, "frame_rate": [10.0, 30.0], "jitter": 0.03, "frame_dropout": 0.2}
    first, second = states(post_world, **stream), states(post_world, **stream)
    np.testing.assert_array_equal(first, second)
    assert np.any(first != states(post_world, latency=0.03))


def test_diagram_has_only_the_configured_systems(post_world):
    scenario = Scenario(policy=policy_named("reactive"))
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    names = {"depth_noise", "color_noise", "delayed_pose"}
    assert not [name for name in names if diagram.HasSubsystemNamed(name)]
    scenario.observation = ObservationNoise(depth_dropout=0.1, color_noise=0.1, latency=0.05)
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    assert {n for n in names if diagram.HasSubsystemNamed(n)} == {"depth_noise", "delayed_pose"}


@pytest.mark.parametrize("latency", [0.0, 0.1])
def test_rolling_shutter_starts_where_the_vehicle_was(post_world, latency):
    policy = policy_named("reactive")
    policy.camera = replace(policy.camera, readout=0.03)
    scenario = Scenario(policy=policy, observation=ObservationNoise(latency=latency), timeout=3.0)
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    plant = diagram.GetSubsystemByName("plant")
    start = sample_initial_state(scenario, post_world)
    plant.GetMyMutableContextFromRoot(root).SetContinuousState(start)
    camera, states = diagram.GetSubsystemByName("policy_camera"), {}
    for step in range(300):
        simulator.AdvanceTo(0.005 * (step + 1))
        states[step + 1] = np.array(diagram.GetOutputPort("state").Eval(root))
    context, now = camera.GetMyContextFromRoot(root), 300
    for port, ago in (("body_pose", latency), ("start_pose", latency + 0.03)):
        then = pose_from_state(states[now - round(ago / 0.005)])
        seen = camera.GetInputPort(port).Eval(context)
        assert np.abs(seen.translation() - then.translation()).max() < 2e-3
        assert (seen.rotation().inverse() @ then.rotation()).ToAngleAxis().angle() < 5e-3
    assert np.linalg.norm(states[now][3:6]) > 0.5


@pytest.mark.parametrize("policy", ["planner", "reactive", "diffaero_tof", "diffaero_rgb"])
def test_profiles_fly_every_policy_and_repeat(policy, post_world):
    scenario = load_config(
        Scenario(timeout=1.0, policy=policy_named(policy)), overrides=["profile=realistic"]
    )
    first, again = (
        fly(BuildFlightDiagram(scenario, post_world, camera=False)).states for _ in range(2)
    )
    np.testing.assert_array_equal(first, again)
    scenario.seed = 1
    assert np.any(
        fly(BuildFlightDiagram(scenario, post_world, camera=False)).states[-1] != first[-1]
    )


def test_matched_images_measure_the_depth_of_the_world():
    overrides = ["world.length=16", "world.spacing=2.4", "policy=!DiffAeroConfig {}"]
    scenario = load_config(Scenario(seed=3), overrides=overrides)
    world = make_world(scenario.world, scenario.seed)
    scenario.imaging.stereo = Stereo(matching=True)
    diagram = BuildFlightDiagram(scenario, world, camera=False)
    context = diagram.CreateDefaultContext()
    found = np.array(diagram.GetOutputPort("observation_depth_image_32f").Eval(context).data)
    camera = diagram.GetSubsystemByName("policy_camera")
    port = camera.GetOutputPort("depth_image_32f")
    true = np.array(port.Eval(camera.GetMyContextFromRoot(context)).data)
    near = np.isfinite(true) & (true < 6.0)
    matched = near & np.isfinite(found)
    assert near.mean() > 0.2 and matched.sum() > 0.9 * near.sum()
    # Half a pixel of disparity is 7 % at 3 m.
    assert np.median(np.abs(found[matched] / true[matched] - 1.0)) < 0.07


@pytest.mark.parametrize(
    "estimator",
    ["!MotionCapture {}", "!VisualInertial {}", "!InertialFilter {height: {max_range: 4.0}}"],
)
def test_policies_get_the_scenarios_estimate_and_collisions_the_truth(estimator, post_world):
    policy, states = policy_named("straight"), {}
    for text in (estimator, "{}"):
        scenario = load_config(
            Scenario(timeout=2.0, policy=policy, start_radius=0.0), overrides=[f"estimator={text}"]
        )
        diagram = BuildFlightDiagram(scenario, post_world, camera=False)
        states[text] = fly(diagram).states[:90]
        assert diagram.HasOutputPort("estimated_state") == (text != "{}")
    assert np.any(states[estimator] != states["{}"])
    np.testing.assert_allclose(states[estimator][-1, :3], states["{}"][-1, :3], atol=0.4)


class Climber(LeafSystem):
    """A policy that decides continually."""

    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorOutputPort(
            "velocity", 3, lambda context, output: output.SetFromVector([0.0, 0.0, 1.0])
        )


def test_a_continual_policy_has_no_decision_delay(post_world):
    scenario = Scenario(decision_delay=[0.0, 0.1])
    with pytest.raises(ValueError, match=r"decision_delay must be empty for a policy without"):
        BuildFlightDiagram(scenario, post_world, camera=False, policy=Climber())


def test_the_controller_has_its_own_rate(post_world):
    scenario = Scenario(timeout=0.5, policy=policy_named("straight"))
    scenario.controller.period = 0.002
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    controller = diagram.GetSubsystemByName("controller")
    update = controller.GetUniquePeriodicDiscreteUpdateAttribute()
    assert update is not None and update.period_sec() == 0.002
    fast = fly(diagram).states[-1, :3]
    scenario.controller.period = 0.02
    slow = fly(BuildFlightDiagram(scenario, post_world, camera=False)).states[-1, :3]
    assert 0.0 < np.linalg.norm(fast - slow) < 0.05
