"""Actuators, aerodynamics and battery of the plant, against their equations."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.symbolic import Evaluate, MakeVectorVariable
from scipy.spatial.transform import Rotation

from splatpilot.systems.vehicle.quadrotor import (
    QuadrotorParams,
    QuadrotorPlant,
    actuated_derivatives,
    hover_state,
    knows_natively,
    limit_command,
    mix,
    quadrotor_derivatives,
    torques,
)
from splatpilot.systems.vehicle.vehicles import Kingfisher
from tests.systems.vehicle.responses import respond

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


def random_state(seed, z=2.0):
    state = np.random.default_rng(seed).normal(size=13)
    state[6:10] /= np.linalg.norm(state[6:10])
    state[2] = z
    return state


def derivatives_at(plant, state, command=HOVER, wind=None):
    context = plant.CreateDefaultContext()
    whole = context.get_continuous_state_vector().CopyToVector()
    context.SetContinuousState(np.concatenate([state, whole[13:]]))
    plant.get_input_port().FixValue(context, command)
    if wind is not None:
        plant.GetInputPort("wind").FixValue(context, wind)
    return plant.EvalTimeDerivatives(context).CopyToVector()


def test_effects_that_are_neutral_leave_the_equations():
    params = QuadrotorParams(drag=0.3, rate_time_constant=0.07, max_thrust=1e6)
    assert not params.is_ideal() and QuadrotorParams(drag=0.3, radius=0.1).is_ideal()
    for seed in range(10):
        state, command = random_state(seed), np.array([12.0, 1.0, -2.0, 3.0])
        expected = quadrotor_derivatives(state, command, params)
        found = derivatives_at(QuadrotorPlant(params), state, command)
        np.testing.assert_allclose(found[:13], expected, atol=1e-12)


def test_drag_acts_along_the_body_axes_against_the_air():
    plant = QuadrotorPlant(QuadrotorParams(drag=0.0, **drags()))
    wind, state = np.array([1.0, -2.0, 0.5]), random_state(1)
    R_WB = Rotation.from_quat(state[6:10], scalar_first=True)
    v_B = R_WB.inv().apply(state[3:6] - wind)
    drag_B = -(np.array([0.1, 0.2, 0.3]) + np.linalg.norm(v_B) * np.array([0.01, 0.02, 0.03])) * v_B
    expected = R_WB.apply(np.add(drag_B, [0.0, 0.0, 9.81])) - [0.0, 0.0, 9.81]
    found = derivatives_at(plant, state, wind=wind)
    np.testing.assert_allclose(found[3:6], expected, atol=1e-9)


def drags():
    return {"rotor_drag": LAGS.rotor_drag, "quadratic_drag": LAGS.quadratic_drag}


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
    charge = respond(steady, HOVER, [50.0])[0, 13]
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


@pytest.mark.parametrize("params", [LAGS, ROTORS, Kingfisher()], ids=["lags", "rotors", "preset"])
def test_conversions_keep_the_equations(params):
    plant = QuadrotorPlant(params)
    size = plant.num_continuous_states()
    rng, context = np.random.default_rng(3), plant.CreateDefaultContext()
    start = context.get_continuous_state_vector().CopyToVector()
    start[:13] = random_state(2)
    start[14:] *= rng.uniform(0.9, 1.1, size - 14)
    x = np.concatenate([start, [11.0, 0.5, -1.0, 0.3]])

    def evaluate(system, x):
        context = system.CreateDefaultContext()
        context.SetContinuousState(x[:size])
        system.get_input_port().FixValue(context, x[size:])
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


def test_native_derivatives_are_those_of_the_equations():
    params = replace(LAGS, battery_sag=0.0, ground_effect=0.0)
    plant, wind, command = QuadrotorPlant(params), [1.0, -2.0, 0.5], [30.0, 9.0, -1.0, 0.3]
    whole = plant.CreateDefaultContext().get_continuous_state_vector().CopyToVector()
    assert knows_natively(params)
    for seed in range(5):
        state = random_state(seed)
        found = derivatives_at(plant, state, command, wind)
        expected = actuated_derivatives(
            [*state, *whole[13:]], limit_command(command, params), params, wind
        )
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)


def test_numbers_and_lists_are_parameters_of_the_context():
    plant = QuadrotorPlant(Kingfisher())
    context = plant.CreateDefaultContext()
    plant.get_input_port().FixValue(context, HOVER)
    state = hover_state([0.0, 0.0, 5.0])
    state[3] = 2.0
    context.SetContinuousState([*state, *context.get_continuous_state_vector().CopyToVector()[13:]])
    before = plant.EvalTimeDerivatives(context).CopyToVector()
    plant.SetParameter(context, "mass", 1.5)
    plant.SetParameter(context, "rotor_drag", [0.5, 0.0, 0.0])
    after = plant.EvalTimeDerivatives(context).CopyToVector()
    assert after[5] == pytest.approx(before[5] - 9.81 / 2)
    assert after[3] == pytest.approx(before[3] - 1.0)
    with pytest.raises(ValueError, match=r"Kingfisher.mass must be in \(0, inf\) kg, got -1"):
        plant.SetParameter(context, "mass", -1.0)
    with pytest.raises(ValueError, match=r"name must be one of drag, .*, got model"):
        plant.SetParameter(context, "model", 1.0)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"max_thrust": 9.0}, r"max_thrust must be above 9.81 m/s\^2, to hover, got 9"),
        (
            {"max_thrust": 12.0, "battery_sag": 0.4, "battery_charge": 0.3},
            r"max_thrust must be above 13.63 m/s\^2, to hover, got 12",
        ),
        ({"min_thrust": 10.0}, r"min_thrust must be below 9.81 m/s\^2, to hover, got 10"),
        ({"model": "rotors"}, "max_thrust must be finite .* with rotors, got inf"),
        (
            {"model": "rotors", "max_thrust": 20.0},
            "motor_time_constant must be above 0 s with rotors, got 0",
        ),
        (
            {"model": "rotors", "max_thrust": 20.0, "motor_time_constant": 0.2},
            "rate_time_constant must be at least 0.1 s, half of .*, got 0.05",
        ),
        ({"inertia": [1.0, 0.0, 1.0]}, r"inertia must be in \(0, inf\) kg m\^2"),
        ({"arm": [0.1]}, "arm must be 2 numbers, got"),
        ({"rotor_drag": [0.1]}, "rotor_drag must be 3 numbers, got"),
        ({"model": "motors"}, r"model must be in \{lags, rotors\}, got motors"),
        ({"radius": math.inf}, r"radius must be in \(0, 1\] m, got inf"),
    ],
)
def test_a_vehicle_that_cannot_fly_is_named_with_its_limit(fields, message):
    with pytest.raises(ValueError, match=f"QuadrotorParams.{message}"):
        QuadrotorPlant(QuadrotorParams(**fields))
