from types import SimpleNamespace

import numpy as np
import pytest
import torch
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from random_scenes import normal_tensor

from splatpilot.systems.sensing.latency import DelayedPose, FrameTimes
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.flatness import (
    FlatnessController,
    FlatnessControllerConfig,
    rotation_matrices,
)
from splatpilot.systems.vehicle.quadrotor import QuadrotorPlant, hover_state
from splatpilot.systems.vehicle.state import pose_from_state
from splatpilot.training.policies.ray_casting import PixelRays
from splatpilot.training.policies.rollouts import (
    DifferentiableRollout,
    FlightConditions,
    RolloutConfig,
    evaluate_agent,
    render_depth,
)
from splatpilot.training.policies.train_agile_autonomy import (
    AgileAutonomyTrainer,
    AgileAutonomyTraining,
)
from splatpilot.training.policies.training_worlds import WorldSelection, training_worlds
from splatpilot.training.policies.vehicles import BodyRate, History, PointMass, map_tensors

CONTROL = FlatnessControllerConfig()


def test_point_mass_solves_its_equation_exactly():
    p, v, a = (normal_tensor(seed, 5, 3).double() for seed in range(3))
    a.requires_grad_()
    start = PointMass(p, v, a, torch.zeros(5).double(), torch.full((5, 1), 0.13).double())
    a_cmd = torch.tensor([[3.0, -2.0, 1.0]], dtype=torch.float64)
    once, many = start.step(a_cmd, 0.2), start
    for _ in range(1000):
        many = many.step(a_cmd, 0.0002)
    for name in "pva":
        torch.testing.assert_close(getattr(once, name), getattr(many, name), rtol=0, atol=1e-10)
    # And the equation itself: the rate of the acceleration is its error over the lag.
    rate = (start.step(a_cmd, 1e-6).a - start.a) / 1e-6
    torch.testing.assert_close(rate, (a_cmd - start.a) / start.lag, rtol=1e-4, atol=1e-4)
    faded = start.decay_gradient(0.3)
    torch.testing.assert_close(faded.a, a)
    faded.a.sum().backward()
    torch.testing.assert_close(a.grad, torch.full((5, 3), 0.3).double())


def test_point_mass_turns_along_its_motion():
    zero = torch.zeros(1, 3)
    v, lag = torch.tensor([[0.0, 2.0, 0.0]]), torch.ones(1, 1)
    vehicle = PointMass(zero, v, zero, torch.zeros(1), lag)
    vehicle = vehicle.step(zero, 0.01)
    assert float(vehicle.yaw) == pytest.approx(0.01 * CONTROL.max_yaw_rate, rel=1e-3)
    for _ in range(300):
        vehicle = vehicle.step(zero, 0.01)
    assert float(vehicle.yaw) == pytest.approx(np.pi / 2, abs=1e-2)


def test_body_rate_vehicle_flies_as_plant_and_controller_do():
    a_WB = np.array([1.0, 0.8, 0.2])
    builder = DiagramBuilder()
    plant = builder.AddSystem(QuadrotorPlant())
    controller = builder.AddSystem(FlatnessController())
    source = builder.AddSystem(ConstantVectorSource(a_WB))
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("state"))
    builder.Connect(source.get_output_port(), controller.GetInputPort("acceleration"))
    builder.Connect(controller.GetOutputPort("command"), plant.GetInputPort("command"))
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    plant.GetMyMutableContextFromRoot(root).SetContinuousState(hover_state([0, 0, 2]))
    simulator.AdvanceTo(2.0)
    expected = np.array(plant.GetOutputPort("state").Eval(plant.GetMyContextFromRoot(root)))

    vehicle = BodyRate.hovering(torch.tensor([[0.0, 0.0, 2.0]]), torch.zeros(1))
    for _ in range(30):
        vehicle = vehicle.step(torch.tensor(a_WB, dtype=torch.float32)[None], 1 / 15)
    np.testing.assert_allclose(vehicle.p[0], expected[:3], atol=0.05)
    np.testing.assert_allclose(vehicle.v[0], expected[3:6], atol=0.05)
    R_WB = pose_from_state(vehicle.state[0].double().numpy()).rotation().matrix()
    np.testing.assert_allclose(rotation_matrices(vehicle.state[:, 6:10])[0], R_WB, atol=1e-5)


PERIOD = 1.0 / 15.0  # [s]
SELECTION = WorldSelection(kinds=["P02"], count=1, voxel_size=0.5)
TWO_STEPS = ObservationNoise(latency=2 * PERIOD)


STREAM = ObservationNoise(latency=0.05, frame_rate=[10.0, 30.0], jitter=0.04, frame_dropout=0.2)


@pytest.mark.parametrize(
    "noise", [*(ObservationNoise(latency=x) for x in (0.0, 0.05, PERIOD, 3 * PERIOD, 0.18)), STREAM]
)
def test_past_is_what_delayed_pose_gives(noise):
    times = FrameTimes.draw(noise, seed=3)
    states = np.cumsum(np.random.default_rng(0).normal(scale=0.1, size=(8, 13)), axis=0)
    states[:, 6] += 1.0
    builder = DiagramBuilder()
    wandering = PiecewisePolynomial.FirstOrderHold(PERIOD * np.arange(8), states.T)
    source = builder.AddSystem(TrajectorySource(wandering))
    system = builder.AddSystem(DelayedPose(times, PERIOD))
    builder.Connect(source.get_output_port(), system.GetInputPort("state"))
    simulator = Simulator(builder.Build())
    context = system.GetMyContextFromRoot(simulator.get_mutable_context())

    vehicles = [BodyRate(torch.tensor(state)[None], torch.zeros(1, 3)) for state in states]
    history = History.start(vehicles[0], noise, 1.0 / PERIOD, torch.Generator())
    times_of = times.delays, times.rate or 0.0, times.phase
    history = History(history.past, *(torch.tensor(np.array(x)).double()[None] for x in times_of))
    for step, vehicle in enumerate(vehicles):
        simulator.AdvanceTo(step * PERIOD)
        X_WB = system.GetOutputPort("pose").Eval(context)
        history = history.push(vehicle)
        now = torch.tensor([step * PERIOD], dtype=torch.float64)
        then = history.seen(noise, 1.0 / PERIOD, now)
        np.testing.assert_allclose(then.p[0], X_WB.translation(), atol=1e-9)
        np.testing.assert_allclose(then.attitude()[0], X_WB.rotation().matrix(), atol=1e-9)


def test_frames_have_their_ranges():
    hovering = BodyRate.hovering(torch.zeros(2000, 3), torch.zeros(2000))
    history = History.start(hovering, STREAM, 15.0, torch.Generator().manual_seed(0))
    rate, delays = history.frame_rate, history.delays
    assert rate.min() >= 10.0 and rate.max() <= 30.0
    assert float(rate.mean()) == pytest.approx(20.0, abs=0.5)
    came = delays.isfinite()
    assert float((~came).float().mean()) == pytest.approx(0.2, abs=0.005)
    assert delays.min() >= 0.05 and delays[came].max() <= 0.0901
    assert float(delays[came].mean()) == pytest.approx(0.07, abs=0.001)
    ages = torch.stack([history.ages(STREAM, torch.full((2000,), t / 7)) for t in range(99)])
    assert ages.min() >= 0.05
    assert (ages.max() * 15).ceil() < history.past.state.shape[1]


class Watcher:
    rate = 1.0 / PERIOD
    rays = PixelRays.of(16, 9, 90.0)

    def __init__(self) -> None:
        self.seen = []

    def initial_memory(self, count):
        return torch.zeros(count, 0)

    def decide(self, seen, memory):
        self.seen.append(seen)
        return 2.0 * seen.vehicle.attitude()[:, :, 0], None, memory

    def losses(self, transitions):
        return {"none": transitions.a.sum()}


def test_rollouts_and_evaluated_flights_have_late_images_and_the_current_state():
    def assert_seen(watcher, now: int, then: int, world, rows=slice(None)) -> None:
        vehicle = map_tensors(torch.Tensor.detach, watcher.seen[then].vehicle)
        expected = render_depth(vehicle, worlds.geometry, watcher.rays, world)
        torch.testing.assert_close(watcher.seen[now].depth[rows], expected[rows], rtol=0, atol=0)

    worlds, watcher = training_worlds(SELECTION, seed=0), Watcher()
    config = RolloutConfig(environments=6, steps=3, noise=TWO_STEPS)
    rollout = DifferentiableRollout(watcher, worlds, config, torch.Generator().manual_seed(0))
    rollout.episodes = rollout.episodes._replace(age=torch.zeros(6))
    rollout.losses()
    rollout.episodes = rollout.episodes._replace(age=torch.tensor([99.0, 0, 0, 0, 0, 0]))
    rollout.losses()
    world = rollout.episodes.world
    went_on = (watcher.seen[3].vehicle.p - watcher.seen[2].vehicle.p).norm(dim=1) < 1.0
    assert not went_on[0] and went_on.sum() >= 3
    for now, then in enumerate([0, 0, 0, 1, 2, 3]):
        assert_seen(watcher, now, then, world, went_on if now > 2 else slice(None))
    for now in (3, 4, 5):
        assert_seen(watcher, now, 3, world, slice(1))

    watcher = Watcher()
    evaluate_agent(watcher, worlds, FlightConditions(speeds=[2.0], patience=0.05), TWO_STEPS)
    assert len(watcher.seen) > 4
    for now, then in enumerate([0, 0, 0, 1, 2]):
        assert_seen(watcher, now, then, torch.arange(len(worlds)))


def test_imitation_has_late_images():
    selection = WorldSelection(kinds=["P02"], count=1, held_out=1, voxel_size=0.5)
    config = AgileAutonomyTraining(
        worlds=selection, environments=1, steps=6, ask_every=1, noise=TWO_STEPS
    )
    trainer = AgileAutonomyTrainer(config)
    trainer.begin_update(0)
    data, geometry = trainer.state_dict()["data"], training_worlds(selection, 0).geometry
    vehicle = SimpleNamespace(p=data["p_WB"], attitude=lambda: data["R_WB"])
    depth = render_depth(vehicle, geometry, trainer.agent.rays, torch.zeros(6).long())
    depth = depth[[0, 0, 0, 1, 2, 3]]
    torch.testing.assert_close(data["depth"], depth.half(), rtol=2e-3, atol=0)
