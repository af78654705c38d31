"""Quadrotors by name, with published parameters; their registry for scenarios.

Comments name the source of each number. Sources: crazyflow 0.4 (`cf21B_500`); rotorpy 3.0; the
repositories uzh-rpg/agile_flight, uzh-rpg/flightmare, PX4/PX4-Autopilot (module simulator_sih) and
dineshvarunshankar/ModalAI_UAV_Systemidentification; ModalAI's datasheet and forum. Radii reach from
the center to the tips of the propellers.
"""

import math
from dataclasses import dataclass, field
from typing import Any, cast

from splatpilot.systems.common.config import require_configuration
from splatpilot.systems.common.registry import Registry
from splatpilot.systems.common.validation import require
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams


@dataclass(frozen=True)
class VehicleEntry:
    """Entry of the registry."""

    config: type[QuadrotorParams]


VEHICLES = Registry("vehicle", "splatpilot.vehicles", VehicleEntry)
"""All vehicles, by the names of their types."""


def register_vehicle[Vehicle: type[QuadrotorParams]](config: Vehicle) -> Vehicle:
    """Registers a vehicle: a dataclass derived from `QuadrotorParams`, with other defaults."""
    require_configuration(config)
    derived = issubclass(config, QuadrotorParams)
    require(derived, config.__name__, "derived from QuadrotorParams", config.__bases__)
    cast(Any, config)().validate()
    VEHICLES.add(config.__name__, VehicleEntry(config))
    return config


register_vehicle(QuadrotorParams)


@register_vehicle
@dataclass
class Crazyflie21Brushless(QuadrotorParams):
    """Crazyflie 2.1 Brushless of Bitcraze, without guards."""

    model: str = "rotors"
    # [kg] crazyflow.
    mass: float = 0.0434
    # [kg m^2] crazyflow.
    inertia: list[float] = field(default_factory=lambda: [25e-6, 28e-6, 49e-6])
    # [m] crazyflow.
    arm: list[float] = field(default_factory=lambda: [0.035355, 0.035355])
    # [N s^2/rad^2] crazyflow, 4.407e-10 N/rpm^2, without its linear term.
    thrust_coefficient: float = 4.407354891648379e-10 * (30 / math.pi) ** 2
    # [m] crazyflow, 2.469e-12 N m/rpm^2 over the thrust.
    torque_ratio: float = 2.4693477924534137e-12 / 4.407354891648379e-10
    # [m/s^2] crazyflow, 0.0214 N for each rotor.
    min_thrust: float = 4 * 0.02136263065537499 / 0.0434
    # [m/s^2] crazyflow, 0.2 N for each rotor.
    max_thrust: float = 4 * 0.2 / 0.0434
    # [s] rotorpy; crazyflow's nonlinear lag is 0.06 s at the speed of hovering.
    motor_time_constant: float = 0.05
    # [s] crazyflow, rates within its identified response of attitude, 16.3 1/s.
    rate_time_constant: float = 1 / 16.300330418164553
    # [-] crazyflow, 17.4 1/s for yaw.
    yaw_time_ratio: float = 16.300330418164553 / 17.368699336318954
    # [1/s] crazyflow, 0.0216 kg/s along x and y.
    drag: float = 0.021643637770852733 / 0.0434
    # [1/s] crazyflow, 0.0248 kg/s along z.
    rotor_drag: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.003127747 / 0.0434])
    # [m] Arms of 50 mm, propellers of 55 mm.
    radius: float = 0.0775


@register_vehicle
@dataclass
class Kingfisher(QuadrotorParams):
    """Kingfisher, the racing quadrotor with propellers of 5 inches of the DodgeDrone challenge."""

    model: str = "rotors"
    # [kg] agile_flight, kingfisher.yaml.
    mass: float = 0.75
    # [kg m^2] agile_flight, kingfisher.yaml.
    inertia: list[float] = field(default_factory=lambda: [2.5e-3, 2.1e-3, 4.3e-3])
    # [m] agile_flight, kingfisher.yaml.
    arm: list[float] = field(default_factory=lambda: [0.0775, 0.1])
    # [N s^2/rad^2] agile_flight, blackbird.yaml, a vehicle of the same rotors.
    thrust_coefficient: float = 1.562522e-6
    # [m] agile_flight, kingfisher.yaml.
    torque_ratio: float = 0.022
    # [m/s^2] agile_flight, kingfisher.yaml, 8.5 N for each rotor.
    max_thrust: float = 4 * 8.5 / 0.75
    # [s] agile_flight, kingfisher.yaml.
    motor_time_constant: float = 0.033
    # [rad/s] agile_flight, kingfisher.yaml.
    max_tilt_rate: float = 10.0
    # [rad/s] agile_flight, kingfisher.yaml.
    max_yaw_rate: float = 4.0
    # [s] flightmare, gains of 16.6 1/s.
    rate_time_constant: float = 1 / 16.6
    # [-] flightmare, a gain of 5 1/s for yaw.
    yaw_time_ratio: float = 16.6 / 5.0
    # [1/s] agile_flight, blackbird.yaml, 0.26 kg/s along x and y.
    drag: float = 0.26 / 0.75
    # [1/s] agile_flight, blackbird.yaml, 0.30 kg/s along z.
    rotor_drag: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.04 / 0.75])
    # [1/m] agile_flight, blackbird.yaml, 0.015 kg/m.
    quadratic_drag: list[float] = field(default_factory=lambda: [0.015 / 0.75] * 3)
    # [m] Arms of 127 mm, propellers of 5 inches.
    radius: float = 0.19


@register_vehicle
@dataclass
class Px4Sih(QuadrotorParams):
    """PX4's quadrotor simulated in hardware (SIH), without its damping of rotations.

    Mass, inertia, arms and torque are the defaults of `QuadrotorParams`.
    """

    model: str = "rotors"
    # [m/s^2] SIH_T_MAX, 5 N for each rotor.
    max_thrust: float = 4 * 5.0 / 1.0
    # [s] SIH_T_TAU.
    motor_time_constant: float = 0.05
    # [1/s] SIH_KDV, 1 kg/s.
    drag: float = 1.0
    # [rad/s] MC_ROLLRATE_MAX, 220 degrees/s.
    max_tilt_rate: float = math.radians(220.0)
    # [rad/s] MC_YAWRATE_MAX, 200 degrees/s.
    max_yaw_rate: float = math.radians(200.0)


@register_vehicle
@dataclass
class Starling2Max(QuadrotorParams):
    """Starling 2 Max of ModalAI, as far as published: drag and rate controller are not."""

    model: str = "rotors"
    # [kg] ModalAI's datasheet.
    mass: float = 0.566
    # [kg m^2] Computed of a box of 217 x 287 x 129 mm, the datasheet's size.
    inertia: list[float] = field(default_factory=lambda: [4.67e-3, 3.01e-3, 6.11e-3])
    # [m] ModalAI's datasheet.
    arm: list[float] = field(default_factory=lambda: [0.095, 0.13])
    # [N s^2/rad^2] Measured, ModalAI_UAV_Systemidentification.
    thrust_coefficient: float = 3.964738e-6
    # [m] Measured, ModalAI_UAV_Systemidentification: 5.387e-8 N m s^2/rad^2 over the thrust.
    torque_ratio: float = 5.386970e-8 / 3.964738e-6
    # [m/s^2] Measured, ModalAI_UAV_Systemidentification: 5.17 N for each rotor.
    max_thrust: float = 4 * 5.169928684944013 / 0.566
    # [s] Spin-up measured by CMU's AirLab; spin-down takes 0.085 s.
    motor_time_constant: float = 0.055
    # [s] Not published: as the motors, for a damping of 0.5.
    rate_time_constant: float = 0.055
    # [m] Arms of 161 mm, propellers of 7 inches (ModalAI's forum).
    radius: float = 0.25
