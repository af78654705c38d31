import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.symbolic import Evaluate, Expression, MakeVectorVariable, Variable
from pydrake.systems.analysis import Simulator
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from splatpilot.systems.common.drake import float_values
from splatpilot.systems.vehicle.quadrotor import (
    QuadrotorParams,
    QuadrotorPlant,
    hover_state,
    knows_natively,
    mix,
    quadrotor_derivatives,
    rk4_step,
    torques,
)
from splatpilot.systems.vehicle.vehicles import Kingfisher
from tests.systems.vehicle.responses import fly, respond

PARAMS = QuadrotorParams(drag=0.3, rate_time_constant=0.07, gravity=9.7)


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


@pytest.mark.parametrize("yaw", [-9.0, 0.0, 0.5, 3.0])
def test_hover_state_is_level_at_rest_and_faces_yaw(yaw):
    state = hover_state([1.0, 2.0, 3.0], yaw)
    np.testing.assert_array_equal(state[0:3], [1.0, 2.0, 3.0])
    forward = rotation_WB(state).as_matrix()[:, 0]
    np.testing.assert_allclose(forward, [math.cos(yaw), math.sin(yaw), 0.0], atol=1e-12)
    hover = quadrotor_derivatives(state, np.array([9.7, 0.0, 0.0, 0.0]), PARAMS)
    np.testing.assert_allclose(hover, 0.0, atol=1e-12)


def test_the_plant_agrees_with_rk4():
    commands, x = random_commands(np.random.default_rng(2), 20), hover_state([0.0, 0.0, 0.0])
    end = fly(QuadrotorPlant(), commands, 0.02)[-1]
    for command in np.repeat(commands, 5, axis=0):
        x = rk4_step(x, command, QuadrotorParams(), 0.02)
    assert np.linalg.norm(end[0:3] - x[0:3]) < 0.02
    assert np.linalg.norm(end[6:10]) == pytest.approx(1.0, abs=2e-4)


HOVER = [9.81, 0.0, 0.0, 0.0]
LAGS = QuadrotorParams(
    rotor_drag=[0.1, 0.2, 0.3],
    quadratic_drag=[0.01, 0.02, 0.03],
    yaw_time_ratio=3.0,
    motor_time_constant=0.04,
    max_thrust=25.0,
    max_tilt_rate=5.0,
    battery_sag=0.2,
    battery_charge=0.9,
    battery_endurance=300.0,
    ground_effect=0.5,
)
ROTORS = replace(LAGS, model="rotors", max_thrust=30.0)


def random_state(seed):
    state = random_states(np.random.default_rng(seed))
    state[2] = 2.0
    return state


def derivatives_at(plant, state, command=HOVER, context=None, **inputs):
    context = context or plant.CreateDefaultContext()
    whole = context.get_continuous_state_vector().CopyToVector()
    context.SetContinuousState(np.concatenate([state, whole[13:]]))
    for port, value in {"command": command, **inputs}.items():
        plant.GetInputPort(port).FixValue(context, value)
    return float_values(plant.EvalTimeDerivatives(context).CopyToVector())


PLANTS = [QuadrotorPlant(QuadrotorParams(drag=0.5))]
PLANTS.append(PLANTS[0].ToAutoDiffXd())


@pytest.mark.parametrize("plant", PLANTS)
def test_wind_moves_the_air_and_a_disturbance_accelerates(plant):
    for inputs, expected in (
        ({}, [0.0, 0.0, 0.0]),
        ({"wind": [3.0, -1.0, 2.0]}, [1.5, -0.5, 1.0]),
        ({"wind": [3.0, -1.0, 2.0], "disturbance": [0.0, 0.25, -1.0]}, [1.5, -0.25, 0.0]),
    ):
        found = derivatives_at(plant, hover_state([0.0, 0.0, 0.0]), **inputs)
        np.testing.assert_allclose(found[3:6], expected, atol=1e-12)


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize(("port", "size"), [("command", 4), ("wind", 3), ("disturbance", 3)])
def test_states_and_inputs_that_are_invalid_are_errors(plant, port, size):
    context, state = plant.CreateDefaultContext(), hover_state([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=rf"'{port}' of 'Quadrotor.* finite, got \[.*nan.*; check"):
        derivatives_at(plant, state, context=context, **{port: np.full(size, np.nan)})
    if isinstance(plant, QuadrotorPlant):  # with error control
        with pytest.raises(ValueError, match="must be finite"):
            Simulator(plant, context).AdvanceTo(0.1)
        with pytest.raises(ValueError, match=r"q_WB .* must not be zero, got \[0\.0, "):
            derivatives_at(plant, np.zeros(13))


def test_derivatives_by_a_parameter():
    plant = QuadrotorPlant().ToAutoDiffXd()
    context = plant.CreateDefaultContext()
    state = hover_state([0.0, 0.0, 0.0])
    state[3] = 2.0
    plant.SetDrag(context, AutoDiffXd(0.5, [1.0]))
    derivatives_at(plant, state, context=context)
    assert plant.EvalTimeDerivatives(context)[3].derivatives() == [-2.0]


def test_effects_that_are_neutral_leave_the_equations():
    params = QuadrotorParams(drag=0.3, rate_time_constant=0.07, max_thrust=1e6)
    assert not params.is_ideal() and QuadrotorParams(drag=0.3, radius=0.1).is_ideal()
    for seed in range(10):
        state, command = random_state(seed), np.array([12.0, 1.0, -2.0, 3.0])
        expected = quadrotor_derivatives(state, command, params)
        found = derivatives_at(QuadrotorPlant(params), state, command)
        np.testing.assert_allclose(found[:13], expected, atol=1e-12)


def test_drag_acts_along_the_body_axes_against_the_air():
    drags = {"rotor_drag": LAGS.rotor_drag, "quadratic_drag": LAGS.quadratic_drag}
    plant = QuadrotorPlant(QuadrotorParams(drag=0.0, **drags))
    wind, state = np.array([1.0, -2.0, 0.5]), random_state(1)
    R_WB = Rotation.from_quat(state[6:10], scalar_first=True)
    v_B = R_WB.inv().apply(state[3:6] - wind)
    drag_B = -(np.array([0.1, 0.2, 0.3]) + np.linalg.norm(v_B) * np.array([0.01, 0.02, 0.03])) * v_B
    expected = R_WB.apply(np.add(drag_B, [0.0, 0.0, 9.81])) - [0.0, 0.0, 9.81]
    found = derivatives_at(plant, state, wind=wind)
    np.testing.assert_allclose(found[3:6], expected, atol=1e-9)


def test_thrust_and_rates_lag_and_yaw_is_slower():
    params = QuadrotorParams(drag=0.0, motor_time_constant=0.04, yaw_time_ratio=3.0)
    times = np.array([0.02, 0.05, 0.1])
    states = respond(params, [12.0, 1.0, 0.0, 0.5], times)
    np.testing.assert_allclose(states[:, 10], 1.0 - np.exp(-times / 0.05), rtol=1e-6)
    np.testing.assert_allclose(states[:, 12], 0.5 - 0.5 * np.exp(-times / 0.15), rtol=1e-6)
    thrust = 12.0 - (12.0 - 9.81) * np.exp(-times / 0.04)
    np.testing.assert_allclose(states[:, 14], thrust, rtol=1e-6)


def test_commands_beyond_the_limits_are_clipped():
    limits = {"min_thrust": 5.0, "max_thrust": 15.0, "max_tilt_rate": 4.0, "max_yaw_rate": 1.0}
    plant = QuadrotorPlant(QuadrotorParams(**limits))
    state = hover_state([0.0, 0.0, 5.0])
    for command, thrust in (([40.0, 9.0, -9.0, 9.0], 15.0), ([0.0, 9.0, -9.0, 9.0], 5.0)):
        found = derivatives_at(plant, state, command)
        assert found[5] == pytest.approx(thrust - 9.81)
        np.testing.assert_allclose(0.05 * found[10:13], [4.0, -4.0, 1.0])


def test_a_battery_empties_by_hovering_and_takes_thrust():
    params = QuadrotorParams(battery_sag=0.3, battery_charge=0.5, battery_endurance=100.0)
    at_start = derivatives_at(QuadrotorPlant(params), hover_state([0.0, 0.0, 5.0]))
    lift = 1.0 - 0.3 * 0.5
    assert at_start[5] == pytest.approx(9.81 * (lift - 1.0))
    assert at_start[13] == pytest.approx(-(lift**1.5) / 100.0)
    steady = replace(params, battery_sag=0.0, battery_charge=1.0, thrust_scale=1.0)
    charge = respond(steady, HOVER, [50.0], step=0.02)[0, 13]
    assert charge == pytest.approx(0.5, rel=1e-6)


def test_thrust_scale_and_ground_effect_multiply_the_thrust():
    for scale, z in ((0.9, 0.5), (1.1, 2.0), (1.0, 0.25), (1.0, 0.1)):
        params = QuadrotorParams(thrust_scale=scale, ground_effect=0.5)
        found = derivatives_at(QuadrotorPlant(params), hover_state([0.0, 0.0, z]))
        factor = scale / (1.0 - (0.5 / (4.0 * max(z, 0.25))) ** 2)
        assert found[5] == pytest.approx(9.81 * (factor - 1.0))


def test_fast_rotors_follow_as_the_lags_do():
    rotors = QuadrotorParams(model="rotors", motor_time_constant=1e-4, max_thrust=60.0)
    command, times = [12.0, 0.5, -0.5, 0.1], [0.05, 0.2, 0.4]
    expected = respond(QuadrotorParams(max_thrust=60.0), command, times)
    found = respond(replace(rotors, motor_time_constant=2e-3), command, times)
    np.testing.assert_allclose(found[:, :13], expected[:, :13], atol=0.02)


forces = st.floats(-60.0, 60.0)


@given(thrust=forces, roll=forces, pitch=forces, yaw=forces)
def test_the_mixer_meets_what_rotors_can_and_gives_up_yaw_first(thrust, roll, pitch, yaw):
    params = Kingfisher()
    low, high = 0.0, 0.25 * params.mass * params.max_thrust
    torque = 0.1 * np.array([roll, pitch, 0.1 * yaw])
    found = np.array(mix(thrust, torque, params))
    assert (found >= low - 1e-9).all() and (found <= high + 1e-9).all()
    (x, y), kappa = params.arm, params.torque_ratio
    sides = np.array([[1, 1, 1, 1], [y, y, -y, -y], [-x, x, x, -x], [kappa, -kappa] * 2])
    np.testing.assert_allclose(torques(found, params), sides[1:] @ found, atol=1e-9)
    desired = np.linalg.solve(sides, [thrust, *torque])
    if (desired >= low).all() and (desired <= high).all():
        np.testing.assert_allclose(found, desired, atol=1e-9)
    tilt = np.linalg.solve(sides, [0.0, *torque[:2], 0.0])
    if np.ptp(tilt) < high - low:
        np.testing.assert_allclose((sides @ found)[1:3], torque[:2], atol=1e-9)
    without_yaw = np.linalg.solve(sides, [thrust, *torque[:2], 0.0])
    if (without_yaw >= low).all() and (without_yaw <= high).all():
        assert found.sum() == pytest.approx(thrust, abs=1e-9)


TURNING = {"model": "rotors", "max_thrust": 20.0}
IDEAL = QuadrotorParams(drag=0.2, rate_time_constant=0.1, gravity=3.7)


NATIVE = replace(LAGS, battery_sag=0.0, ground_effect=0.0)


@pytest.mark.parametrize("params", [IDEAL, LAGS, NATIVE, ROTORS, Kingfisher()])
def test_conversions_keep_the_equations(params):
    assert knows_natively(NATIVE) and not knows_natively(LAGS)
    plant = QuadrotorPlant(params)
    size = plant.num_continuous_states()
    rng, context = np.random.default_rng(3), plant.CreateDefaultContext()
    start = context.get_continuous_state_vector().CopyToVector()
    start[:13] = random_state(2)
    start[14:] *= rng.uniform(0.9, 1.1, max(size - 14, 0))
    x = np.concatenate([start, [11.0, 0.5, -1.0, 0.3], [1.0, -2.0, 0.5]])

    def evaluate(system, x):
        context = system.CreateDefaultContext()
        context.SetContinuousState(x[:size])
        system.get_input_port().FixValue(context, x[size : size + 4])
        if params is not IDEAL:  # whose native derivatives are of calm air
            system.GetInputPort("wind").FixValue(context, x[size + 4 :])
        acceleration = system.GetOutputPort("acceleration").Eval(context)
        return system.EvalTimeDerivatives(context).CopyToVector(), acceleration

    expected, acceleration = evaluate(plant, x)
    np.testing.assert_array_equal(acceleration, expected[3:6])
    variables = MakeVectorVariable(len(x), "x")
    symbolic, _ = evaluate(plant.ToSymbolic(), np.array([1.0 * each for each in variables]))
    values = Evaluate(symbolic, dict(zip(variables, x, strict=True))).ravel()
    np.testing.assert_allclose(values, expected, atol=1e-9)
    dual, _ = evaluate(plant.ToAutoDiffXd(), InitializeAutoDiff(x).ravel())
    np.testing.assert_allclose(ExtractValue(dual).ravel(), expected, atol=1e-12)
    steps = 1e-6 * np.maximum(1.0, np.abs(x))
    differences = [
        (evaluate(plant, x + h * e)[0] - evaluate(plant, x - h * e)[0]) / (2 * h)
        for h, e in zip(steps, np.eye(len(x)), strict=True)
    ]
    scale = 1e-6 * np.abs(ExtractGradient(dual)).max()
    np.testing.assert_allclose(ExtractGradient(dual), np.transpose(differences), atol=scale)


def test_numbers_and_lists_are_parameters_of_the_context():
    plant = QuadrotorPlant(Kingfisher())
    context, state = plant.CreateDefaultContext(), hover_state([0.0, 0.0, 5.0])
    state[3] = 2.0
    before = derivatives_at(plant, state, context=context)
    plant.SetParameter(context, "mass", 1.5)
    plant.SetParameter(context, "rotor_drag", [0.5, 0.0, 0.0])
    after = derivatives_at(plant, state, context=context)
    assert after[5] == pytest.approx(before[5] - 9.81 / 2)
    assert after[3] == pytest.approx(before[3] - 1.0)
    plant.SetParameter(context, "rotor_drag", np.array([0.4, 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"rotor_drag must be a list of numbers, got 0.1"):
        plant.SetParameter(context, "rotor_drag", 0.1)
    with pytest.raises(ValueError, match=r"motor_time_constant must be 0 only if it was, got 0"):
        plant.SetParameter(context, "motor_time_constant", 0.0)
    symbolic = QuadrotorPlant().ToSymbolic()
    context = symbolic.CreateDefaultContext()
    symbolic.SetDrag(context, Expression(Variable("drag")))
    assert str(context.get_numeric_parameter(0).value()[0]) == "drag"
    context = plant.CreateDefaultContext()
    with pytest.raises(ValueError, match=r"Kingfisher.mass must be in \(0, inf\) kg, got -1"):
        plant.SetParameter(context, "mass", -1.0)
    with pytest.raises(ValueError, match=r"name must be one of drag, .*, got model"):
        plant.SetParameter(context, "model", 1.0)


def test_a_plant_keeps_its_configuration():
    params = QuadrotorParams()
    plant, state = QuadrotorPlant(params), hover_state([0.0, 0.0, 5.0])
    state[3] = 1.0
    before = derivatives_at(plant, state)
    params.drag = 5.0
    np.testing.assert_array_equal(derivatives_at(plant, state), before)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"max_thrust": 12.0, "battery_sag": 0.4, "battery_charge": 0.3},
            r"max_thrust must be above 13.63 m/s\^2, to hover, got 12",
        ),
        ({"model": "rotors"}, "max_thrust must be finite .* with rotors, got inf"),
        (TURNING, "motor_time_constant must be above 0 s with rotors, got 0"),
        (TURNING | {"motor_time_constant": 0.2}, "rate_time_constant must be at least 0.1 s, half"),
    ],
)
def test_a_vehicle_that_cannot_fly_is_named_with_its_limit(fields, message):
    with pytest.raises(ValueError, match=f"QuadrotorParams.{message}"):
        QuadrotorPlant(QuadrotorParams(**fields))
