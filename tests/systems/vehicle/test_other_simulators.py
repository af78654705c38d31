"""Compares vehicles with rotors to those of rotorpy and crazyflow, over 5 s of random commands."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rotorpy.vehicles.multirotor import Multirotor
from scipy.integrate import solve_ivp

from splatpilot.systems.vehicle.quadrotor import QuadrotorPlant, hover_state
from splatpilot.systems.vehicle.vehicles import Crazyflie21Brushless, Kingfisher
from tests.systems.vehicle.responses import fly

HOLD = 0.1  # [s] of each command
KINGFISHER = Kingfisher(drag=0.0, rotor_drag=[0.0] * 3, max_tilt_rate=np.inf, max_yaw_rate=np.inf)
SIDES = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])  # of our rotors along x and y
SPIN = np.array([1, -1, 1, -1])


def rotorpy_vehicle(params, abstraction, **aero):
    quad = {
        "mass": params.mass,
        **dict(zip(("Ixx", "Iyy", "Izz"), params.inertia, strict=True)),
        **dict.fromkeys(("Ixy", "Ixz", "Iyz"), 0.0),
        **{
            f"c_D{axis}": params.mass * c
            for axis, c in zip("xyz", params.quadratic_drag, strict=True)
        },
        "num_rotors": 4,
        "rotor_pos": {f"r{i}": [*(sides * params.arm), 0.0] for i, sides in enumerate(SIDES)},
        "rotor_directions": SPIN,
        "rotor_speed_min": 0.0,
        "rotor_speed_max": np.sqrt(params.max_thrust * params.mass / 4 / params.thrust_coefficient),
        "k_eta": params.thrust_coefficient,
        "k_m": params.thrust_coefficient * params.torque_ratio,
        "tau_m": params.motor_time_constant,
        "k_w": 1 / params.rate_time_constant,
        **aero,
    }
    return Multirotor(quad, control_abstraction=abstraction)


def fly_rotorpy(vehicle, params, commands, wind=(0.0, 0.0, 0.0)):
    """Integrates rotorpy's equations as `fly`; `Multirotor.step` holds motor commands."""

    def control(command, w):
        acceleration = (command[1:] - w) / params.rate_time_constant
        acceleration[2] /= params.yaw_time_ratio
        J = np.array(params.inertia)
        moment = J * acceleration + np.cross(w, J * w)
        thrust = params.mass * command[0]
        return {"cmd_thrust": thrust, "cmd_w": command[1:], "cmd_moment": moment}

    def derivatives(t, s, command):
        state = vehicle._unpack_state(s)
        speeds = vehicle.get_cmd_motor_speeds(state, control(command, state["w"]))
        speeds = np.clip(speeds, vehicle.rotor_speed_min, vehicle.rotor_speed_max)
        return vehicle._s_dot_fn(t, s, speeds)

    hover = np.sqrt(params.mass * 9.81 / 4 / params.thrust_coefficient)
    s = np.concatenate([np.zeros(6), [0, 0, 0, 1], np.zeros(3), wind, np.full(4, hover)])
    states = []
    for command in commands:
        options = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-9, "args": (command,)}
        s = solve_ivp(derivatives, (0.0, HOLD), s, **options).y[:, -1]
        states.append(np.concatenate([s[0:6], s[[9, 6, 7, 8]], s[10:13]]))
    return np.array(states)


def deviation(states, others):
    """Returns the maximum distance [m] of two flights."""
    return np.linalg.norm(states[:, :3] - others[:, :3], axis=1).max()


@pytest.fixture
def commands():
    size = (50, 4)  # 5 s
    return np.random.default_rng(1).uniform([7, -2, -2, -0.5], [14, 2, 2, 0.5], size)


def test_rotors_rates_and_air_are_rotorpys(commands):
    # rotorpy's rate controller does not compensate w x J w, which is 0 for a spherical inertia.
    params = replace(KINGFISHER, inertia=[2.5e-3] * 3, yaw_time_ratio=1.0)
    wind = [1.0, -2.0, 0.5]
    vehicle = rotorpy_vehicle(params, "cmd_ctbr")
    others = fly_rotorpy(vehicle, params, commands, wind)
    states = fly(QuadrotorPlant(params), commands, wind=wind)
    assert deviation(states, others) < 1e-3
    np.testing.assert_allclose(states[:, 3:], others[:, 3:], atol=1e-4)
    assert np.linalg.norm(states[-1, :3]) > 5.0


def test_rotations_are_rotorpys_for_any_inertia(commands):
    vehicle = rotorpy_vehicle(KINGFISHER, "cmd_ctbm")
    others = fly_rotorpy(vehicle, KINGFISHER, commands)
    assert deviation(fly(QuadrotorPlant(KINGFISHER), commands), others) < 1e-3


def test_rotor_drag_equals_rotorpys_at_the_speed_of_hovering_only(commands):
    # rotorpy's grows with the speed of each rotor, and acts at its hub.
    params = replace(KINGFISHER, quadratic_drag=[0.0] * 3, drag=0.3)
    hover = np.sqrt(params.mass * 9.81 / 4 / params.thrust_coefficient)
    coefficient = params.drag * params.mass / (4 * hover)
    vehicle = rotorpy_vehicle(params, "cmd_ctbm", k_d=coefficient, k_z=coefficient)
    gentle = [9.81, 0.0, 0.0, 0.0] + 0.02 * (commands - [9.81, 0.0, 0.0, 0.0])
    for each, bounds in ((gentle, (0.0, 0.05)), (commands, (0.05, 2.0))):
        apart = deviation(fly(QuadrotorPlant(params), each), fly_rotorpy(vehicle, params, each))
        assert bounds[0] <= apart < bounds[1]


def test_saturated_rotors_give_up_yaw_first_and_rotorpys_do_not():
    commands = np.tile([9.81, 0.0, 0.0, 4.0], (10, 1))
    params = replace(KINGFISHER, yaw_time_ratio=0.4, max_thrust=12.0)
    states = fly(QuadrotorPlant(params), commands)
    others = fly_rotorpy(rotorpy_vehicle(params, "cmd_ctbm"), params, commands)
    assert abs(states[:, 2]).max() < 1e-2 < abs(others[:, 2]).max()


def test_trajectories_are_crazyflows():
    # Where they differ, crazyflow's file has its parameters changed: its thrust and torque have
    # terms linear in the speed, rotors speed up and slow down differently, propellers have inertia.
    table = np.loadtxt(Path(__file__).parent / "crazyflow_trajectory.csv", delimiter=",")
    params = Crazyflie21Brushless()
    states = fly(QuadrotorPlant(params), table[:-1, 1:5])
    assert deviation(states, table[1:, 5:]) < 1e-3
    np.testing.assert_allclose(states, table[1:, 5:], atol=1e-5)
    assert np.linalg.norm(states[-1, :3]) > 5.0
    np.testing.assert_array_equal(hover_state([0.0] * 3), table[0, 5:])
