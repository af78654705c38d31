import numpy as np
import pytest
import torch
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from random_scenes import normal_tensor

from splatpilot.systems.vehicle.flatness import (
    FlatnessController,
    FlatnessControllerConfig,
    rotation_matrices,
)
from splatpilot.systems.vehicle.quadrotor import QuadrotorPlant, hover_state
from splatpilot.systems.vehicle.state import pose_from_state
from splatpilot.training.policies.vehicles import BodyRate, PointMass

CONTROL = FlatnessControllerConfig()


def point_masses(count: int) -> PointMass:
    generator = torch.Generator().manual_seed(0)
    p, v, a = (normal_tensor(seed, count, 3).double() for seed in range(3))
    yaw = torch.rand(count, generator=generator, dtype=torch.float64)
    return PointMass(p, v, a, yaw, torch.full((count, 1), 0.13, dtype=torch.float64))


def test_point_mass_solves_its_equation_exactly():
    start, a_cmd = point_masses(5), torch.tensor([[3.0, -2.0, 1.0]], dtype=torch.float64)
    once = start.step(a_cmd, 0.2)
    many = start
    for _ in range(1000):
        many = many.step(a_cmd, 0.0002)
    for name in "pva":
        torch.testing.assert_close(getattr(once, name), getattr(many, name), rtol=0, atol=1e-10)
    # And the equation itself: the acceleration's rate is what it lacks over the lag.
    rate = (start.step(a_cmd, 1e-6).a - start.a) / 1e-6
    torch.testing.assert_close(rate, (a_cmd - start.a) / start.lag, rtol=1e-4, atol=1e-4)


def test_gradient_decay_scales_gradients_alone():
    a = torch.ones(1, 3, requires_grad=True)
    zero = torch.zeros(1, 3)
    vehicle = PointMass(zero, zero, a, torch.zeros(1), torch.full((1, 1), 0.1))
    faded = vehicle.decay_gradient(0.3)
    torch.testing.assert_close(faded.a, a)
    faded.a.sum().backward()
    torch.testing.assert_close(a.grad, torch.full((1, 3), 0.3))


def test_point_mass_turns_its_nose_along_its_motion():
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


def test_gradients_flow_through_the_body_rate_vehicle():

    def end(a: torch.Tensor) -> torch.Tensor:
        vehicle = BodyRate.hovering(torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1))
        vehicle = vehicle._replace(state=vehicle.state.double())
        for _ in range(6):
            vehicle = vehicle.step(a, 0.04)
        return vehicle.p[0, 0]

    a = torch.tensor([[1.0, 0.5, 0.3]], dtype=torch.float64, requires_grad=True)
    end(a).backward()
    step = torch.tensor([[1e-5, 0.0, 0.0]], dtype=torch.float64)
    with torch.no_grad():
        difference = (end(a + step) - end(a - step)) / 2e-5
    assert a.grad is not None
    assert float(a.grad[0, 0]) == pytest.approx(float(difference), rel=1e-4)
