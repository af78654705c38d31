"""Writes crazyflow_trajectory.csv: 5 s of crazyflow 0.4.0's first-principles dynamics.

    pip install crazyflow==0.4.0  # with jax and mujoco, which the tests do not need
    SCIPY_ARRAY_API=1 python tests/systems/vehicle/crazyflow_trajectory.py

The vehicle is crazyflow's `cf21B_500` with thrust and torque proportional to the square of a
rotor's speed, a lag of 0.05 s of that speed, and massless propellers. Commands hold for 0.1 s; the
law of `rotor_speeds` tracks them. Rows: t, the command (4) from then on, and the state (13).
"""

from pathlib import Path

import numpy as np
from crazyflow.dynamics import load_fn_params  # pyright: ignore[reportMissingImports]
from crazyflow.dynamics.first_principles import dynamics  # pyright: ignore[reportMissingImports]
from scipy.integrate import solve_ivp

LAG, TAU, YAW_TAU, HOLD = 0.05, 1 / 16.300330418164553, 1 / 17.368699336318954, 0.1  # [s]

params = load_fn_params(dynamics, "cf21B_500")
params["rpm2thrust"] = np.array([[0.0, 0.0, params["rpm2thrust"][2]]])
params["rpm2torque"] = np.array([[0.0, 0.0, params["rpm2torque"][2]]])
params["rotor_dyn_coef"] = np.array([[1 / LAG, 0.0, 1 / LAG, 0.0]])
params |= {"prop_inertia": np.zeros(1), "L": np.array([params["L"]])}
params["J_inv"] = np.linalg.inv(params["J"])
k, mixing = params["rpm2thrust"][0, 2], np.asarray(params["mixing_matrix"])
arms = np.array([params["L"][0], params["L"][0], params["rpm2torque"][0, 2] / k])
allocation = np.vstack([np.ones(4), arms[:, None] * mixing])


def rotor_speeds(command, rates):
    """Returns the commanded speeds (4) [rpm] for a thrust over mass and body rates (4)."""
    acceleration = (command[1:] - rates) / [TAU, TAU, YAW_TAU]
    torque = params["J"] @ acceleration + np.cross(rates, params["J"] @ rates)
    return np.sqrt(np.linalg.solve(allocation, [params["mass"] * command[0], *torque]) / k)


def derivatives(t, x, command):
    """Returns those of p, q (xyzw), v, w and rotor speeds [rpm]."""
    pos, quat, vel, rates, speeds = np.split(x, [3, 7, 10, 13])
    speeds_cmd = rotor_speeds(command, rates)
    return np.concatenate(dynamics(pos, quat, vel, rates, speeds_cmd, speeds, **params))


rng = np.random.default_rng(0)
hover = np.full(4, np.sqrt(0.25 * params["mass"] * 9.81 / k))
x, rows = np.concatenate([np.zeros(6), [1.0], np.zeros(6), hover]), []
for step in range(51):
    command = rng.uniform([8.0, -2.0, -2.0, -0.3], [12.0, 2.0, 2.0, 0.3])
    pos, quat, vel, rates, _ = np.split(x, [3, 7, 10, 13])
    rows.append([step * HOLD, *command, *pos, *vel, quat[3], *quat[:3], *rates])
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-11, "args": (command,)}
    x = solve_ivp(derivatives, (0.0, HOLD), x, **options).y[:, -1]
np.savetxt(Path(__file__).with_suffix(".csv"), rows, "%.9g", delimiter=",")
