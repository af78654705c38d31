import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Linearize, LogVectorOutput
from scipy.spatial.transform import Rotation

from splatpilot.systems.vehicle.flatness import (
    FlatnessController,
    FlatnessControllerConfig,
    attitude_from_thrust,
    flatness_command,
    reaching_acceleration,
)
from splatpilot.systems.vehicle.quadrotor import (
    QuadrotorParams,
    QuadrotorPlant,
    hover_state,
    quadrotor_derivatives,
)
from tests.systems.vehicle.responses import simulate

CONFIG = FlatnessControllerConfig()
PARAMS = QuadrotorParams(drag=0.4, gravity=9.7)
vectors = st.lists(st.floats(-20, 20) | st.just(0.0), min_size=3, max_size=3).map(np.array)
rotations = st.lists(st.floats(-1, 1), min_size=4, max_size=4).map(
    lambda q: Rotation.from_quat(np.array(q) + np.array([0.0, 0.0, 0.0, 1e-3]))
)
angles = st.floats(-math.pi, math.pi)
UNLIMITED = FlatnessControllerConfig(
    min_thrust=1e-6, max_thrust=1e3, max_tilt=1.57, tilt_gain=10, max_tilt_rate=1e3,
    yaw_gain=10, max_yaw_rate=1e3,
)  # fmt: skip


@given(p_WR=vectors, p_WB=vectors, v_WB=vectors, lookahead=st.floats(0.2, 2))
def test_reaching_acceleration_arrives(p_WR, p_WB, v_WB, lookahead):
    a_WB = reaching_acceleration(p_WR, p_WB, v_WB, lookahead)
    end = p_WB + lookahead * v_WB + lookahead**2 / 2 * a_WB
    np.testing.assert_allclose(end, p_WR, rtol=1e-9, atol=1e-8)


@given(R_WB=rotations, a_WB=vectors, v_WB=vectors, heading=angles)
def test_rates_lead_to_the_attitude_of_the_acceleration(R_WB, a_WB, v_WB, heading):
    assume(a_WB[2] + PARAMS.drag * v_WB[2] > -9.0)
    q_WB = R_WB.as_quat(scalar_first=True)
    state = np.concatenate([np.zeros(3), v_WB, q_WB, np.zeros(3)])
    rates = flatness_command(state, a_WB, v_WB, heading, UNLIMITED, PARAMS)[1:] / 10
    tilt = Rotation.from_rotvec([*rates[:2], 0.0])
    R_WD = R_WB * tilt * Rotation.from_euler("z", rates[2])
    state[6:10] = R_WD.as_quat(scalar_first=True)
    command = flatness_command(state, a_WB, v_WB, heading, UNLIMITED, PARAMS)
    np.testing.assert_allclose(command[1:], 0.0, atol=1e-5)
    v_dot = quadrotor_derivatives(state, command, PARAMS)[3:6]
    np.testing.assert_allclose(v_dot, a_WB, atol=1e-5)
    x, _, z = R_WD.as_matrix().T
    assert x @ [-math.sin(heading), math.cos(heading), 0.0] == pytest.approx(0.0, abs=1e-6)
    assert x @ [math.cos(heading), math.sin(heading), 0.0] > 0.0
    assert math.cos(tilt.magnitude()) == pytest.approx(R_WB.as_matrix()[:, 2] @ z, abs=1e-6)


@pytest.mark.parametrize(
    ("a_WB", "thrust"),
    [
        ([3.0, -2.0, -0.81], [3.0, -2.0, 9.0]),
        ([40.0, 0.0, 0.0], [9.81 * math.tan(0.8), 0.0, 9.81]),  # lift before sideways thrust
        ([0.0, 0.0, -30.0], [0.0, 0.0, 2.0]),
        ([0.0, 0.0, 30.0], [0.0, 0.0, 20.0]),
    ],
)
def test_thrust_is_limited_in_tilt_and_size(a_WB, thrust):
    x = attitude_from_thrust(np.array(thrust), 0.3)
    q_WB = Rotation.from_matrix(x).as_quat(scalar_first=True)
    state = np.concatenate([np.zeros(6), q_WB, np.zeros(3)])
    command = flatness_command(state, np.array(a_WB), np.zeros(3), 0.3, CONFIG, QuadrotorParams())
    expected = [np.linalg.norm(thrust), 0.0, 0.0, 0.0]
    np.testing.assert_allclose(command, expected, atol=1e-9)


@pytest.mark.parametrize("make", [np.asarray, torch.as_tensor], ids=["numpy", "torch"])
@pytest.mark.parametrize("heading", [None, 0.4, math.nan])
def test_batches_equal_single_vehicles(make, heading):
    rng = np.random.default_rng(3)
    states, a_WB = rng.normal(size=(8, 13)), 10 * rng.normal(size=(8, 3))
    v_WB = states[:, 3:6]
    given = None if heading is None else make(np.full(8, heading))
    batch = flatness_command(make(states), make(a_WB), make(v_WB), given, CONFIG, PARAMS)
    singles = [
        flatness_command(state, a, v, heading, CONFIG, PARAMS)
        for state, a, v in zip(states, a_WB, v_WB, strict=True)
    ]
    np.testing.assert_allclose(batch, singles, atol=1e-9)


def test_gradients_at_rest_are_finite():
    state = torch.as_tensor(hover_state([0.0, 0.0, 2.0]))[None].float().requires_grad_()
    a_WB = torch.zeros(1, 3, requires_grad=True)
    flatness_command(state, a_WB, state[:, 3:6], None, CONFIG, PARAMS).sum().backward()
    assert state.grad is not None and torch.isfinite(state.grad).all()
    assert a_WB.grad is not None and torch.isfinite(a_WB.grad).all()
    assert a_WB.grad[0, 2] == pytest.approx(1.0)  # thrust
    assert a_WB.grad[0, 0].abs() == pytest.approx(CONFIG.tilt_gain / PARAMS.gravity, rel=1e-4)


class Signal(LeafSystem):
    """A function of time (3,) as an output port."""

    def __init__(self, function):
        super().__init__()
        self.DeclareVectorOutputPort(
            "value", 3, lambda context, output: output.SetFromVector(function(context.get_time()))
        )


def fly(state, duration, *, config=None, params=None, **inputs):
    """Times (N,), states (N, 13) and commands (N, 4) every 20 ms, for functions of time as inputs
    of the controller."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(QuadrotorPlant(params))
    controller = builder.AddSystem(FlatnessController(config, params))
    builder.Connect(plant.get_output_port(), controller.GetInputPort("state"))
    builder.Connect(controller.get_output_port(), plant.get_input_port())
    for port, function in inputs.items():
        signal = builder.AddSystem(Signal(function))
        builder.Connect(signal.get_output_port(), controller.GetInputPort(port))
    outputs = plant.get_output_port(), controller.get_output_port()
    logs = [LogVectorOutput(port, builder, 0.02) for port in outputs]
    simulator = simulate(builder.Build(), 0.02)
    context = simulator.get_mutable_context()
    context.SetContinuousState(state)
    simulator.AdvanceTo(duration)
    states, commands = (log.FindLog(context) for log in logs)
    return states.sample_times(), states.data().T, commands.data().T


def command_for(controller=None, time=0.0, **inputs):
    """The command (4,) that one update computes."""
    controller = controller or FlatnessController()
    context = controller.CreateDefaultContext()
    context.SetTime(time)
    for port, value in inputs.items():
        controller.GetInputPort(port).FixValue(context, value)
    return controller.EvalUniquePeriodicDiscreteUpdate(context).value(0)


def yaw_of(states):
    return np.unwrap(Rotation.from_quat(states[:, 6:10], scalar_first=True).as_euler("ZYX")[:, 0])


def test_the_command_is_held_between_updates():
    config = FlatnessControllerConfig(period=0.1)
    _, _, commands = fly(
        hover_state([0.0, 0.0, 0.0]), 1.0, config=config, waypoint=lambda t: [t, -t, 1.0]
    )
    np.testing.assert_array_equal(commands[0], [9.81, 0.0, 0.0, 0.0])  # Before the first update.
    changed = np.nonzero(np.any(np.diff(commands, axis=0) != 0.0, axis=1))[0]
    assert len(changed) >= 9
    assert set(changed % 5) == {0}


LEVEL, UPSIDE_DOWN = hover_state([0.0, 0.0, 0.0]), hover_state([0.0, 0.0, 10.0])
UPSIDE_DOWN[6:] = 0.0, 1.0, 0.0, 0.0, 3.0, -2.0, 5.0


@pytest.mark.parametrize(
    ("start", "end"),
    [(LEVEL, [-2.0, 2.0, 4.0]), (LEVEL, [30, 40, 5]), (UPSIDE_DOWN, [0.0, 0.0, 10.0])],
)
def test_a_flight_to_a_waypoint_converges(start, end):
    _, states, _ = fly(start, 20.0, waypoint=lambda t: end)
    np.testing.assert_allclose(states[-1, 0:3], end, atol=1e-3)
    np.testing.assert_allclose(states[-1, 3:6], 0.0, atol=1e-3)
    assert states[:, 2].min() > start[2] - 5.0


@pytest.mark.parametrize("time", [0.0, 0.5])
def test_the_disturbance_estimate_removes_the_error_of_the_hover_thrust(time):
    params = QuadrotorParams(thrust_scale=0.95)
    config = FlatnessControllerConfig(disturbance_time=time)
    start = np.append(hover_state([0.0, 0.0, 2.0]), 1.0)  # the last is the charge
    _, states, commands = fly(
        start, 15.0, config=config, params=params, waypoint=lambda t: [0.0, 0.0, 2.0]
    )
    missing = 9.81 * (1.0 / 0.95 - 1.0)
    sag = 0.0 if time else 0.5 * config.lookahead**2 * missing
    assert commands[-1, 0] == pytest.approx(9.81 + missing, abs=1e-6)
    assert states[-1, 2] == pytest.approx(2.0 - sag, abs=1e-3)


def test_the_disturbance_estimate_begins_at_the_velocity_of_the_start():
    config = FlatnessControllerConfig(disturbance_time=0.4)
    controller = FlatnessController(config, QuadrotorParams())
    context = controller.CreateDefaultContext()
    state = hover_state([0.0, 0.0, 2.0])
    state[3] = 4.0
    controller.GetInputPort("state").FixValue(context, state)
    controller.GetInputPort("acceleration").FixValue(context, np.zeros(3))
    simulator = Simulator(controller, context)
    simulator.Initialize()
    np.testing.assert_allclose(context.get_discrete_state(1).value(), [4.0, 0, 0, 0, 0, 0])


def test_the_disturbance_estimate_does_not_wind_up_while_thrust_saturates():
    flights = [
        fly(
            hover_state([0.0, 0.0, 0.0]),
            10.0,
            config=FlatnessControllerConfig(max_thrust=14.5, disturbance_time=time),
            waypoint=lambda t: [0.0, 0.0, 100.0 if t < 4.0 else 45.0],
        )
        for time in (0.0, 0.5)
    ]
    (_, plain, commands), (_, observed, _) = flights
    np.testing.assert_allclose(commands[1:200, 0], 14.5)
    np.testing.assert_allclose(observed[:, :3], plain[:, :3], atol=0.05)


def circle(t, radius=3.0, speed=2.0):
    angle = speed / radius * t
    return np.array([radius * math.cos(angle), radius * math.sin(angle), 1.5])


def test_tracks_a_circle_to_a_centimeter():
    state = hover_state(circle(0.0), yaw=math.pi / 2)
    state[3:6] = [0.0, 2.0, 0.0]
    times, states, _ = fly(state, 12.0, waypoint=lambda t: circle(t + CONFIG.lookahead))
    error = np.linalg.norm(states[:, 0:3] - [circle(t) for t in times], axis=1)
    steady = times > 8.0
    assert error[steady].max() < 0.01
    assert error.max() < 0.05
    yaw_error = yaw_of(states) - (math.pi / 2 + 2.0 / 3.0 * times)
    assert np.abs(yaw_error[steady]).max() < math.radians(6.0)


def test_yaw_follows_the_velocity_when_an_acceleration_is_flown():
    state = hover_state([0.0, 0.0, 0.0], yaw=0.8)
    state[3:6] = [4.0, 0.0, 0.0]
    _, states, _ = fly(state, 2.5, acceleration=lambda t: [-1.0, 0.0, 0.0])
    assert states[-1, 3] > 1.0
    assert yaw_of(states)[-1] == pytest.approx(0.0, abs=math.radians(1.0))


@pytest.mark.parametrize("velocity", [[0.0, 0.01, 0.0], [0.0, 0.0, 1.0]])
def test_yaw_rests_when_slow(velocity):
    start, v_WR = hover_state([0.0, 0.0, 0.0]), np.array(velocity)
    _, states, _ = fly(start, 5.0, waypoint=lambda t: (t + CONFIG.lookahead) * v_WR)
    assert np.abs(yaw_of(states)).max() < math.radians(1.0)


finite = st.floats(-1e6, 1e6) | st.floats(-3, 3)


@settings(max_examples=80)
@given(
    state=st.lists(finite, min_size=13, max_size=13),
    port=st.sampled_from(["waypoint", "acceleration"]),
    value=st.lists(finite, min_size=3, max_size=3),
)
def test_commands_are_limited_for_any_input(state, port, value):
    state = np.array(state)
    if np.linalg.norm(state[6:10]) < 1e-6:
        state[6] = 1.0
    command = command_for(state=state, **{port: value})
    assert CONFIG.min_thrust <= command[0] <= CONFIG.max_thrust
    assert math.hypot(command[1], command[2]) <= CONFIG.max_tilt_rate * (1 + 1e-12)
    assert abs(command[3]) <= CONFIG.max_yaw_rate


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ({}, "got neither"),
        ({"waypoint": np.zeros(3), "acceleration": np.zeros(3)}, "got both"),
        (
            {"state": np.full(13, np.nan), "waypoint": np.zeros(3)},
            "'state' .* at t = 0.5 s must",
        ),
        ({"waypoint": [0.0, np.nan, 0.0]}, "'waypoint' .* at t = 0.5 s must be finite"),
        ({"acceleration": [0.0, np.nan, 0.0]}, "'acceleration' .* at t = 0.5 s must be finite"),
    ],
)
def test_inputs_that_are_invalid_are_errors(inputs, message):
    with pytest.raises(ValueError, match=message):
        command_for(time=0.5, **{"state": hover_state([0.0, 0.0, 0.0])} | inputs)


@pytest.mark.parametrize("port", ["waypoint", "acceleration"])
@pytest.mark.parametrize("heading", [{}, {"heading": [math.nan]}, {"heading": [0.4]}])
def test_derivatives_of_an_update_equal_differences(port, heading):
    def update(controller, x):
        return command_for(controller, state=x[:13], **{port: x[13:]}, **heading)

    controller = FlatnessController(CONFIG, PARAMS)
    x = np.concatenate([hover_state([0.0, 0.0, 2.0], 0.3), [0.4, 0.1, 0.2]])
    x += 0.05 * np.random.default_rng(1).normal(size=16)
    dual = update(controller.ToAutoDiffXd(), InitializeAutoDiff(x).ravel())
    steps = 1e-6 * np.eye(16)
    expected = [(update(controller, x + h) - update(controller, x - h)) / 2e-6 for h in steps]
    np.testing.assert_allclose(ExtractValue(dual).ravel(), update(controller, x))
    np.testing.assert_allclose(ExtractGradient(dual), np.transpose(expected), rtol=1e-6, atol=1e-6)


def test_the_controller_is_linearized_at_rest():
    controller, state = FlatnessController(), hover_state([0.0, 0.0, 2.0])
    context = controller.CreateDefaultContext()
    controller.GetInputPort("state").FixValue(context, state)
    controller.GetInputPort("waypoint").FixValue(context, state[:3])
    ports = controller.GetInputPort("waypoint"), controller.GetOutputPort("command")
    linear = Linearize(controller, context, *(port.get_index() for port in ports))
    assert linear.time_period() == CONFIG.period
    lift = 2.0 / CONFIG.lookahead**2
    tilt = CONFIG.tilt_gain * lift / 9.81
    expected = [[0, 0, lift], [0, -tilt, 0], [tilt, 0, 0], [0, 0, 0]]
    np.testing.assert_allclose(linear.B(), expected, atol=1e-6)
