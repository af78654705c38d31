import math
from typing import NamedTuple

import numpy as np
import pytest

from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, hover_state
from splatpilot.systems.vehicle.vehicles import (
    VEHICLES,
    Crazyflie21Brushless,
    Kingfisher,
    Px4Sih,
    Starling2Max,
)
from tests.systems.vehicle.responses import respond


class Published(NamedTuple):
    mass: float  # [kg]
    rotor_thrust: float  # [N], maximum
    hover_speed: float | None  # [rad/s] of the rotors
    motor_lag: float  # [s]
    rate_gain: float | None  # [1/s] of roll and pitch
    fall_drag: float | None  # [kg/s] in descent
    fall_drag_2: float  # [kg/m]


PUBLISHED = {
    # crazyflow 0.4: hovering by its thrust curve at 15,900 rpm, without its linear term 15,540 rpm.
    Crazyflie21Brushless: Published(0.0434, 0.2, 15540 * math.pi / 30, 0.05, 16.3, 0.02477, 0.0),
    Kingfisher: Published(0.75, 8.5, math.sqrt(1.839 / 1.5625e-6), 0.033, 16.6, 0.30, 0.015),
    Px4Sih: Published(1.0, 5.0, None, 0.05, None, 1.0, 0.0),
    Starling2Max: Published(0.566, 5.17, math.sqrt(1.388 / 3.965e-6), 0.055, None, None, 0.0),
}


@pytest.mark.parametrize(("vehicle", "published"), PUBLISHED.items())
def test_rotors_respond_with_the_published_lag_and_hover_at_the_published_speed(vehicle, published):
    times = np.linspace(0.0, 6 * published.motor_lag, 61)[1:]
    speeds = respond(vehicle(), [10.5, 0.0, 0.0, 0.0], times)[:, 14]
    hover = respond(vehicle(), [9.81, 0.0, 0.0, 0.0], [1.0])[0, 14]
    rise = np.interp(1 - math.exp(-1), (speeds - hover) / (speeds[-1] - hover), times)
    assert rise == pytest.approx(published.motor_lag, rel=0.05)
    if published.hover_speed is not None:
        assert hover == pytest.approx(published.hover_speed, rel=0.05)


@pytest.mark.parametrize(("vehicle", "published"), PUBLISHED.items())
def test_full_thrust_and_free_fall_have_the_published_forces(vehicle, published):
    climb = respond(vehicle(), [100.0, 0.0, 0.0, 0.0], [1.0])[0]
    force = 4 * vehicle().thrust_coefficient * climb[14] ** 2
    assert force == pytest.approx(4 * published.rotor_thrust, rel=0.05)
    if published.fall_drag is None:
        return
    # Descent with the least thrust: weight - thrust = drag v + drag_2 v².
    weight = published.mass * (9.81 - vehicle().min_thrust)
    drag, drag_2 = published.fall_drag, published.fall_drag_2
    terminal = weight / drag
    if drag_2:
        terminal = (math.sqrt(drag**2 + 4 * drag_2 * weight) - drag) / (2 * drag_2)
    fallen = respond(vehicle(), [0.0, 0.0, 0.0, 0.0], [30.0], step=0.01)[0]
    assert -fallen[5] == pytest.approx(terminal, rel=0.05)


@pytest.mark.parametrize(("vehicle", "published"), PUBLISHED.items())
def test_rates_respond_as_gain_and_motor_lag_have_it(vehicle, published):
    gain = published.rate_gain or 1 / vehicle().rate_time_constant
    damping = 0.5 / math.sqrt(gain * published.motor_lag)
    natural = math.sqrt(gain / published.motor_lag)  # [rad/s]
    damped = natural * math.sqrt(1 - damping**2)
    times = np.linspace(0.0, 8 / natural, 81)[1:]
    rates = respond(vehicle(), [9.81, 0.05, 0.0, 0.0], times)[:, 10] / 0.05
    phase = math.acos(damping)
    expected = 1 - np.exp(-damping * natural * times) * np.sin(damped * times + phase) / np.sin(
        phase
    )
    np.testing.assert_allclose(rates, expected, atol=0.05)
    assert rates.max() == pytest.approx(expected.max(), rel=0.05)
    assert times[rates.argmax()] == pytest.approx(math.pi / damped, rel=0.05)


def test_the_papers_vehicle_responds_at_once_and_with_50_ms():
    assert {QuadrotorParams, *PUBLISHED} == set(VEHICLES.configs())
    state = respond(QuadrotorParams(), [15.0, 1.0, 0.0, 0.0], [0.05], hover_state([0, 0, 0]))[0]
    assert state[10] == pytest.approx(1 - math.exp(-1), rel=1e-3)
    assert state[5] == pytest.approx(0.05 * (15.0 - 9.81), rel=0.02)
