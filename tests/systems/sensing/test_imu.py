import numpy as np
import pytest
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from splatpilot.systems.sensing.imu import (
    Imu,
    ImuSensor,
    measurement_error,
    specific_force,
)
from splatpilot.systems.vehicle.quadrotor import (
    QuadrotorParams,
    QuadrotorPlant,
    hover_state,
    quadrotor_derivatives,
)

IDEAL = {
    name: 0.0
    for name in (
        "accelerometer_noise",
        "gyroscope_noise",
        "accelerometer_walk",
        "gyroscope_walk",
    )
}
PARAMS = QuadrotorParams()


def measure(config: Imu, seed: int, duration: float, command=(9.81, 0.0, 0.0, 0.0), name="imu"):
    builder = DiagramBuilder()
    plant = builder.AddSystem(QuadrotorPlant(PARAMS, hover_state([0.0, 0.0, 5.0])))
    source = builder.AddSystem(ConstantVectorSource(np.array(command)))
    imu = builder.AddNamedSystem(name, ImuSensor(config, PARAMS, seed))
    builder.Connect(source.get_output_port(), plant.GetInputPort("command"))
    builder.Connect(source.get_output_port(), imu.GetInputPort("command"))
    builder.Connect(plant.GetOutputPort("state"), imu.GetInputPort("state"))
    logs = [
        LogVectorOutput(imu.GetOutputPort(port), builder, 1.0 / config.rate)
        for port in ("accelerometer", "gyroscope")
    ]
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(duration)
    return [log.FindLog(simulator.get_context()).data()[:, 1:].T for log in logs]


@pytest.mark.parametrize("roll", [0.0, 0.7])
def test_specific_force_is_thrust_less_drag_in_body_axes(roll):
    R_WB = RollPitchYaw(roll, 0.2, 1.0).ToRotationMatrix()
    v_WB = np.array([2.0, -1.0, 0.5])
    q_WB = R_WB.ToQuaternion().wxyz()
    state = np.concatenate([np.zeros(3), v_WB, q_WB, np.zeros(3)])
    expected = [0.0, 0.0, 12.0] - PARAMS.drag * (R_WB.matrix().T @ v_WB)
    a_WB = np.array(quadrotor_derivatives(state, np.array([12.0, 0.0, 0.0, 0.0]), PARAMS)[3:6])
    force = specific_force(state, a_WB, PARAMS.gravity)
    np.testing.assert_allclose(force, expected, atol=1e-12)


def test_an_ideal_imu_measures_hover_and_rates():
    accelerometer, _ = measure(Imu(**IDEAL), 0, 0.5)
    np.testing.assert_allclose(accelerometer, np.tile([0.0, 0.0, 9.81], (100, 1)), atol=1e-9)
    _, gyroscope = measure(Imu(**IDEAL), 0, 1.0, command=(9.81, 0.0, 0.0, 0.4))
    np.testing.assert_allclose(gyroscope[-1], [0.0, 0.0, 0.4], atol=1e-6)


def test_an_imu_feels_wind_through_the_acceleration():
    builder = DiagramBuilder()
    plant = builder.AddSystem(QuadrotorPlant(PARAMS, hover_state([0.0, 0.0, 5.0])))
    imu = builder.AddSystem(ImuSensor(Imu(**IDEAL), PARAMS, 0))
    for port, values in (("command", [9.81, 0.0, 0.0, 0.0]), ("wind", [4.0, 0.0, 0.0])):
        source = builder.AddSystem(ConstantVectorSource(values))
        builder.Connect(source.get_output_port(), plant.GetInputPort(port))
    for port in ("state", "acceleration"):
        builder.Connect(plant.GetOutputPort(port), imu.GetInputPort(port))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.001)
    context = imu.GetMyContextFromRoot(simulator.get_context())
    force = imu.GetOutputPort("accelerometer").Eval(context)
    np.testing.assert_allclose(force, [4.0 * PARAMS.drag, 0.0, 9.81], atol=1e-9)


def test_white_noise_has_the_density():
    config = Imu(**IDEAL | {"accelerometer_noise": 0.01, "gyroscope_noise": 0.001})
    accelerometer, gyroscope = measure(config, 3, 20.0)
    assert accelerometer.std(axis=0) == pytest.approx(0.01 * np.sqrt(200.0), rel=0.05)
    assert gyroscope.std(axis=0) == pytest.approx(0.001 * np.sqrt(200.0), rel=0.05)


def test_biases_walk():
    config = Imu(**IDEAL | {"gyroscope_walk": 0.01})
    gyroscope = np.vstack([measure(config, seed, 4.0)[1] for seed in range(3)])
    steps = np.diff(gyroscope, axis=0)
    small = np.abs(steps) < 0.01  # not those from one flight to the next
    assert steps[small].std() == pytest.approx(0.01 / np.sqrt(200.0), rel=0.05)


def test_noise_follows_from_seed_and_name():
    first, again, other, renamed = (
        measure(Imu(), seed, 0.1, name=name)[0]
        for seed, name in ((1, "imu"), (1, "imu"), (2, "imu"), (1, "second"))
    )
    np.testing.assert_array_equal(first, again)
    assert not np.isclose(first, other).any() and not np.isclose(first, renamed).any()


def test_allan_deviation_is_that_of_the_model():
    config = Imu(accelerometer_noise=2e-3, accelerometer_walk=3e-3)
    random, flights, samples = np.random.default_rng(0), 600, 20_000
    bias, errors = np.zeros(flights), np.empty((samples, flights))
    for k in range(samples):
        draws = random.standard_normal((2, flights))
        errors[k], bias = measurement_error(bias, *draws, 2e-3, 3e-3, config.rate)
    sums = np.cumsum(errors, axis=0) / config.rate
    for m in np.unique(np.geomspace(1, 1000, 13).round().astype(int)):  # 5 ms to 5 s
        tau = m / config.rate
        second = sums[2 * m :: m] - 2.0 * sums[m:-m:m] + sums[: -2 * m : m]
        found = np.sqrt(0.5 * np.mean(second**2)) / tau
        expected = np.sqrt(2e-3**2 / tau + 3e-3**2 * tau * (1 / 3 + 1 / (6 * m**2)))
        assert found == pytest.approx(expected, rel=0.05)
