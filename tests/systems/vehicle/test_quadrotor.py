import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.math import RotationMatrix
from pydrake.symbolic import Evaluate, MakeVectorVariable
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import SymbolicVectorSystem, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial
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
    with pytest.raises(ValueError, match=f"{field} must be .* got {value}"):
        QuadrotorPlant(QuadrotorParams(**{field: value}))


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


PERIOD = 0.02  # [s] of the commands and of the integration


def make_simulator(system, integrator="runge_kutta3"):
    simulator = Simulator(system)
    ResetIntegratorFromFlags(simulator, integrator, PERIOD)
    simulator.get_mutable_integrator().set_fixed_step_mode(True)
    return simulator


def fly(plant, state, command, duration, integrator="runge_kutta3"):
    """The state (13,) after `duration` of one constant command."""
    simulator = make_simulator(plant, integrator)
    context = simulator.get_mutable_context()
    context.SetContinuousState(state)
    plant.GetInputPort("command").FixValue(context, command)
    simulator.AdvanceTo(duration)
    return context.get_continuous_state_vector().CopyToVector()


def fly_commands(system, state, commands, integrator="runge_kutta3"):
    """The states (N, 13) after each of `commands` (N, 4), held for PERIOD in a Diagram."""
    builder = DiagramBuilder()
    builder.AddSystem(system)
    # Breaks lie half a period before the samples, so that rounding of time cannot shift a sample.
    breaks = PERIOD * (np.arange(len(commands) + 1) - 0.5)
    held = [command.reshape(4, 1) for command in [*commands, commands[-1]]]
    source = builder.AddSystem(
        TrajectorySource(PiecewisePolynomial.ZeroOrderHold(list(breaks), held))
    )
    hold = builder.AddSystem(ZeroOrderHold(PERIOD, 4))
    builder.Connect(source.get_output_port(), hold.get_input_port())
    builder.Connect(hold.get_output_port(), system.get_input_port())
    simulator = make_simulator(builder.Build(), integrator)
    context = simulator.get_mutable_context()
    context.SetContinuousState(state)
    states = []
    for k in range(len(commands)):
        simulator.AdvanceTo((k + 1) * PERIOD)
        states.append(context.get_continuous_state_vector().CopyToVector())
    return np.array(states)


def harsh_commands(seed, count):
    rng = np.random.default_rng(seed)
    return rng.uniform([0, -6, -6, -6], [20, 6, 6, 6], size=(count, 4))


def tilted_state(roll, pitch, yaw):
    state = np.zeros(13)
    state[6:10] = (
        RotationMatrix(
            RotationMatrix.MakeZRotation(yaw)
            @ RotationMatrix.MakeYRotation(pitch)
            @ RotationMatrix.MakeXRotation(roll)
        )
        .ToQuaternion()
        .wxyz()
    )
    return state


def independent_derivatives(x, u, drag, tau, gravity, concatenate):
    """The equations again, by rotating vectors with quaternion products instead of components."""

    def product(a, b):
        scalar = a[0] * b[0] - a[1:] @ b[1:]
        cross = np.array(
            [
                a[2] * b[3] - a[3] * b[2],
                a[3] * b[1] - a[1] * b[3],
                a[1] * b[2] - a[2] * b[1],
            ]
        )
        return concatenate([[scalar], a[0] * b[1:] + b[0] * a[1:] + cross])

    v, q, w = x[3:6], x[6:10], x[10:13]
    conjugate = q * np.array([1, -1, -1, -1])
    z_B = product(product(q, np.array([0, 0, 0, 1])), conjugate)[1:] / (q @ q)
    a = u[0] * z_B - drag * v - np.array([0, 0, gravity])
    q_dot = 0.5 * product(q, concatenate([[0], w])) + 5 * (1 - q @ q) * q
    return concatenate([v, a, q_dot, (u[1:] - w) / tau])


def test_the_default_context_hovers():
    """At the default Context with hover thrust nothing moves, to the last bit."""
    plant = QuadrotorPlant()
    state = fly(plant, hover_state([0.0, 0.0, 0.0]), [9.81, 0.0, 0.0, 0.0], 5.0)
    context = plant.CreateDefaultContext()
    np.testing.assert_array_equal(
        context.get_continuous_state_vector().CopyToVector(), hover_state([0.0, 0.0, 0.0])
    )
    np.testing.assert_array_equal(state, hover_state([0.0, 0.0, 0.0]))


def test_ports_and_parameters_have_their_documented_names_and_order():
    """The command enters, the state leaves unchanged, and parameter 0 is drag, lag, gravity."""
    plant = QuadrotorPlant(QuadrotorParams(drag=0.1, rate_time_constant=0.2, gravity=3.7))
    context = plant.CreateDefaultContext()
    np.testing.assert_array_equal(context.get_numeric_parameter(0).CopyToVector(), [0.1, 0.2, 3.7])
    state = np.arange(1.0, 14.0)
    context.SetContinuousState(state)
    np.testing.assert_array_equal(plant.GetOutputPort("state").Eval(context), state)
    assert plant.GetInputPort("command").size() == 4
    assert not plant.HasAnyDirectFeedthrough()


def test_parameters_of_the_context_govern_the_motion():
    """Changing gravity in one Context changes the fall in that Context."""
    plant = QuadrotorPlant(QuadrotorParams(drag=0.0))
    context = plant.CreateDefaultContext()
    plant.GetInputPort("command").FixValue(context, np.zeros(4))
    context.get_mutable_numeric_parameter(0).SetFromVector([0.0, 0.05, 1.62])
    assert plant.EvalTimeDerivatives(context).CopyToVector()[5] == -1.62


def test_free_fall_is_the_parabola_and_keeps_energy_and_momentum():
    """Tumbling without thrust or drag follows p0 + v0 t - g t²/2 and keeps its invariants."""
    state = tilted_state(0.3, -0.4, 1.0)
    state[3:6], state[10:13] = [1.0, -2.0, 4.0], [3.0, -2.0, 1.0]
    end = fly(QuadrotorPlant(QuadrotorParams(drag=0.0)), state, [0.0, 3.0, -2.0, 1.0], 3.0)
    np.testing.assert_allclose(end[0:3], [3.0, -6.0, 12.0 - 9.81 * 4.5], atol=1e-9)
    np.testing.assert_allclose(end[3:6], [1.0, -2.0, 4.0 - 9.81 * 3.0], atol=1e-9)

    def energy(x):
        return x[3:6] @ x[3:6] / 2 + 9.81 * x[2]

    assert energy(end) == pytest.approx(energy(state), rel=1e-12)
    # Gravity exerts no torque about the vertical through the world's origin.
    assert np.cross(end[0:3], end[3:6])[2] == pytest.approx(0.0, abs=1e-9)


def test_thrust_at_a_fixed_attitude_gives_its_impulse():
    """Constant thrust changes velocity by t (c z_B - g), with drag by the exponential approach."""
    state = tilted_state(0.4, 0.3, 0.8)
    z_B = RotationMatrix.MakeZRotation(0.8).matrix() @ (
        RotationMatrix.MakeYRotation(0.3).matrix() @ [0.0, -math.sin(0.4), math.cos(0.4)]
    )
    force = 12.0 * z_B - [0.0, 0.0, 9.81]
    end = fly(QuadrotorPlant(QuadrotorParams(drag=0.0)), state, [12.0, 0.0, 0.0, 0.0], 2.0)
    np.testing.assert_allclose(end[3:6], 2.0 * force, atol=1e-10)
    np.testing.assert_allclose(end[0:3], 2.0 * force, atol=1e-10)
    end = fly(QuadrotorPlant(QuadrotorParams(drag=0.5)), state, [12.0, 0.0, 0.0, 0.0], 2.0)
    np.testing.assert_allclose(end[3:6], force * (1.0 - math.exp(-1.0)) / 0.5, atol=1e-6)


def test_a_coordinated_turn_closes_its_circle():
    """Banked by atan(v ω / g) and turning at ω about the vertical, it flies the exact circle."""
    speed, rate = 4.0, 1.5
    bank = math.atan2(speed * rate, 9.81)
    state = tilted_state(-bank, 0.0, 0.0)  # Left wing down, flying along +x, turning left.
    state[3:6] = [speed, 0.0, 0.0]
    w_B = rate * np.array([0.0, -math.sin(bank), math.cos(bank)])
    state[10:13] = w_B
    command = [9.81 / math.cos(bank), *w_B]
    plant = QuadrotorPlant(QuadrotorParams(drag=0.0))
    half = fly(plant, state, command, math.pi / rate, "runge_kutta5")
    np.testing.assert_allclose(half[0:3], [0.0, 2.0 * speed / rate, 0.0], atol=1e-6)
    whole = fly(plant, state, command, 2.0 * math.pi / rate, "runge_kutta5")
    np.testing.assert_allclose(whole[0:6], state[0:6], atol=1e-6)


def test_a_fall_with_drag_ends_at_terminal_velocity():
    """Without thrust, sideways speed dies and the vehicle sinks at g / drag."""
    state = hover_state([0.0, 0.0, 0.0])
    state[3:6] = [5.0, -3.0, 2.0]
    end = fly(QuadrotorPlant(QuadrotorParams(drag=0.8)), state, np.zeros(4), 40.0)
    np.testing.assert_allclose(end[3:6], [0.0, 0.0, -9.81 / 0.8], atol=1e-9)


def test_body_rates_follow_their_command_as_a_first_order_lag():
    """The rates approach a step of the command as 1 - exp(-t / tau)."""
    plant = QuadrotorPlant(QuadrotorParams(rate_time_constant=0.2))
    command = np.array([9.81, 2.0, -1.0, 0.5])
    for duration in (0.1, 0.2, 0.5):
        end = fly(plant, hover_state([0.0, 0.0, 0.0]), command, duration, "runge_kutta5")
        expected = (1.0 - math.exp(-duration / 0.2)) * command[1:]
        np.testing.assert_allclose(end[10:13], expected, atol=1e-7)


def test_the_quaternion_stays_unit_for_a_minute_of_harsh_commands():
    """Random commands at 50 Hz for 60 s move the quaternion's length by less than 2e-4."""
    states = fly_commands(QuadrotorPlant(), hover_state([0.0, 0.0, 0.0]), harsh_commands(0, 3000))
    assert np.abs(np.linalg.norm(states[:, 6:10], axis=1) - 1.0).max() < 2e-4


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # numpy on Expressions
def test_agrees_with_a_symbolic_vector_system():
    """The trajectory is that of Drake's SymbolicVectorSystem of independently written equations."""
    x, u = MakeVectorVariable(13, "x"), MakeVectorVariable(4, "u")
    oracle = SymbolicVectorSystem(
        state=x,
        input=u,
        dynamics=independent_derivatives(x, u, 0.375, 0.05, 9.81, np.concatenate),
        output=x,
    )
    commands = harsh_commands(1, 100)
    start = tilted_state(0.2, -0.3, 2.0)
    np.testing.assert_allclose(
        fly_commands(QuadrotorPlant(), start, commands),
        fly_commands(oracle, start, commands),
        atol=1e-9,
    )


@pytest.mark.parametrize(
    ("integrator", "tolerance"), [("runge_kutta3", 0.02), ("runge_kutta5", 0.003)]
)
def test_agrees_with_rk4_at_50_hz(integrator, tolerance):
    """After 5 s of harsh commands the position is within `tolerance` m of classical RK4's."""
    commands = harsh_commands(2, 250)
    x = start = tilted_state(0.1, 0.2, -1.0)

    def f(x, u):
        return independent_derivatives(x, u, 0.375, 0.05, 9.81, np.concatenate)

    for u in commands:
        k1 = f(x, u)
        k2 = f(x + PERIOD / 2 * k1, u)
        k3 = f(x + PERIOD / 2 * k2, u)
        k4 = f(x + PERIOD * k3, u)
        x = x + PERIOD / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    end = fly_commands(QuadrotorPlant(), start, commands, integrator)[-1]
    assert np.linalg.norm(end[0:3] - x[0:3]) < tolerance


def test_autodiff_gradients_equal_finite_differences():
    """Derivatives by state, command and parameter from ToAutoDiffXd match central differences."""
    plant = QuadrotorPlant(QuadrotorParams(drag=0.3))
    rng = np.random.default_rng(3)
    x = np.concatenate([rng.normal(size=13), harsh_commands(3, 1)[0], [0.3, 0.05, 9.81]])

    def derivatives(system, x):
        context = system.CreateDefaultContext()
        context.SetContinuousState(x[:13])
        system.get_input_port().FixValue(context, x[13:17])
        context.get_mutable_numeric_parameter(0).SetFromVector(x[17:])
        return system.EvalTimeDerivatives(context).CopyToVector()

    gradient = ExtractGradient(derivatives(plant.ToAutoDiffXd(), InitializeAutoDiff(x).ravel()))
    h = 1e-6
    differences = np.column_stack(
        [
            (derivatives(plant, x + h * e) - derivatives(plant, x - h * e)) / (2 * h)
            for e in np.eye(20)
        ]
    )
    np.testing.assert_allclose(gradient, differences, atol=1e-5)


def test_scalar_conversion_keeps_the_parameters_and_the_equations():
    """ToSymbolic gives expressions that evaluate to the float plant's derivatives."""
    plant = QuadrotorPlant(QuadrotorParams(drag=0.2, rate_time_constant=0.1, gravity=3.7))
    symbolic = plant.ToSymbolic()
    context = symbolic.CreateDefaultContext()
    variables = MakeVectorVariable(17, "x")
    expressions = np.array([1.0 * variable for variable in variables])
    context.SetContinuousState(expressions[:13])
    symbolic.get_input_port().FixValue(context, expressions[13:])
    rng = np.random.default_rng(4)
    x = np.concatenate([rng.normal(size=13), harsh_commands(4, 1)[0]])
    values = Evaluate(
        symbolic.EvalTimeDerivatives(context).CopyToVector(),
        dict(zip(variables, x, strict=True)),
    ).ravel()

    context = plant.CreateDefaultContext()
    context.SetContinuousState(x[:13])
    plant.get_input_port().FixValue(context, x[13:])
    np.testing.assert_allclose(
        values, plant.EvalTimeDerivatives(context).CopyToVector(), atol=1e-10
    )


def test_a_zero_quaternion_is_an_error_that_names_it():
    with pytest.raises(ValueError, match=r"q_WB .* must not be zero, got \[0\.0, "):
        fly(QuadrotorPlant(), np.zeros(13), [9.81, 0.0, 0.0, 0.0], 0.1)
