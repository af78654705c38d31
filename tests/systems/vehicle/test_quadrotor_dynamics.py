import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.common.yaml import yaml_load_typed
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from splatpilot.systems.vehicle.quadrotor import (
    QuadrotorParams,
    hover_state,
    quadrotor_derivatives,
    rk4_step,
)

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
    """The derivatives equal the paper's vector equations with scipy's rotations."""
    rng = np.random.default_rng(0)
    for state, command in zip(random_states(rng, 20), random_commands(rng, 20), strict=True):
        derivatives = quadrotor_derivatives(state, command, PARAMS)
        v_WB, w_WB_B = state[3:6], state[10:13]
        z_B = rotation_WB(state).apply([0.0, 0.0, 1.0])
        a_WB = command[0] * z_B - [0.0, 0.0, 9.7] - 0.3 * v_WB
        # The attitude after a short turn, by the exponential map.
        h = 1e-6
        after = (rotation_WB(state) * Rotation.from_rotvec(h * w_WB_B)).as_quat(scalar_first=True)
        before = (rotation_WB(state) * Rotation.from_rotvec(-h * w_WB_B)).as_quat(scalar_first=True)
        after *= np.sign(after @ state[6:10])
        before *= np.sign(before @ state[6:10])
        np.testing.assert_allclose(derivatives[0:3], v_WB)
        np.testing.assert_allclose(derivatives[3:6], a_WB, atol=1e-12)
        np.testing.assert_allclose(derivatives[6:10], (after - before) / (2 * h), atol=1e-8)
        np.testing.assert_allclose(derivatives[10:13], (command[1:] - w_WB_B) / 0.07)


def test_energy_changes_by_the_power_of_thrust_and_drag():
    """d/dt (|v|²/2 + g z) = c z_B · v - drag |v|² at every state."""
    rng = np.random.default_rng(1)
    state, command = random_states(rng, 50), random_commands(rng, 50)
    derivatives = quadrotor_derivatives(state, command, PARAMS)
    v_WB = state[:, 3:6]
    power = np.sum(v_WB * derivatives[:, 3:6], axis=1) + 9.7 * derivatives[:, 2]
    z_B = rotation_WB(state).apply([0.0, 0.0, 1.0])
    expected = command[:, 0] * np.sum(z_B * v_WB, axis=1) - 0.3 * np.sum(v_WB**2, axis=1)
    np.testing.assert_allclose(power, expected, atol=1e-12)


def test_quaternion_length_pulls_to_one_and_does_not_change_the_thrust():
    """A scaled quaternion is the same attitude, and its length returns to one."""
    rng = np.random.default_rng(2)
    state, command = random_states(rng), random_commands(rng)
    for scale in (0.8, 1.2):
        scaled = state.copy()
        scaled[6:10] *= scale
        derivatives = quadrotor_derivatives(scaled, command, PARAMS)
        np.testing.assert_allclose(
            derivatives[3:6], quadrotor_derivatives(state, command, PARAMS)[3:6], atol=1e-12
        )
        growth = scaled[6:10] @ derivatives[6:10] / scale**2
        np.testing.assert_allclose(growth, 5.0 * (1.0 - scale**2))


def test_batches_of_any_shape_equal_single_states():
    """A batch gives what a loop over its members gives, and leading shapes broadcast."""
    rng = np.random.default_rng(3)
    states, commands = random_states(rng, 3, 4), random_commands(rng, 4)
    batch = rk4_step(states, commands, PARAMS, 0.02)
    assert batch.shape == (3, 4, 13)
    for i, j in np.ndindex(3, 4):
        np.testing.assert_array_equal(
            batch[i, j], rk4_step(states[i, j], commands[j], PARAMS, 0.02)
        )


def test_torch_batch_equals_a_numpy_loop():
    """Tensors give the numbers of numpy, as tensors of their own precision."""
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(4)
    states, commands = random_states(rng, 5, 3), random_commands(rng, 5, 3)
    result = rk4_step(torch.tensor(states), torch.tensor(commands), PARAMS, 0.02)
    expected = [
        [rk4_step(states[i, j], commands[i, j], PARAMS, 0.02) for j in range(3)] for i in range(5)
    ]
    np.testing.assert_allclose(result.numpy(), expected, rtol=0, atol=1e-13)
    single = quadrotor_derivatives(
        torch.tensor(states).float(), torch.tensor(commands).float(), PARAMS
    )
    assert single.dtype == torch.float32


def test_torch_and_autodiff_gradients_of_a_step_agree():
    """The Jacobian of a step is the same by torch, by AutoDiffXd and by finite differences."""
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(5)
    state, command = random_states(rng), random_commands(rng)

    def step(x):
        return rk4_step(x[:13], x[13:], PARAMS, 0.05)

    x = np.concatenate([state, command])
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
    """Halving the step divides the error against a tight adaptive solution by about 16."""
    rng = np.random.default_rng(6)
    state, command = random_states(rng), random_commands(rng)
    exact = solve_ivp(
        lambda t, x: quadrotor_derivatives(x, command, PARAMS),
        (0.0, 0.4),
        state,
        method="DOP853",
        rtol=1e-12,
        atol=1e-12,
    ).y[:, -1]

    def error(steps):
        x = state
        for _ in range(steps):
            x = rk4_step(x, command, PARAMS, 0.4 / steps)
        return np.linalg.norm(x - exact)

    assert math.log2(error(20) / error(40)) == pytest.approx(4.0, abs=0.3)


@given(yaw=st.floats(-10, 10), x=st.floats(-5, 5))
def test_hover_state_is_level_at_rest_and_faces_yaw(yaw, x):
    """The hover state has the position and heading asked for, and stays there at hover thrust."""
    state = hover_state([x, 2.0, 3.0], yaw)
    np.testing.assert_array_equal(state[0:3], [x, 2.0, 3.0])
    np.testing.assert_allclose(
        rotation_WB(state).as_matrix()[:, 0], [math.cos(yaw), math.sin(yaw), 0.0], atol=1e-12
    )
    hover = quadrotor_derivatives(state, np.array([9.7, 0.0, 0.0, 0.0]), PARAMS)
    np.testing.assert_allclose(hover, 0.0, atol=1e-12)


def test_params_load_from_yaml():
    """YAML overrides single fields, and a typing error is refused."""
    params = yaml_load_typed(schema=QuadrotorParams, data="{drag: 0.1}")
    assert params == QuadrotorParams(drag=0.1)
    with pytest.raises(RuntimeError, match="dragg"):
        yaml_load_typed(schema=QuadrotorParams, data="{dragg: 0.1}")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("drag", -0.1),
        ("drag", math.nan),
        ("rate_time_constant", 0.0),
        ("rate_time_constant", -1.0),
        ("gravity", math.inf),
        ("gravity", -9.81),
    ],
)
def test_bad_params_are_refused_by_name(field, value):
    """A parameter out of range is an error that names it and its value."""
    with pytest.raises(ValueError, match=f"{field} is {value}"):
        QuadrotorParams(**{field: value}).validate()


def test_the_flight_path_does_not_import_torch():
    """Importing every module of the vehicle leaves torch out, which is slow to start."""
    code = (
        "import sys, splatpilot.systems.vehicle.quadrotor as _;"
        "import splatpilot.systems.vehicle.flatness, numpy as np;"
        "from splatpilot.systems.vehicle.quadrotor import *;"
        "rk4_step(hover_state([0, 0, 0]), np.zeros(4), QuadrotorParams(), 0.02);"
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
