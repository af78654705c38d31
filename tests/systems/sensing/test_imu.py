import numpy as np
import pytest
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator

from splatpilot.systems.sensing.imu import Imu, ImuSensor, measurement_error, specific_force
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, hover_state, quadrotor_derivatives

IDEAL = {
    name: 0.0
    for name in ("accelerometer_noise", "gyroscope_noise", "accelerometer_walk", "gyroscope_walk")
}
PARAMS = QuadrotorParams()


def measure(config: Imu, seed: int, duration: float, name="imu"):
    """Returns accelerations and angular velocities (N, 3) while hovering with 0.4 rad/s of yaw."""
    imu, rows = ImuSensor(config, PARAMS, seed), []
    imu.set_name(name)
    simulator = Simulator(imu)
    context = simulator.get_mutable_context()
    imu.GetInputPort("command").FixValue(context, [9.81, 0.0, 0.0, 0.4])
    imu.GetInputPort("state").FixValue(context, hover_state([0.0, 0.0, 5.0]) + 0.4 * np.eye(13)[12])
    for k in range(1, round(duration * config.rate) + 1):
        simulator.AdvanceTo(k / config.rate)
        rows.append([imu.get_output_port(i).Eval(context).copy() for i in range(2)])
    return np.moveaxis(rows, 1, 0)


def test_specific_force_is_thrust_less_drag_in_body_axes():
    R_WB = RollPitchYaw(0.7, 0.2, 1.0).ToRotationMatrix()
    v_WB = np.array([2.0, -1.0, 0.5])
    q_WB = R_WB.ToQuaternion().wxyz()
    state = np.concatenate([np.zeros(3), v_WB, q_WB, np.zeros(3)])
    expected = [0.0, 0.0, 12.0] - PARAMS.drag * (R_WB.matrix().T @ v_WB)
    a_WB = np.array(quadrotor_derivatives(state, np.array([12.0, 0.0, 0.0, 0.0]), PARAMS)[3:6])
    force = specific_force(state, a_WB, PARAMS.gravity)
    np.testing.assert_allclose(force, expected, atol=1e-12)


def test_an_ideal_imu_measures_hover_and_rates():
    accelerometer, gyroscope = measure(Imu(**IDEAL), 0, 0.1)
    np.testing.assert_allclose(accelerometer, np.tile([0.0, 0.0, 9.81], (20, 1)), atol=1e-9)
    np.testing.assert_allclose(gyroscope, np.tile([0.0, 0.0, 0.4], (20, 1)), atol=1e-9)


def test_an_imu_feels_wind_through_the_acceleration():
    imu = ImuSensor(Imu(**IDEAL), PARAMS, 0)
    simulator = Simulator(imu)
    context = simulator.get_mutable_context()
    imu.GetInputPort("state").FixValue(context, hover_state([0.0, 0.0, 5.0]))
    imu.GetInputPort("acceleration").FixValue(context, [4.0 * PARAMS.drag, 0.0, 0.0])
    simulator.AdvanceTo(0.001)
    force = imu.GetOutputPort("accelerometer").Eval(context)
    np.testing.assert_allclose(force, [4.0 * PARAMS.drag, 0.0, 9.81], atol=1e-9)


@pytest.mark.parametrize(
    ("noisy", "walking"), [("accelerometer", "gyroscope"), ("gyroscope", "accelerometer")]
)
def test_white_noise_and_the_walk_of_biases_have_their_densities(noisy, walking):
    config = Imu(**IDEAL | {f"{noisy}_noise": 0.01, f"{walking}_walk": 0.01})
    measured = dict(zip(("accelerometer", "gyroscope"), measure(config, 3, 8.0), strict=True))
    assert measured[noisy].std(axis=0) == pytest.approx(0.01 * np.sqrt(200.0), rel=0.05)
    steps = np.diff(measured[walking], axis=0)
    assert steps.std() == pytest.approx(0.01 / np.sqrt(200.0), rel=0.05)


def test_noise_follows_from_seed_and_name():
    first, again, other, renamed = (
        measure(Imu(), seed, 0.1, name=name)[0]
        for seed, name in ((1, "imu"), (1, "imu"), (2, "imu"), (1, "second"))
    )
    np.testing.assert_array_equal(first, again)
    assert not np.isclose(first, other).any() and not np.isclose(first, renamed).any()


def test_allan_deviation_is_that_of_the_model():
    config = Imu(accelerometer_noise=2e-3, accelerometer_walk=3e-3)
    random, flights, samples = np.random.default_rng(0), 300, 6_000
    bias, errors = np.zeros(flights), np.empty((samples, flights))
    for k in range(samples):
        draws = random.standard_normal((2, flights))
        errors[k], bias = measurement_error(bias, *draws, 2e-3, 3e-3, config.rate)
    sums = np.cumsum(errors, axis=0) / config.rate
    for m in np.unique(np.geomspace(1, 300, 7).round().astype(int)):  # 5 ms to 1.5 s
        tau = m / config.rate
        second = sums[2 * m :: m] - 2.0 * sums[m:-m:m] + sums[: -2 * m : m]
        found = np.sqrt(0.5 * np.mean(second**2)) / tau
        expected = np.sqrt(2e-3**2 / tau + 3e-3**2 * tau * (1 / 3 + 1 / (6 * m**2)))
        assert found == pytest.approx(expected, rel=0.05)
