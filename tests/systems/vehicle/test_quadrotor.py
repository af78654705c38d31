import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from splatpilot.systems.vehicle.quadrotor import (
    QuadrotorParams,
    QuadrotorPlant,
    hover_state,
    quadrotor_derivatives,
    rk4_step,
)

PARAMS = QuadrotorParams(drag=0.3, rate_time_constant=0.07, gravity=9.7)
PERIOD = 0.02  # [s] of the commands and of the integration


def random_states(rng, *shape):
    state = rng.normal(size=(*shape, 13))
    state[..., 6:10] /= np.linalg.norm(state[..., 6:10], axis=-1, keepdims=True)
    return state


def random_commands(rng, *shape):
    return rng.uniform([0, -6, -6, -6], [20, 6, 6, 6], size=(*shape, 4))


def rotation_WB(state):
    return Rotation.from_quat(state[..., 6:10], scalar_first=True)


def test_equations_match_a_vector_formulation():
    rng = np.random.default_rng(0)
    for state, command in zip(random_states(rng, 20), random_commands(rng, 20), strict=True):
        derivatives = quadrotor_derivatives(state, command, PARAMS)
        v_WB, w_WB_B, R_WB = state[3:6], state[10:13], rotation_WB(state)
        z_B = R_WB.apply([0.0, 0.0, 1.0])
        a_WB = command[0] * z_B - [0.0, 0.0, 9.7] - 0.3 * v_WB
        # The attitude around a short rotation, by the exponential map.
        h = 1e-6
        after, before = (
            (R_WB * Rotation.from_rotvec(dt * w_WB_B)).as_quat(scalar_first=True) for dt in (h, -h)
        )
        after *= np.sign(after @ state[6:10])
        before *= np.sign(before @ state[6:10])
        np.testing.assert_allclose(derivatives[0:3], v_WB)
        np.testing.assert_allclose(derivatives[3:6], a_WB, atol=1e-12)
        np.testing.assert_allclose(derivatives[6:10], (after - before) / (2 * h), atol=1e-8)
        np.testing.assert_allclose(derivatives[10:13], (command[1:] - w_WB_B) / 0.07)


@pytest.mark.parametrize("scale", [0.8, 1.2])
def test_quaternion_length_pulls_to_one_and_does_not_change_the_thrust(scale):
    rng = np.random.default_rng(2)
    state, command = random_states(rng), random_commands(rng)
    scaled = state.copy()
    scaled[6:10] *= scale
    derivatives = quadrotor_derivatives(scaled, command, PARAMS)
    expected = quadrotor_derivatives(state, command, PARAMS)
    np.testing.assert_allclose(derivatives[3:6], expected[3:6], atol=1e-12)
    growth = scaled[6:10] @ derivatives[6:10] / scale**2
    np.testing.assert_allclose(growth, 5.0 * (1.0 - scale**2))


@pytest.mark.parametrize("make", [np.asarray, torch.as_tensor], ids=["numpy", "torch"])
def test_batches_equal_single_states_and_broadcast(make):
    rng = np.random.default_rng(3)
    states, commands = random_states(rng, 3, 4), random_commands(rng, 4)
    batch = np.asarray(rk4_step(make(states), make(commands), PARAMS, 0.02))
    assert batch.shape == (3, 4, 13)
    single = rk4_step(make(np.float32(states)), make(np.float32(commands)), PARAMS, 0.02)
    assert np.asarray(single).dtype == np.float32
    for i, j in np.ndindex(3, 4):
        single = rk4_step(states[i, j], commands[j], PARAMS, 0.02)
        np.testing.assert_allclose(batch[i, j], single, rtol=0, atol=1e-13)


def test_gradients_of_a_step_by_torch_autodiff_and_differences_agree():
    rng = np.random.default_rng(5)
    x = np.concatenate([random_states(rng), random_commands(rng)])

    def step(x):
        return rk4_step(x[:13], x[13:], PARAMS, 0.05)

    by_torch = torch.autograd.functional.jacobian(step, torch.tensor(x)).numpy()
    y = step(InitializeAutoDiff(x).ravel())
    h = 1e-6
    by_difference = np.column_stack(
        [(step(x + h * e) - step(x - h * e)) / (2 * h) for e in np.eye(17)]
    )
    np.testing.assert_allclose(ExtractValue(y).ravel(), step(x), atol=1e-14)
    np.testing.assert_allclose(by_torch, ExtractGradient(y), atol=1e-12)
    np.testing.assert_allclose(by_torch, by_difference, atol=1e-8)


def test_rk4_step_has_fourth_order():
    rng = np.random.default_rng(6)
    state, command = random_states(rng), random_commands(rng)

    def derivatives(t, x):
        return quadrotor_derivatives(x, command, PARAMS)

    tight = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}
    exact = solve_ivp(derivatives, (0.0, 0.4), state, **tight).y[:, -1]

    def error(steps):
        x = state
        for _ in range(steps):
            x = rk4_step(x, command, PARAMS, 0.4 / steps)
        return np.linalg.norm(x - exact)

    assert math.log2(error(20) / error(40)) == pytest.approx(4.0, abs=0.3)


@given(yaw=st.floats(-10, 10), x=st.floats(-5, 5))
def test_hover_state_is_level_at_rest_and_faces_yaw(yaw, x):
    state = hover_state([x, 2.0, 3.0], yaw)
    np.testing.assert_array_equal(state[0:3], [x, 2.0, 3.0])
    forward = rotation_WB(state).as_matrix()[:, 0]
    np.testing.assert_allclose(forward, [math.cos(yaw), math.sin(yaw), 0.0], atol=1e-12)
    hover = quadrotor_derivatives(state, np.array([9.7, 0.0, 0.0, 0.0]), PARAMS)
    np.testing.assert_allclose(hover, 0.0, atol=1e-12)


def test_the_plant_agrees_with_rk4():
    plant, x = QuadrotorPlant(), hover_state([0.0, 0.0, 0.0])
    simulator = Simulator(plant)
    ResetIntegratorFromFlags(simulator, "runge_kutta3", PERIOD)
    simulator.get_mutable_integrator().set_fixed_step_mode(True)
    context = simulator.get_mutable_context()
    for k, command in enumerate(random_commands(np.random.default_rng(2), 250)):
        plant.get_input_port().FixValue(context, command)
        simulator.AdvanceTo((k + 1) * PERIOD)
        x = rk4_step(x, command, QuadrotorParams(), PERIOD)
    end = context.get_continuous_state_vector().CopyToVector()
    assert np.linalg.norm(end[0:3] - x[0:3]) < 0.02
    assert np.linalg.norm(end[6:10]) == pytest.approx(1.0, abs=2e-4)


def test_ports_and_parameters_have_their_documented_names_and_order():
    plant = QuadrotorPlant(QuadrotorParams(drag=0.1, rate_time_constant=0.2, gravity=3.7))
    context = plant.CreateDefaultContext()
    np.testing.assert_array_equal(context.get_numeric_parameter(0).CopyToVector(), [0.1, 0.2, 3.7])
    state = np.arange(1.0, 14.0)
    context.SetContinuousState(state)
    np.testing.assert_array_equal(plant.GetOutputPort("state").Eval(context), state)
    assert plant.GetInputPort("command").size() == 4
    assert not plant.HasDirectFeedthrough(output_port=0)


def derivatives_at(plant, x):
    """Time derivatives at a state (13) and a command (4)."""
    context = plant.CreateDefaultContext()
    context.SetContinuousState(x[:13])
    plant.get_input_port().FixValue(context, x[13:])
    return plant.EvalTimeDerivatives(context).CopyToVector()


def test_a_zero_quaternion_is_an_error_that_names_it():
    with pytest.raises(ValueError, match=r"q_WB .* must not be zero, got \[0\.0, "):
        derivatives_at(QuadrotorPlant(), np.zeros(17))


@pytest.mark.parametrize("convert", [lambda plant: plant, lambda plant: plant.ToAutoDiffXd()])
def test_wind_moves_the_air_and_a_disturbance_accelerates(convert):
    plant = convert(QuadrotorPlant(QuadrotorParams(drag=0.5)))
    context = plant.CreateDefaultContext()
    plant.get_input_port().FixValue(context, [9.81, 0.0, 0.0, 0.0])

    def acceleration():
        derivatives = plant.EvalTimeDerivatives(context).CopyToVector()
        return np.float64([x if isinstance(x, float) else x.value() for x in derivatives[3:6]])

    np.testing.assert_allclose(acceleration(), 0.0, atol=1e-12)
    plant.GetInputPort("wind").FixValue(context, [3.0, -1.0, 2.0])
    np.testing.assert_allclose(acceleration(), [1.5, -0.5, 1.0], atol=1e-12)
    plant.GetInputPort("disturbance").FixValue(context, [0.0, 0.25, -1.0])
    np.testing.assert_allclose(acceleration(), [1.5, -0.25, 0.0], atol=1e-12)


@pytest.mark.parametrize("convert", [lambda plant: plant, lambda plant: plant.ToAutoDiffXd()])
@pytest.mark.parametrize("port", ["command", "wind", "disturbance"])
def test_an_input_that_is_not_finite_is_an_error_with_error_control(convert, port):
    plant = convert(QuadrotorPlant())
    context = plant.CreateDefaultContext()
    plant.get_input_port().FixValue(context, [9.81, 0.0, 0.0, 0.0])
    plant.GetInputPort(port).FixValue(context, np.full(plant.GetInputPort(port).size(), np.nan))
    with pytest.raises(ValueError, match=rf"'{port}' of 'Quadrotor.* finite, got \[.*nan.*; check"):
        plant.EvalTimeDerivatives(context)
    if isinstance(plant, QuadrotorPlant):
        with pytest.raises(ValueError, match="must be finite"):
            Simulator(plant, context).AdvanceTo(0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("x",), "params must be of type QuadrotorParams, got a str"),
        ((None, np.zeros(13)), r"q_WB must be a rotation .* got \[0\.0, 0\.0, 0\.0, 0\.0\]"),
        ((None, np.zeros(12)), "initial_state must be 13 finite numbers"),
        ((None, np.full(13, np.nan)), "initial_state must be 13 finite numbers"),
    ],
)
def test_wrong_arguments_are_named_at_construction(arguments, message):
    with pytest.raises(ValueError, match=message):
        QuadrotorPlant(*arguments)


def test_derivatives_by_a_parameter():
    plant = QuadrotorPlant().ToAutoDiffXd()
    context = plant.CreateDefaultContext()
    state = hover_state([0.0, 0.0, 0.0])
    state[3] = 2.0
    context.SetContinuousState(state)
    plant.get_input_port().FixValue(context, [9.81, 0.0, 0.0, 0.0])
    plant.SetDrag(context, AutoDiffXd(0.5, [1.0]))
    assert plant.EvalTimeDerivatives(context)[3].derivatives() == [-2.0]
