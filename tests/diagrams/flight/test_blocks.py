"""What lies between a policy and the world."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.sensors import make_onboard_camera
from splatpilot.diagrams.flight.simulation import fly, make_flight_simulator
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.sensing.imaging import Stereo
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.sensing.time_of_flight import equivalent_sensor, time_of_flight_grid
from splatpilot.systems.vehicle.state import pose_from_state


def test_noise_and_latency_reach_the_policy_and_repeat(post_world):
    def states(**noise) -> np.ndarray:
        observation = ObservationNoise(**noise)
        scenario = Scenario(timeout=0.6, policy=policy_named("reactive"), observation=observation)
        diagram = BuildFlightDiagram(scenario, post_world, camera=False)
        systems = {"depth_noise": "depth_multiplicative", "delayed_pose": "latency"}
        for name in (*systems, "color_noise"):
            assert diagram.HasSubsystemNamed(name) == (systems.get(name) in noise)
        return fly(diagram).states

    clean, late = states(), states(latency=0.03)
    stream = {"frame_rate": [10.0, 30.0], "jitter": 0.03, "frame_dropout": 0.2}
    for noise, plain in (
        ({"depth_multiplicative": 0.2}, clean),
        ({"latency": 0.2}, clean),
        ({"latency": 0.03} | stream, late),
    ):
        first = states(**noise)
        np.testing.assert_array_equal(first, states(**noise))
        assert np.any(first != plain)
    np.testing.assert_array_equal(states(color_noise=0.2), clean)


def test_grid_of_a_policy_is_that_of_its_cameras_images(post_world):
    policy = policy_named("diffaero_tof")
    diagram = BuildFlightDiagram(Scenario(policy=policy), post_world, camera=False)
    root = diagram.CreateDefaultContext()
    grid = diagram.GetOutputPort("observation_depth_grid").Eval(root)
    camera = make_onboard_camera(policy.camera, post_world)
    context = camera.CreateDefaultContext()
    state = diagram.GetOutputPort("state").Eval(root)
    camera.GetInputPort("body_pose").FixValue(context, Value(pose_from_state(state)))
    depth = camera.GetOutputPort("depth_image_32f").Eval(context).data[..., 0]
    expected = time_of_flight_grid(np.asarray(depth), equivalent_sensor(policy.camera))
    np.testing.assert_allclose(grid, np.ravel(expected), atol=1e-12)
    assert 0.0 < grid.max() < 1.0


@pytest.mark.parametrize("latency", [0.0, 0.1])
def test_rolling_shutter_starts_where_the_vehicle_was(post_world, latency):
    policy = policy_named("reactive")
    policy.camera = replace(policy.camera, readout=0.03)
    scenario = Scenario(policy=policy, observation=ObservationNoise(latency=latency))
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    simulator, states = make_flight_simulator(diagram), []
    root = simulator.get_context()
    for step in range(201):
        simulator.AdvanceTo(0.005 * step)
        states.append(np.array(diagram.GetOutputPort("state").Eval(root)))
    camera = diagram.GetSubsystemByName("policy_camera")
    context = camera.GetMyContextFromRoot(root)
    for port, ago in (("body_pose", latency), ("start_pose", latency + 0.03)):
        then = pose_from_state(states[200 - round(ago / 0.005)])
        seen = camera.GetInputPort(port).Eval(context)
        assert np.abs(seen.translation() - then.translation()).max() < 2e-3
        assert (seen.rotation().inverse() @ then.rotation()).ToAngleAxis().angle() < 5e-3
    assert np.linalg.norm(states[-1][3:6]) > 0.5


@pytest.mark.parametrize("policy", ["planner", "diffaero_tof", "diffaero_rgb"])
def test_profiles_fly_every_policy_and_repeat(policy, post_world):
    scenario = load_config(
        Scenario(timeout=0.3, policy=policy_named(policy)), overrides=["profile=realistic"]
    )
    first, again, other = (
        fly(BuildFlightDiagram(replace(scenario, seed=k), post_world, camera=False)).states
        for k in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert np.any(other[-1] != first[-1])


def test_matched_images_measure_the_depth_of_the_world():
    overrides = ["world.length=12", "world.spacing=2.4", "policy=!DiffAeroConfig {}"]
    scenario = load_config(Scenario(seed=3), overrides=overrides)
    scenario.imaging.stereo = Stereo(matching=True)
    world = make_world(scenario.world, scenario.seed)
    diagram = BuildFlightDiagram(scenario, world, camera=False)
    context = diagram.CreateDefaultContext()
    camera = diagram.GetSubsystemByName("policy_camera")
    port = camera.GetOutputPort("depth_image_32f")
    true = np.array(port.Eval(camera.GetMyContextFromRoot(context)).data)
    found = np.array(diagram.GetOutputPort("observation_depth_image_32f").Eval(context).data)
    near = np.isfinite(true) & (true < 6.0)
    matched = near & np.isfinite(found)
    assert near.mean() > 0.2 and matched.sum() > 0.9 * near.sum()
    # Half a pixel of disparity is 7 % at 3 m.
    assert np.median(np.abs(found[matched] / true[matched] - 1.0)) < 0.07


def test_policies_get_the_scenarios_estimate(post_world):
    states = {}
    for estimator in (
        "{}",
        "!MotionCapture {}",
        "!VisualInertial {}",
        "!InertialFilter {height: {max_range: 4.0}}",
    ):
        scenario = Scenario(timeout=1.0, policy=policy_named("straight"), start_radius=0.0)
        scenario = load_config(scenario, overrides=[f"estimator={estimator}"])
        diagram = BuildFlightDiagram(scenario, post_world, camera=False)
        states[estimator] = fly(diagram).states
        assert diagram.HasOutputPort("estimated_state") == (estimator != "{}")
        assert np.any(states[estimator] != states["{}"]) == (estimator != "{}")
        np.testing.assert_allclose(states[estimator][-1, :3], states["{}"][-1, :3], atol=0.4)


def test_the_controller_has_its_own_rate(post_world):
    ends = []
    for period in (0.002, 0.02):
        scenario = Scenario(timeout=0.5, policy=policy_named("straight"))
        scenario.controller.period = period
        diagram = BuildFlightDiagram(scenario, post_world, camera=False)
        controller = diagram.GetSubsystemByName("controller")
        assert controller.GetUniquePeriodicDiscreteUpdateAttribute().period_sec() == period
        ends.append(fly(diagram).states[-1, :3])
    assert 0.0 < np.linalg.norm(np.subtract(*ends)) < 0.05
